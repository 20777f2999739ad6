"""Results of reading the store: records as columns over time, and the audit as records."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import FloatArray, IntArray
from daemon.history.columns.frames import Frame
from models.quality import Quality
from models.records import WriteOutcome

CodeArray = npt.NDArray[np.uint8]
NOT_IN_CYCLE = 255
"""Quality and reason where the sensor hangs on another line than the row's cycle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TemperatureHistory:
    """Temperatures as measured: one row per line cycle, one column per sensor."""

    sensor_ids: tuple[int, ...]
    time_s: FloatArray
    """UTC of the cycle's first byte [s]."""
    monotonic_s: FloatArray
    """The same on the monotonic clock [s]."""
    line: tuple[str, ...]
    number: IntArray
    degc: FloatArray
    """Measured [degC]; NaN where no value arrived or the sensor is not on the row's line."""
    quality: CodeArray
    reason: CodeArray

    def series(self, sensor_id: int) -> tuple[FloatArray, FloatArray, CodeArray]:
        """Return time [s], measured temperature [degC] and quality of one sensor's own cycles."""
        column = self.sensor_ids.index(sensor_id)
        own = self.quality[:, column] != NOT_IN_CYCLE
        return self.time_s[own], self.degc[own, column], self.quality[own, column]

    def cleansed(self) -> FloatArray:
        """Return [degC] what cleansing made of it: GOOD as measured, HELD the last GOOD one, else NaN.

        A value held since before the first row is NaN: read from a little earlier.
        """
        rows = np.arange(self.time_s.size)[:, None]
        latest = np.maximum.accumulate(np.where(self.quality == Quality.GOOD, rows, -1), axis=0)
        held = np.take_along_axis(self.degc, np.maximum(latest, 0), axis=0)
        usable = ((self.quality == Quality.GOOD) | (self.quality == Quality.HELD)) & (latest >= 0)
        return np.where(usable, held, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class CncHistory:
    time_s: FloatArray
    monotonic_s: FloatArray
    mode: tuple[str, ...]
    run: tuple[str, ...]
    alarm: npt.NDArray[np.bool_]
    program: IntArray
    sequence_number: IntArray
    spindle_speed_rpm: FloatArray
    motor_temperature_degc: FloatArray
    clock_s: FloatArray
    power_on_count: IntArray
    work_offset: IntArray
    tool_number: IntArray
    macros: dict[int, FloatArray]
    """NaN where vacant or not asked for."""
    positions_mm: dict[str, FloatArray]
    """Machine positions by name [mm], NaN where there was none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteRecord:
    """One write of macro variables in the audit."""

    write_id: int
    time_s: float
    """UTC of the intent [s]."""
    cause: str
    person: str | None
    state: str | None
    reason: str | None
    requested_um: dict[str, float | None]
    compensation_um: dict[str, float | None]
    enable: tuple[bool, ...]
    limits_hit: tuple[str, ...]
    macros: tuple[tuple[int, float], ...]
    """In the order written."""
    outcome: WriteOutcome
    sequence: int | None
    detail: str | None
    read_back: tuple[float | None, ...]
    """In the order of `macros`; empty while the outcome is not known."""
    applied_um: dict[str, float | None]
    """The guard's echo per axis."""
    outcome_time_s: float | None
    cycle_time_s: float | None
    """UTC of the first byte of the cycle behind it [s]; None while the outcome is not known."""
    delay_s: dict[str, float]
    """From the cycle's last byte to each stage that was passed, on the computer's clock."""
    echoed_after_s: float | None = None
    """From the cycle's last byte to the poll that showed it applied in full [s], in the machine's time; None: never."""


STAGES = ("cleansed", "estimated", "written", "read_back")


def write_records(frame: Frame) -> list[WriteRecord]:
    return [_record(frame, index) for index in range(frame.rows)]


def possible_macros(newest_first: Iterable[WriteRecord], of: Sequence[int]) -> dict[int, tuple[float, ...]]:
    """Return per macro what it may hold by the audit, as `RestartReader.last_written_macros` says."""
    since_verified: list[WriteRecord] = []
    for record in newest_first:
        written = {number for number, _ in record.macros}
        if of and not written & set(of):
            continue
        since_verified.append(record)
        whole = written >= set(of) if of else record.state is not None
        if record.outcome is WriteOutcome.VERIFIED and whole:
            break  # a whole block; answers to the NC program and the like carry no state
    possible: dict[int, tuple[float, ...]] = {}
    for record in reversed(since_verified):
        if record.outcome is WriteOutcome.REFUSED:
            continue
        apart = not of and record.state is None and record.outcome is not WriteOutcome.VERIFIED
        for number, value in record.macros:
            if apart and number not in possible:
                continue  # it may not have arrived, and what stood there before is not told: it counts as found
            before = () if record.outcome is WriteOutcome.VERIFIED else possible.get(number, ())
            possible[number] = before if value in before else (*before, value)
    return possible


def _record(frame: Frame, index: int) -> WriteRecord:
    def number(name: str) -> float | None:
        value = float(frame.numbers(name)[index])
        return None if np.isnan(value) else value

    written = frame.mapping("macros").row(index) or {}
    outcome = WriteOutcome(int(frame.integers("outcome")[index]))
    utc_ms = int(frame.integers("utc_ms")[index])
    after_ms, age_ms, sequence = number("outcome_after_ms"), number("cycle_age_ms"), number("sequence")
    echoed_ms = number("echoed_after_ms")
    delays_us = {stage: number(f"{stage}_us") for stage in STAGES}
    return WriteRecord(
        write_id=int(frame.integers("write_id")[index]),
        time_s=utc_ms / 1e3,
        cause=frame.texts("cause")[index] or "",
        person=frame.texts("person")[index],
        state=frame.texts("state")[index],
        reason=frame.texts("reason")[index],
        requested_um=frame.mapping("requested_um").row(index) or {},
        compensation_um=frame.mapping("compensation_um").row(index) or {},
        enable=tuple(_listed(frame.texts("enable")[index])),
        limits_hit=tuple(_listed(frame.texts("limits_hit")[index])),
        macros=tuple((int(key.partition("#")[0]), np.nan if v is None else v) for key, v in written.items()),
        outcome=outcome,
        sequence=None if sequence is None else int(sequence),
        detail=frame.texts("detail")[index],
        read_back=_read_back(frame, index, written) if outcome is not WriteOutcome.INTENDED else (),
        applied_um=frame.mapping("applied_um").row(index) or {},
        outcome_time_s=None if after_ms is None else (utc_ms + after_ms) / 1e3,
        cycle_time_s=None if age_ms is None else (utc_ms - age_ms) / 1e3,
        delay_s={stage: us / 1e6 for stage, us in delays_us.items() if us is not None},
        echoed_after_s=None if echoed_ms is None else echoed_ms / 1e3,
    )


def _listed(text: str | None) -> list[Any]:
    return [] if text is None else list(json.loads(text))


def _read_back(frame: Frame, index: int, written: dict[str, float | None]) -> tuple[float | None, ...]:
    found = frame.mapping("read_back").row(index)
    return tuple(written.values()) if found is None else tuple(found.get(key) for key in written if key in found)
