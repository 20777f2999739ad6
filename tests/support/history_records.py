"""Records of a machine that does not exist, for tests and benchmarks of the history."""

from dataclasses import replace

import numpy as np

from daemon.history.layout import MachineLayout
from models.records import (
    CncMode,
    CncRun,
    CncSample,
    CompensationCommand,
    DisplacementSample,
    Instant,
    MachineTemperatures,
    OutputState,
    Receipt,
    Reference,
    TemperatureCycle,
    ThermalErrorEstimate,
    Trace,
    WriteOutcome,
)

EPOCH_S = 1_760_000_400.0
"""A whole hour."""
AXES = ("X", "Y", "Z")
CHANNELS = ("dx", "dy", "dz")
SMALL = MachineLayout(
    sensor_ids=(11, 12, 13, 21, 22),
    lines={"spindle": (13, 11, 12), "bed": (21, 22)},
    axes=AXES,
    displacement_channels=CHANNELS,
    sample_macros=frozenset({600, 601}),
)
FULL = MachineLayout(
    sensor_ids=tuple(range(1, 303)),
    lines={"spindle": tuple(range(1, 132)), "saddle": tuple(range(132, 200)), "fixed": tuple(range(200, 303))},
    axes=AXES,
    displacement_channels=("d1", "d2", "d3", "d4", "d5"),
    sample_macros=frozenset({600, 601, 602, 603, 604, 605}),
)
BLOCK = (500, 501, 502, 503, 101, 504, 505)


class StillClock:
    """A clock that a test moves."""

    speed = 1.0

    def __init__(self, utc_s: float = EPOCH_S) -> None:
        self.utc_s = utc_s

    def now(self) -> Instant:
        return instant(self.utc_s)

    async def sleep(self, duration_s: float) -> None:
        self.utc_s += duration_s


def instant(utc_s: float) -> Instant:
    return Instant(monotonic_s=utc_s - EPOCH_S + 1000.0, utc_s=utc_s, real_s=utc_s - EPOCH_S + 5000.0)


def trace(first_s: float, *, line_s: float = 1.5, stages: int = 5) -> Trace:
    last_s = first_s + line_s
    names = ("cleansed", "estimated", "written", "read_back")[: stages - 1]
    later = {name: instant(last_s + 0.0004 * (k + 1)) for k, name in enumerate(names)}
    return Trace(first_byte=instant(first_s), last_byte=instant(last_s), **later)


def codes(size: int) -> np.ndarray:
    return np.zeros(size, dtype=np.uint8)


def cycle(line: str, number: int, first_s: float, degc: np.ndarray, **changes: object) -> TemperatureCycle:
    record = TemperatureCycle(
        line=line,
        number=number,
        degc=np.array(degc, dtype=float),
        quality=codes(len(degc)),
        reason=codes(len(degc)),
        complete=True,
        trace=trace(first_s, stages=1),
    )
    return replace(record, **changes)


def cleansed(
    layout: MachineLayout, of: TemperatureCycle, quality: np.ndarray, reason: np.ndarray
) -> MachineTemperatures:
    """What cleansing says of one line's cycle; the other lines have no value yet."""
    size = len(layout.sensor_ids)
    measured, all_quality, all_reason = np.full(size, np.nan), np.full(size, 2, dtype=np.uint8), codes(size)
    position = layout.line_positions[of.line]
    measured[position], all_quality[position], all_reason[position] = of.degc, quality, reason
    return MachineTemperatures(
        line=of.line,
        measured_degc=measured,
        degc=measured.copy(),
        quality=all_quality,
        reason=all_reason,
        age_s=np.zeros(size),
        trace=of.trace,
    )


def cnc_sample(utc_s: float, **changes: object) -> CncSample:
    sample = CncSample(
        time=instant(utc_s),
        mode=CncMode.MEMORY,
        run=CncRun.START,
        alarm=False,
        program=1234,
        sequence_number=100,
        spindle_speed_rpm=6000.0,
        motor_temperature_degc=41.0,
        clock_s=utc_s - EPOCH_S + 77.0,
        power_on_count=3,
        work_offset=54,
        tool_number=7,
        macros={500: 1.0, 600: 0.012, 601: None},
    )
    return replace(sample, **changes)


def displacement(utc_s: float, um: np.ndarray, **changes: object) -> DisplacementSample:
    line = round(utc_s - EPOCH_S) // 60 + 2
    sample = DisplacementSample(
        utc_s=utc_s, um=np.array(um, dtype=float), reason=codes(len(um)), source=f"/srv/logger/today.csv:{line}"
    )
    return replace(sample, **changes)


def estimate(first_s: float, error_um: np.ndarray, **changes: object) -> ThermalErrorEstimate:
    record = ThermalErrorEstimate(
        channels=CHANNELS,
        thermal_error_um=np.array(error_um, dtype=float),
        band_um=np.full(len(error_um), 2.5),
        label_degc={"A": 25.125, "Room": 21.5},
        label_increment_degc={"A": 3.25, "Room": 0.5},
        in_domain=True,
        confidence=0.987,
        imputed=(12, 21),
        model_id="made-up",
        reference_id="ref-1",
        line="spindle",
        trace=trace(first_s, stages=3),
    )
    return replace(record, **changes)


def command(um: np.ndarray, **changes: object) -> CompensationCommand:
    record = CompensationCommand(
        axes=AXES,
        requested_um=np.array(um, dtype=float) * 1.25,
        compensation_um=np.array(um, dtype=float),
        enable=(False, True, True),
        state=OutputState.ACTIVE,
        reason="following",
        write=True,
        limits_hit=("Z slew",),
    )
    return replace(record, **changes)


def macros(sequence: int, um: np.ndarray) -> tuple[tuple[int, float], ...]:
    values = (float(sequence), *(float(u) / 1000.0 for u in um), 1234.567, 6.0, float(sequence))
    return tuple(zip(BLOCK, values, strict=True))


def receipt(first_s: float, written: tuple[tuple[int, float], ...], **changes: object) -> Receipt:
    record = Receipt(
        sequence=int(written[0][1]),
        macros=written,
        outcome=WriteOutcome.VERIFIED,
        detail="",
        read_back=tuple(value for _, value in written),
        applied_um=np.array([np.nan, 1.5, -2.25]),
        trace=trace(first_s),
    )
    return replace(record, **changes)


def reference(utc_s: float, size: int) -> Reference:
    return Reference(
        reference_id="ref-1",
        time=instant(utc_s),
        source="O1234 N10",
        degc=np.linspace(20.0, 30.0, size),
        program=1234,
        work_offset=54,
        power_on_count=3,
    )
