"""Snapshots: one frozen record of each task's latest state, and the board from which the monitor reads them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from models.records import (
    CncSample,
    DisplacementSample,
    FloatArray,
    MachineTemperatures,
    OutputState,
    Phase,
    Reference,
    ThermalErrorEstimate,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Contributions:
    """What each sensor, with its lags, adds to the estimate since the reference; speed and drift are in none."""

    sensor_ids: tuple[int, ...]
    channels: tuple[str, ...]
    work_out: Callable[[], FloatArray]

    @property
    def um(self) -> FloatArray:
        """Shape (n_sensors, n_channels) [um]; worked out where somebody looks, which hardly anybody does."""
        return self.work_out()


@dataclass(frozen=True, slots=True, kw_only=True)
class ThermalSnapshot:
    """The thermal task: what arrived, what counts, what is estimated."""

    temperatures: MachineTemperatures | None
    estimate: ThermalErrorEstimate | None
    line_faults: Mapping[str, tuple[str, ...]]
    """Faults of each line's latest cycle, by the line's name."""
    cycles_received: int
    cycles_incomplete: int
    estimates: int
    model_waits: str = ""
    """Which released model makes no estimates yet and why, '' when none waits."""
    contributions: Contributions | None = None
    """None before an estimate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CncSnapshot:
    """The control as it answered the latest poll."""

    identity: str
    secure: bool
    """Encrypted, signed and with a named user."""
    sample: CncSample
    echo_status: int | None
    """What the guard says of its latest run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteCounts:
    """Writes of the block since the daemon started."""

    sent: int
    verified: int
    """Read back and equal."""
    refused: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlSnapshot:
    """The control task: state of the output, its axes, the reference, the control."""

    state: OutputState
    reason: str
    since_monotonic_s: float | None
    """Since when it is in this state; None before the CNC was first reached."""
    alarm: str
    fault: int
    """Number of the newest FAULT, also of one that is acknowledged; 0: there was none."""
    notices: tuple[str, ...]
    """What a person should know, the latest last."""
    phase: Phase
    limits_hit: tuple[str, ...]
    weight: float | None
    """Multiplies the estimate."""
    guard_silent_s: float
    """Time of running program since the guard's last run."""
    axes: tuple[str, ...]
    wanted: tuple[bool, ...]
    """Axes that a person switched on."""
    enabled: tuple[bool, ...]
    thermal_error_um: FloatArray
    """Per axis, NaN where it is not known; so are the following."""
    requested_um: FloatArray
    written_um: FloatArray
    applied_um: FloatArray
    """The guard's echo."""
    baseline_um: FloatArray
    """What was applied when the reference was set."""
    bound_um: FloatArray
    slew_um_per_min: FloatArray
    reference: Reference | None
    reference_ended: str
    """Why there is none, as far as that is known."""
    tools_set: tuple[int, ...]
    """Numbers of the tools with a setting of their own."""
    cnc: CncSnapshot | None
    """None without a link."""
    writes: WriteCounts
    written_axes: tuple[str, ...]
    """Axes that were ever written with their enable bit set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedDiagram:
    """What a plan was made from, for people to look at; made anew now and then."""

    frequency_hz: tuple[float, ...]
    receptance_um_per_n: Mapping[str, tuple[float, ...]]
    """Magnitude at the tool point by axis."""
    speed_rpm: tuple[float, ...]
    limiting_depth_mm: tuple[float | None, ...]
    """None where no lobe limits it."""
    demanded_depth_mm: float
    resonance_time_s: tuple[float, ...]
    """Monotonic times of the followed resonances [s], oldest first."""
    resonance_hz: Mapping[str, tuple[float, ...]]
    """By axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleSpeedSnapshot:
    """The tuning of the spindle speed; the field names are those of `toolpoint status --json`."""

    state: str
    reason: str
    alarm: str
    switched_on: bool
    stands_off: bool
    """It is switched off, and the block in the CNC says so or has run out."""
    applied_rpm: float | None
    nc_status: int | None
    operation: str | None
    tool_number: int | None
    programmed_rpm: float | None
    commanded_rpm: float | None
    """None while the NC may not follow it; so is the feed."""
    commanded_feed_mm_min: float | None
    target_rpm: float | None
    limiting_depth_mm: float | None
    margin_met: bool | None
    flagged_span_rpm: float | None
    resonance_hz: Mapping[str, float]
    """By the axis that is followed."""
    change_per_sensor_step_rpm: Mapping[str, float]
    """Signal -> how far one step of its sensors moves the target."""
    diagram: SpeedDiagram | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSnapshot:
    name: str
    up: bool
    problem: str
    """Why it is down, '' while it is up."""
    attempts: int
    failures: int
    losses: int
    """Failures after it had been up."""
    last_problem: str
    last_problem_utc_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DisplacementSnapshot:
    """The A/D logger's files and the other sources of displacements."""

    latest: DisplacementSample | None = None
    """The newest row; what another source measures is what that source measured last."""
    rows_read: int = 0
    problems: int = 0
    """Rows, fields and files that could not be read."""
    last_problem: str = ""
    """Names file, line and column."""
    last_problem_utc_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class HistorySnapshot:
    acknowledged: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    """Line -> number of its last committed cycle."""
    problem: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelSnapshot:
    """A released model in force, or why there is none; the field names are those of `toolpoint status --json`."""

    model_id: str | None
    sha256: str | None
    release: int | None
    released_by: str | None
    released: str | None
    problem: str
    """Why there is none, or why the latest release was refused."""
    warning: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JobSnapshot:
    """One of the housekeeping jobs, which run in processes of their own."""

    name: str
    attempted_utc_s: float | None = None
    """None: not since the daemon started."""
    outcome: str = ""
    """What the latest run made, '' before it."""
    problem: str
    """Why the latest run failed, '' when it did not."""


class SnapshotBoard:
    """The latest snapshot of each task: each attribute has one writer, which replaces it whole."""

    def __init__(self, *, control: ControlSnapshot, thermal: ThermalSnapshot) -> None:
        self.control = control
        self.thermal = thermal
        self.spindle_speed: SpindleSpeedSnapshot | None = None
        """None where the tuning is off."""
        self.links: tuple[LinkSnapshot, ...] = ()
        self.displacements = DisplacementSnapshot()
        self.history = HistorySnapshot()
        self.model: ModelSnapshot | None = None
        self.bearing_model: ModelSnapshot | None = None
        """None without a section `spindle_speed`."""
        self.jobs: tuple[JobSnapshot, ...] = ()
