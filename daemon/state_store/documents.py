"""The documents: one frozen record per key of the store's table `state`."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from models.standing_input import StandingInput


@dataclass(frozen=True, slots=True, kw_only=True)
class DaemonAlive:
    """When the daemon last recorded that it runs; a restart measures its outage by it."""

    utc_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CalendarOfBoot:
    """What the calendar was since this computer's start: a daemon that is restarted counts on by the other clock."""

    to_utc_s: tuple[tuple[float, ...], ...]
    """From when on of the monotonic clock [s], and UTC minus that [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WantedAxes:
    """Which axes a person had switched on, and those of them on which a person must decide anew."""

    axes: Mapping[str, bool]
    undecided: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputFault:
    """Why the output is not trusted, in the order in which it was found; empty while it is."""

    reasons: tuple[str, ...]
    number: int = 0


UNREADABLE = ""
"""Name of no axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnOffsets:
    """The operator's own part of the external offset."""

    mm: Mapping[str, float]
    """By axis [mm]; `UNREADABLE` stands among them where the store has lost what they were."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OperationSpeed:
    """Where the spindle speed of one operation stands."""

    key: tuple[float, ...]
    """Tool, programmed speed and feed, depths, kind and place of the operation."""
    programmed_rpm: float
    commanded_rpm: float
    moved: bool
    """The NC has yet to take it."""
    utc_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleSpeeds:
    """The operations of the last hour."""

    operations: tuple[OperationSpeed, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleSpeedSwitch:
    """Who has switched the tuning of the spindle speed off; empty while it is on."""

    off_by: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorsLeft:
    """The state of all sensors when a value of some last counted; lists follow `SensorLevelsDocument.sensor_ids`."""

    away: tuple[int, ...]
    """IDs of those that are away since."""
    utc_s: float
    degc: tuple[float | None, ...]
    trend_k_per_min: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelChange:
    """The shift that a sensor had until a time."""

    utc_s: float
    sensor_id: int
    shift_k: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelJump:
    """By how much a sensor counts at another level since a time, although it was heard all the time."""

    utc_s: float
    sensor_id: int
    jump_k: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelGap:
    """Times within which what sensors were read as says nothing."""

    from_utc_s: float
    to_utc_s: float
    sensor_ids: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorLevelsDocument:
    """What every sensor's level counts as, see `models.sensor_levels`."""

    sensor_ids: tuple[int, ...]
    shift_k: Mapping[int, float]
    uncertainty_k: Mapping[int, float]
    left: tuple[SensorsLeft, ...]
    changes: tuple[LevelChange, ...]
    jumps: tuple[LevelJump, ...] = ()
    gaps: tuple[LevelGap, ...] = ()
    lasting_k: Mapping[int, float] = field(default_factory=dict[int, float])
    away_utc_s: Mapping[int, float] = field(default_factory=dict[int, float])
    reads: Mapping[int, str] = field(default_factory=dict[int, str])
    """What each sensor read, see `TemperaturesConfig.reads`; empty: a version before did not say."""
    excluded: Mapping[int, str] = field(default_factory=dict[int, str])
    """Which were found wrong until the next reference, and by which sign each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlRead:
    """What is read as spindle speed, axis positions and displacements, see `Configuration.other_reads`."""

    reads: Mapping[str, str]
    """Also of what is not configured any more."""
    since_utc_s: Mapping[str, float]
    """Since when, where something else was read before [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InOtherUnit:
    """Inputs that say another unit than is configured; nothing of them counts."""

    units: Mapping[str, str]
    """By name of the input."""
    degc: Mapping[int, float]
    """What counted last of their sensors [degC], by ID."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InputsRead:
    """What lines and sources say, by which it is known that one answers from memory."""

    inputs: Mapping[str, StandingInput]
    """By name; their times are UTC [s]."""
    at_reference: tuple[str, ...] = ()
    """Names of those that stood when the work was positioned."""
