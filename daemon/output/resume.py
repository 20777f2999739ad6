"""What a previous run of the daemon left behind, and whether it may be taken up again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import structlog

from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from daemon.output.last_block import LastBlock
from daemon.output.macro_block import ECHO_SLACK_UM
from drivers.clock import Clock
from models.output import OutputMemory, ToolRest
from models.records import FloatArray, Instant, Reference

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResumePoint:
    """What the previous run of the daemon left, as far as it may be taken up again."""

    wanted: tuple[bool, ...]
    reference: Reference | None
    known_macros: dict[int, tuple[float, ...]] | None
    resumable: bool = True
    """The outage was short enough to go on as before."""
    fault: str | None = None
    """The latched FAULT that nobody has acknowledged."""
    rest: dict[str, Any] | None = None
    """Where the output stood when the reference was set, from `rest_to_state`."""
    kept_reference: Reference | None = None
    """What the tool settings count from; the reference, or one that had ended."""


def wanted_at_start(resume: ResumePoint, applied_um: FloatArray, *, in_time: bool) -> tuple[bool, ...]:
    """Return which axes stay switched on at the first contact with the CNC.

    After too long an outage that is only what still carries an offset: it is held until a person speaks.
    """
    if resume.resumable and in_time:
        return resume.wanted
    return tuple(bool(abs(um) > ECHO_SLACK_UM) for um in applied_um)


def rest_to_state(memory: OutputMemory, axes: Sequence[str]) -> dict[str, Any]:
    """Return as JSON for the store what the request is counted from."""
    return {
        "reference_id": memory.reference_id,
        "model_id": memory.model_id,
        "error_reference_id": memory.error_reference_id,
        "baseline_um": dict(zip(axes, memory.baseline_um.tolist(), strict=True)),
        "offset_um": dict(zip(axes, memory.offset_um.tolist(), strict=True)),
        "weight": memory.weight,
        "tools": {
            str(number): {
                "baseline_um": [None if np.isnan(um) else um for um in tool.baseline_um.tolist()],
                "error_um": tool.error_um.tolist(),
                "offset_um": tool.offset_um.tolist(),
            }
            for number, tool in memory.tools.items()
        },
    }


def with_rest(
    memory: OutputMemory,
    rest: dict[str, Any] | None,
    axes: Sequence[str],
    reference: Reference,
    model_id: str | None,
) -> OutputMemory:
    """Return the memory with the stored baseline of a reference that is taken up again.

    Without it the request would count from what is applied now, which already holds the compensation.

    Raises
    ------
    ValueError
        When no baseline is stored for this reference, or for other axes, or for another model.

    """
    if rest is None or rest["reference_id"] != reference.reference_id or set(rest["baseline_um"]) != set(axes):
        raise ValueError(f"the reference of {reference.source} is not taken up again: its baseline was not stored")
    if rest["model_id"] not in (None, model_id):
        raise ValueError(
            f"the reference of {reference.source} is not taken up again: it belongs to model {rest['model_id']}, "
            f"the model is now {model_id}"
        )
    return replace(
        memory,
        reference_id=rest["reference_id"],
        model_id=rest["model_id"],
        error_reference_id=rest["reference_id"],
        baseline_um=np.array([rest["baseline_um"][axis] for axis in axes]),
        offset_um=np.array([rest["offset_um"][axis] for axis in axes]),
        weight=rest.get("weight", memory.weight),
        tools=_tools(rest, axes),
    )


def with_tools(
    memory: OutputMemory,
    rest: dict[str, Any] | None,
    axes: Sequence[str],
    kept: Reference,
    model_id: str | None,
) -> OutputMemory:
    """Return the memory with the tool settings of the previous run, which count on from a reference that has ended.

    Without settings that belong to this reference, these axes and this model it is returned as it is.
    """
    if rest is None or rest.get("error_reference_id") != kept.reference_id or rest["model_id"] != model_id:
        return memory
    offset_um = np.array([rest["offset_um"].get(axis, 0.0) for axis in axes])
    tools, basis = _tools(rest, axes), kept.reference_id
    return replace(memory, tools=tools, error_reference_id=basis, model_id=model_id, offset_um=offset_um)


def _tools(rest: dict[str, Any], axes: Sequence[str]) -> MappingProxyType[int, ToolRest]:
    same = list(rest["baseline_um"]) == list(axes)
    kept = rest.get("tools", {}).items() if same else ()
    return MappingProxyType({int(number): _tool_rest(tool) for number, tool in kept})


def _tool_rest(kept: dict[str, list[float | None]]) -> ToolRest:
    numbers = {name: [np.nan if um is None else um for um in values] for name, values in kept.items()}
    return ToolRest(**{name: np.array(values) for name, values in numbers.items()})


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


def load_resume_point(
    configuration: Configuration, history: HistoryWriter, clock: Clock, last_block: LastBlock
) -> ResumePoint:
    """Read from the store what was switched on, the reference, and what the macros may hold."""
    axes = tuple(configuration.compensation.axes)
    wanted = history.get_state("wanted") or {}
    alive_utc_s = history.get_state("alive_utc_s")
    now_utc_s = clock.now().utc_s
    outage_s = now_utc_s - alive_utc_s if alive_utc_s is not None else float("inf")
    resumable = 0 <= outage_s <= configuration.compensation.reference.max_outage_s
    stored = history.get_state("reference")
    reference = reference_from_state(stored, clock) if stored and resumable else None
    kept_stored = history.get_state("kept_reference")
    if stored and not resumable:
        log.warning("reference.too_old", outage_s=outage_s)
    known, kept = history.last_written_macros(), last_block.load()
    if kept is not None and (lost := _not_in(known or {}, kept)):
        log.warning("audit.gap", macros=lost)
        history.event("audit gap", f"the daemon ended while writing; not in the audit: {lost}", "daemon")
    return ResumePoint(
        wanted=tuple(bool(wanted.get(axis, False)) for axis in axes),
        resumable=resumable,
        fault=history.get_state("fault"),
        reference=reference,
        known_macros=kept if kept is not None else known,
        rest=history.get_state("rest"),
        kept_reference=reference_from_state(kept_stored, clock) if kept_stored and resumable else None,
    )


def _not_in(known: dict[int, tuple[float, ...]], kept: dict[int, tuple[float, ...]]) -> str:
    """Return in words the macros whose last value the audit does not know."""
    lost = {number: values[-1] for number, values in kept.items() if values and values[-1] not in known.get(number, ())}
    return ", ".join(f"#{number} {value:g}" for number, value in lost.items())
