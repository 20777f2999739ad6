"""What a previous run of the daemon left behind, and whether it may be taken up again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import structlog

from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from drivers.clock import Clock
from models.compensation import OutputMemory
from models.records import Instant, Reference

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResumePoint:
    """What the previous run of the daemon left, as far as it may be taken up again."""

    wanted: tuple[bool, ...]
    reference: Reference | None
    known_macros: dict[int, tuple[float, ...]] | None
    rest: dict[str, Any] | None = None
    """Where the output stood when the reference was set, from `rest_to_state`."""


def rest_to_state(memory: OutputMemory, axes: Sequence[str]) -> dict[str, Any]:
    """Return as JSON for the store what the request is counted from."""
    return {
        "reference_id": memory.reference_id,
        "model_id": memory.model_id,
        "baseline_um": dict(zip(axes, memory.baseline_um.tolist(), strict=True)),
        "offset_um": dict(zip(axes, memory.offset_um.tolist(), strict=True)),
    }


def with_rest(
    memory: OutputMemory, rest: dict[str, Any] | None, axes: Sequence[str], reference: Reference
) -> OutputMemory:
    """Return the memory with the stored baseline of a reference that is taken up again.

    Without it the request would count from what is applied now, which already holds the compensation.

    Raises
    ------
    ValueError
        When no baseline is stored for this reference, or for other axes.

    """
    if rest is None or rest["reference_id"] != reference.reference_id or set(rest["baseline_um"]) != set(axes):
        raise ValueError(f"the reference of {reference.source} is not taken up again: its baseline was not stored")
    return replace(
        memory,
        reference_id=rest["reference_id"],
        model_id=rest["model_id"],
        baseline_um=np.array([rest["baseline_um"][axis] for axis in axes]),
        offset_um=np.array([rest["offset_um"][axis] for axis in axes]),
    )


def reference_to_state(reference: Reference) -> dict[str, Any]:
    """Return a reference as JSON for the store."""
    return {
        "reference_id": reference.reference_id,
        "utc_s": reference.time.utc_s,
        "source": reference.source,
        "degc": [None if np.isnan(value) else float(value) for value in reference.degc],
        "program": reference.program,
        "work_offset": reference.work_offset,
        "power_on_count": reference.power_on_count,
    }


def reference_from_state(state: dict[str, Any], clock: Clock) -> Reference:
    """Return a stored reference; its age is carried over by the calendar clock."""
    now = clock.now()
    age_s = now.utc_s - state["utc_s"]
    return Reference(
        reference_id=state["reference_id"],
        time=Instant(monotonic_s=now.monotonic_s - age_s, utc_s=state["utc_s"], real_s=now.real_s - age_s),
        source=state["source"],
        degc=np.array([np.nan if value is None else value for value in state["degc"]]),
        program=state["program"],
        work_offset=state["work_offset"],
        power_on_count=state["power_on_count"],
    )


def load_resume_point(configuration: Configuration, history: HistoryWriter, clock: Clock) -> ResumePoint:
    """Read from the store what was switched on, the reference, and what the macros may hold."""
    axes = tuple(configuration.compensation.axes)
    wanted = history.get_state("wanted") or {}
    alive_utc_s = history.get_state("alive_utc_s")
    now_utc_s = clock.now().utc_s
    outage_s = now_utc_s - alive_utc_s if alive_utc_s is not None else float("inf")
    resumable = 0 <= outage_s <= configuration.compensation.reference.max_outage_s
    stored = history.get_state("reference")
    reference = reference_from_state(stored, clock) if stored and resumable else None
    if stored and not resumable:
        log.warning("reference.too_old", outage_s=outage_s)
    return ResumePoint(
        wanted=tuple(bool(wanted.get(axis, False)) and resumable for axis in axes),
        reference=reference,
        known_macros=history.last_written_macros(),
        rest=history.get_state("rest"),
    )
