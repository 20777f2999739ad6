"""The frozen records that travel from the wire to the macro.

Units stand in the field names. Arrays are one-dimensional float64 (or uint8 codes of
`models.quality`), in the machine's sensor order unless a field says otherwise, and read-only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
CodeArray = npt.NDArray[np.uint8]


def _lock(*arrays: npt.NDArray[np.generic]) -> None:
    for array in arrays:
        array.flags.writeable = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Instant:
    """One moment on three clocks.

    `monotonic_s` and `utc_s` belong to the machine (scaled in a simulation); `real_s` is the
    monotonic clock of this computer, never scaled: the product's own delay is measured on it.
    """

    monotonic_s: float
    utc_s: float
    real_s: float

    @property
    def utc_ahead_s(self) -> float:
        """How far the calendar is ahead of the monotonic clock [s]."""
        return self.utc_s - self.monotonic_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Trace:
    """When one line cycle passed each stage on its way to the CNC."""

    first_byte: Instant
    last_byte: Instant
    cleansed: Instant | None = None
    estimated: Instant | None = None
    written: Instant | None = None
    read_back: Instant | None = None
    echoed: Instant | None = None
    """First poll that showed the guard's echo at the whole written value, not on a step towards it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TemperatureCycle:
    """One pass over one LATSIS line, in the order of the line's chain (position 1 first)."""

    line: str
    number: int
    """Count of cycles of this line since its port was opened, from 1."""
    degc: FloatArray
    """Decoded values [degC], NaN where none arrived or the device flagged an error."""
    quality: CodeArray
    reason: CodeArray
    complete: bool
    """Every expected ID that is not quarantined arrived exactly once."""
    faults: tuple[str, ...] = ()
    """What went wrong in this cycle, in words, naming sensor or byte. A complete cycle has some too
    when a sensor reported an error or bytes around its frames were rejected."""
    trace: Trace

    def __post_init__(self) -> None:
        _lock(self.degc, self.quality, self.reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineTemperatures:
    """All temperatures of the machine after cleansing, at the completion of one line's cycle."""

    line: str
    """The line whose cycle completed."""
    measured_degc: FloatArray
    """The latest value of each sensor as it came over the wire [degC], NaN where none."""
    degc: FloatArray
    """Cleansed [degC]: measured, or the last accepted value where quality is HELD, else NaN."""
    quality: CodeArray
    reason: CodeArray
    age_s: FloatArray
    """Time since each sensor's last accepted value [s], inf where there was none."""
    trace: Trace
    believed_degc: FloatArray | None = None
    """Cleansed, shifts of levels taken off [degC]; NaN where held or doubted. None: not worked out."""
    doubted: Mapping[int, str] = field(default_factory=dict)
    """Why a sensor at this place is not believed."""

    def __post_init__(self) -> None:
        _lock(self.measured_degc, self.degc, self.quality, self.reason, self.age_s)


OF_SOURCE = "source "
"""How `DisplacementSample.source` begins for what stands in no file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DisplacementSample:
    """One row of the A/D logger's file or of another source, in the order of the configured channels."""

    utc_s: float
    um: FloatArray
    """Displacement per channel [um], NaN where the field was empty, overflowed or unreadable."""
    reason: CodeArray
    source: str
    """File and line it came from, or `OF_SOURCE` and the source's name."""

    def __post_init__(self) -> None:
        _lock(self.um, self.reason)


class CncMode(StrEnum):
    """Operating mode of the CNC."""

    MDI = "mdi"
    MEMORY = "memory"
    EDIT = "edit"
    HANDLE = "handle"
    JOG = "jog"
    REMOTE = "remote"
    UNKNOWN = "unknown"


class CncRun(StrEnum):
    """Run state of the CNC's automatic operation."""

    RESET = "reset"
    STOP = "stop"
    HOLD = "hold"
    START = "start"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class CncSample:
    """What the CNC said in one poll."""

    time: Instant
    mode: CncMode
    run: CncRun
    alarm: bool
    program: int
    sequence_number: int
    spindle_speed_rpm: float
    motor_temperature_degc: float
    clock_s: float
    """The CNC's own clock [s]; `valid_until` is counted on it."""
    power_on_count: int
    work_offset: int
    tool_number: int
    macros: dict[int, float | None] = field(default_factory=dict)
    """The macro variables asked for; None where the variable is vacant."""
    positions_mm: dict[str, float] = field(default_factory=dict)
    """Machine positions of the axes that the configuration names [mm]; NaN where the control gives none."""


class Phase(StrEnum):
    """What the machine is doing, as far as compensation cares."""

    IDLE = "idle"
    SAFE_POINT = "safe point"
    CUTTING = "cutting"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """The instant and temperatures at which the thermal error is zero by definition."""

    reference_id: str
    time: Instant
    source: str
    """Program and sequence number, or the person who set it."""
    degc: FloatArray
    """Cleansed means of the last minute, per sensor [degC]; NaN where a sensor had none."""
    program: int
    work_offset: int
    power_on_count: int

    def __post_init__(self) -> None:
        _lock(self.degc)


@dataclass(frozen=True, slots=True, kw_only=True)
class ThermalErrorEstimate:
    """Estimated thermal error of each model channel since the reference."""

    channels: tuple[str, ...]
    thermal_error_um: FloatArray
    """Actual minus nominal since the reference [um], per channel; NaN without a reference."""
    band_um: FloatArray
    """Half width of the prediction band [um], per channel; NaN where the model carries none."""
    label_degc: dict[str, float]
    """Means of the labelled sensors [degC] now, for tool terms and the monitor."""
    label_increment_degc: dict[str, float]
    """Their change since the reference [degC]."""
    in_domain: bool
    confidence: float
    """How far the estimate may be followed, 0..1: usable sensors, past that is known, distance from training."""
    imputed: tuple[int, ...]
    """IDs of the sensors that were imputed."""
    fading_um: float = 0.0
    """What it is still off for the step that a sensor's return would have been [um], of the worst channel and tool."""
    found_wrong_um: float = 0.0
    """What sensors that were found wrong since the reference were worth when they were found, all together [um]."""
    inhibit: str = ""
    """Why the model cannot be followed yet, '' when it can."""
    held_s: float = 0.0
    """Age of the oldest temperature that counts, of a sensor that has missed cycles [s]; 0 where none has."""
    model_id: str
    reference_id: str | None
    line: str
    """The line whose cycle renewed the estimate."""
    trace: Trace
    probe_wander: tuple[FloatArray, FloatArray] | None = None
    """Variance that what the model misses gains per minute [um^2/min], and the time constant with which it returns to
    zero [min], per channel; None: not known."""
    follows: tuple[str, FloatArray] | None = None
    """The model before it since the reference, and how much more that one made of the same temperatures at the change
    [um], per channel, NaN for one that it did not have; None: there was none."""

    def __post_init__(self) -> None:
        _lock(self.thermal_error_um, self.band_um)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeSample:
    """What a probe in the NC program measured on one axis, and what was known at that moment."""

    time: Instant
    axis: str
    deviation_um: float
    """Actual minus nominal with what was applied [um]."""
    applied_um: float
    """The guard's echo [um], NaN where it was unknown."""
    thermal_error_um: float
    """The estimate since the reference [um], NaN where there was none."""
    reference_id: str | None
    accepted: bool
    """It corrects the estimate from now on."""
    reason: str
    """Why it was refused, '' when it was not."""


class OutputState(StrEnum):
    """State of the compensation output (one per machine)."""

    OFF = "OFF"
    ARMED = "ARMED"
    ACTIVE = "ACTIVE"
    HOLD = "HOLD"
    RETREAT = "RETREAT"
    FAULT = "FAULT"


@dataclass(frozen=True, slots=True, kw_only=True)
class CompensationCommand:
    """What the output task is to write."""

    axes: tuple[str, ...]
    requested_um: FloatArray
    """Before the limits [um]."""
    compensation_um: FloatArray
    """After bound, slew rate and deadband [um]; this is written."""
    enable: tuple[bool, ...]
    state: OutputState
    reason: str
    write: bool
    """False in FAULT, and while there is nothing to say."""
    limits_hit: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _lock(self.requested_um, self.compensation_um)


class WriteOutcome(IntEnum):
    """How a macro write ended."""

    INTENDED = 0
    VERIFIED = 1
    DIFFERS = 2
    FAILED = 3
    REFUSED = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Receipt:
    """The outcome of one write of the macro block."""

    sequence: int
    macros: tuple[tuple[int, float], ...]
    """Macro number and value in the CNC's unit, in the order written."""
    outcome: WriteOutcome
    detail: str
    read_back: tuple[float | None, ...]
    applied_um: FloatArray
    """The guard's echo per axis [um], NaN where vacant."""
    trace: Trace

    def __post_init__(self) -> None:
        _lock(self.applied_um)
