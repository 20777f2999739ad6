"""Turns records into the parameters of SQL statements."""

import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from daemon.history.columns.kinds import CNC, CYCLES, DISPLACEMENTS, ESTIMATES, WRITES
from daemon.history.layout import Layout, MachineLayout
from models.json_values import finite_or_none
from models.quality import Quality
from models.records import (
    CncSample,
    CompensationCommand,
    DisplacementSample,
    Instant,
    MachineTemperatures,
    ProbeSample,
    Receipt,
    Reference,
    TemperatureCycle,
    ThermalErrorEstimate,
    Trace,
)
from models.units import int16_from_degc

FLAG = np.dtype([("position", "<u2"), ("quality", "u1"), ("reason", "u1")])
"""One value of a cycle that is not GOOD."""

Parameters = tuple[Any, ...]
_ENCODER = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False)


def _insert(table: str, *columns: str) -> str:
    names = " ".join(columns).split()
    return f"INSERT INTO {table} ({', '.join(names)}) VALUES ({', '.join('?' * len(names))})"


INSERT_CYCLE = _insert(CYCLES.table, "layout_id", *CYCLES.names, "counts", "flags")
INSERT_CNC = _insert(CNC.table, *CNC.names)
INSERT_DISPLACEMENT = _insert(DISPLACEMENTS.table, *DISPLACEMENTS.names)
INSERT_ESTIMATE = _insert(ESTIMATES.table, *ESTIMATES.names)
INSERT_INTENT = _insert(WRITES.table, *WRITES.names[: WRITES.names.index("macros") + 1])
UPDATE_OUTCOME = (
    "UPDATE writes SET outcome = ?, sequence = ?, detail = ?, read_back = ?, applied_um = ?, "
    "outcome_after_ms = ? - utc_ms, cycle_age_ms = utc_ms - ?, "
    "cleansed_us = ?, estimated_us = ?, written_us = ?, read_back_us = ? "
    "WHERE write_id = ?"
)
UPDATE_ECHOED = "UPDATE writes SET echoed_after_ms = ? WHERE write_id = ?"
INSERT_EVENT = _insert("events", "utc_ms monotonic_ms kind text person")
INSERT_PROBE = _insert(
    "probes", "utc_ms monotonic_ms axis deviation_um applied_um thermal_error_um reference_id accepted reason"
)
INSERT_REFERENCE = _insert(
    "reference_points",
    "utc_ms reference_id monotonic_s utc_s real_s source layout_id degc program work_offset power_on_count",
)
PUT_STATE = "INSERT OR REPLACE INTO state (key, json, utc_ms) VALUES (?, ?, ?)"
ACKNOWLEDGE = "INSERT OR REPLACE INTO acknowledged (line, number, utc_ms) VALUES (?, ?, ?)"


def utc_ms(instant: Instant) -> int:
    """Return UTC in whole milliseconds."""
    return round(instant.utc_s * 1e3)


def _times(instant: Instant) -> tuple[int, int]:
    # One rounding for both, so that their difference stays the same number for the packing.
    return utc_ms(instant), utc_ms(instant) - round(instant.utc_ahead_s * 1e3)


def _mapping(keys: Iterable[str], values: Iterable[float], decimals: int | None = None) -> str:
    numbers = zip(keys, values, strict=True)
    if decimals is None:
        return _json({key: None if math.isnan(value) else float(value) for key, value in numbers})
    return _json({key: finite_or_none(value, decimals) for key, value in numbers})


def _json(value: object) -> str:
    return _ENCODER.encode(value)


def cycle_row(
    layout: MachineLayout, cycle: TemperatureCycle, cleansed: MachineTemperatures | None
) -> tuple[Parameters, Layout]:
    """Return a cycle with the quality that cleansing gave it (or its own), and whose layout comes first."""
    quality, reason = cycle.quality, cycle.reason
    if cleansed is not None:
        position = layout.line_positions[cycle.line]
        quality, reason = cleansed.quality[position], cleansed.reason[position]
    counts = int16_from_degc(cycle.degc).astype("<i2", copy=False).tobytes()
    first, last = cycle.trace.first_byte, cycle.trace.last_byte
    parameters = (
        *_times(first),
        cycle.number,
        round((last.monotonic_s - first.monotonic_s) * 1e3),
        int(cycle.complete),
        _json(cycle.faults) if cycle.faults else None,
        counts,
        _flags(quality, reason),
    )
    return parameters, layout.line_layouts[cycle.line]


def _flags(quality: np.ndarray[Any, Any], reason: np.ndarray[Any, Any]) -> bytes | None:
    flagged = np.flatnonzero((quality != Quality.GOOD) | (reason != 0))
    if flagged.size == 0:
        return None
    flags = np.empty(flagged.size, dtype=FLAG)
    flags["position"], flags["quality"], flags["reason"] = flagged, quality[flagged], reason[flagged]
    return flags.tobytes()


def cnc_row(layout: MachineLayout, sample: CncSample) -> Parameters:
    kept = layout.sample_macros
    macros = {str(n): value for n, value in sample.macros.items() if kept is None or n in kept}
    clock_ms = sample.clock_s * 1e3
    return (
        *_times(sample.time),
        sample.mode.value,
        sample.run.value,
        int(sample.alarm),
        sample.program,
        sample.sequence_number,
        finite_or_none(sample.spindle_speed_rpm, 2),
        finite_or_none(sample.motor_temperature_degc, 2),
        round(clock_ms) if math.isfinite(clock_ms) else None,
        sample.power_on_count,
        sample.work_offset,
        sample.tool_number,
        _json(macros),
        _mapping(sample.positions_mm, sample.positions_mm.values(), 3) if sample.positions_mm else None,
    )


def displacement_row(layout: MachineLayout, sample: DisplacementSample) -> Parameters:
    channels = layout.displacement_channels
    reasons = _mapping(channels, sample.reason, 0) if sample.reason.any() else None
    return round(sample.utc_s * 1e3), _mapping(channels, sample.um), reasons, sample.source


def estimate_row(estimate: ThermalErrorEstimate) -> Parameters:
    trace = estimate.trace
    ready = trace.estimated or trace.last_byte
    # The temperatures at the reference stay the same number from one estimate to the next; increments do not.
    labels = [key for key in estimate.label_increment_degc if key in estimate.label_degc]
    return (
        *_times(ready),
        estimate.line,
        utc_ms(trace.first_byte),
        _delay_us(trace.estimated, trace),
        _mapping(estimate.channels, estimate.thermal_error_um, 3),
        _mapping(estimate.channels, estimate.band_um, 3),
        _mapping(estimate.label_degc, estimate.label_degc.values(), 3),
        _mapping(labels, (estimate.label_degc[key] - estimate.label_increment_degc[key] for key in labels), 3),
        int(estimate.in_domain),
        finite_or_none(estimate.confidence, 4),
        _json(estimate.imputed),
        estimate.model_id,
        estimate.reference_id,
    )


def intent_row(
    write_id: int,
    now: Instant,
    command: CompensationCommand | None,
    macros: Sequence[tuple[int, float]],
    cause: str,
    person: str | None,
) -> Parameters:
    decided: Parameters = (None,) * 6
    if command is not None:
        decided = (
            command.state.value,
            command.reason,
            _mapping(command.axes, command.requested_um, 3),
            _mapping(command.axes, command.compensation_um, 3),
            _json(command.enable),
            _json(command.limits_hit),
        )
    written = dict(zip(macro_keys([number for number, _ in macros]), (value for _, value in macros), strict=True))
    return (write_id, *_times(now), cause, person, *decided, _json(written))


def macro_keys(numbers: Sequence[int]) -> list[str]:
    """Return one key per macro written; a number that is written again gets '#2', '#3' .."""
    keys: list[str] = []
    seen: dict[int, int] = {}
    for number in numbers:
        seen[number] = seen.get(number, 0) + 1
        keys.append(str(number) if seen[number] == 1 else f"{number}#{seen[number]}")
    return keys


def outcome_row(layout: MachineLayout, write_id: int, now: Instant, receipt: Receipt) -> Parameters:
    trace, axes = receipt.trace, layout.axes
    if len(axes) != receipt.applied_um.size:
        axes = tuple(str(position) for position in range(1, receipt.applied_um.size + 1))
    keys = macro_keys([number for number, _ in receipt.macros])
    same = receipt.read_back == tuple(value for _, value in receipt.macros)
    return (
        int(receipt.outcome),
        receipt.sequence,
        receipt.detail,
        None if same else _json(dict(zip(keys, receipt.read_back, strict=False))),
        _mapping(axes, receipt.applied_um),
        utc_ms(trace.read_back or now),
        utc_ms(trace.first_byte),
        _delay_us(trace.cleansed, trace),
        _delay_us(trace.estimated, trace),
        _delay_us(trace.written, trace),
        _delay_us(trace.read_back, trace),
        write_id,
    )


def echoed_row(write_id: int, trace: Trace) -> Parameters:
    """Return when the guard had taken over what a cycle led to."""
    assert trace.echoed is not None
    return round((trace.echoed.monotonic_s - trace.last_byte.monotonic_s) * 1e3), write_id


def _delay_us(stage: Instant | None, trace: Trace) -> int | None:
    return None if stage is None else 10 * round((stage.real_s - trace.last_byte.real_s) * 1e5)


def event_row(now: Instant, kind: str, text: str, person: str | None) -> Parameters:
    return (*_times(now), kind, text, person)


def probe_row(probe: ProbeSample) -> Parameters:
    return (
        *_times(probe.time),
        probe.axis,
        probe.deviation_um,
        finite_or_none(probe.applied_um, 4),
        finite_or_none(probe.thermal_error_um, 4),
        probe.reference_id,
        int(probe.accepted),
        probe.reason,
    )


def reference_row(reference: Reference) -> tuple[Parameters, Parameters]:
    """Return what comes before and after the layout's number."""
    time = reference.time
    return (
        (utc_ms(time), reference.reference_id, time.monotonic_s, time.utc_s, time.real_s, reference.source),
        (
            reference.degc.astype("<f8", copy=False).tobytes(),
            reference.program,
            reference.work_offset,
            reference.power_on_count,
        ),
    )
