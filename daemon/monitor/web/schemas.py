"""The documents of the API as its OpenAPI document describes them; units stand in the names of the keys."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from daemon.monitor.accounts import MOST_PASSWORD, Role
from daemon.snapshots import ModelSnapshot, WriteCounts
from models.records import OutputState

Utc = Annotated[float, Field(description="UTC [s since 1970]")]
Outcome = Literal["intended", "verified", "differs", "failed", "refused"]


class Document(BaseModel):
    """An answer; it names every key that it may hold. What FastAPI reads is made at once, or it warns in the log."""

    model_config = ConfigDict(extra="forbid", defer_build=True)


class Delays(Document):
    """Mean and percentiles of the latest delays [s]; null without samples."""

    mean: float | None
    p50: float | None
    p99: float | None
    p999: float | None
    max: float | None
    samples: int


class AxisStatus(Document):
    """One axis: what is estimated, asked for, written and applied."""

    channel: str | None = Field(description="model channel that is this axis' thermal error; null: the axis has none")
    estimated_um: float | None = Field(description="thermal error since the reference: the error without compensation")
    remaining_um: float | None = Field(description="what of it is left with what is applied since the reference")
    requested_um: float | None = Field(description="what the estimate asks for, before the limits")
    written_um: float | None = Field(description="what stands in the CNC, after bound, slew rate and deadband")
    applied_um: float | None = Field(description="what the guard in the CNC says that it applies")
    band_um: float | None = Field(description="half width of the estimate's band")
    bound_um: float | None = Field(description="the compensation never exceeds this")
    baseline_um: float | None = Field(description="what was applied when the reference was set")
    tool_um_per_k: dict[str, float] = Field(
        description="how far the tool's own growth moves this axis for 1 K more of each label since the reference"
    )
    wanted: bool = Field(description="a person has switched it on")
    enabled: bool = Field(description="its enable bit is written")
    confidence: float | None = Field(description="how far the estimate may be followed, 0 to 1")
    limits_hit: list[str] = Field(description="limits that act now: bound, slew, step")
    unit: str | None = Field(None, description="um/m where this is a slope along an axis; else left out, and um")
    pivot_mm: float | None = Field(
        None, description="of an axis with a slope: its numbers hold there, elsewhere the slope comes on top"
    )


class ReferenceStatus(Document):
    """The instant at which the thermal error is zero by definition."""

    id: str
    source: str
    time: Utc
    age_s: float
    program: int
    work_offset: int


class SpindleSpeedStatus(Document):
    """The spindle speed, and the tuning where it is configured."""

    configured: bool
    actual_rpm: float | None
    why: str = Field(description="why the speed is what it is")
    state: str | None = None
    switched_on: bool | None = None
    programmed_rpm: float | None = None
    written_rpm: float | None = None
    target_rpm: float | None = Field(None, description="target of the latest plan")


class LinkStatus(Document):
    """One link to the machine."""

    name: str
    up: bool
    problem: str = Field(description="why it is down, empty while it is up")
    losses: int
    last_problem: str
    last_problem_time: float | None


class SensorCounts(Document):
    """How many sensors there are, have a usable value, and have a good one."""

    total: int
    usable: int
    good: int


class LatencySummary(Document):
    """The delay beside the published one."""

    measurement: Delays
    feedback: Delays
    total: Delays
    published_s: float


class Who(Document):
    """Who is logged in."""

    name: str | None = Field(description="null: nobody is logged in")
    role: Role | None = Field(description="null: log in to see anything")
    csrf: str | None = Field(description="goes into the header x-csrf-token of every action")
    expires: float | None = Field(description="the login ends then at the latest, UTC [s]")
    accounts: bool = Field(description="the monitor has accounts; without, anybody who reaches it looks, nobody acts")


class Status(Document):
    """Everything that the overview shows."""

    machine: str
    version: str = Field(description="of the daemon; when it changes, its pages are loaded anew")
    time: Utc
    clock_speed: float = Field(description="seconds of the machine in a second: 1, or more in a simulation")
    age_s: float | None = Field(description="age of the newest temperatures; null before the first")
    state: OutputState
    reason: str
    since_s: float | None
    phase: str
    alarm: str
    fault: int = Field(description="number of the newest FAULT, also of one that is acknowledged; 0: there was none")
    problems: list[str] = Field(description="what a person should look at, the gravest first")
    notices: list[str]
    axes: dict[str, AxisStatus]
    reference: ReferenceStatus | None
    reference_ended: str = Field(description="why there is no reference")
    spindle_speed: SpindleSpeedStatus
    links: list[LinkStatus]
    model: ModelSnapshot | None
    sensors: SensorCounts
    writes: WriteCounts
    latency: LatencySummary
    user: Who | None = Field(None, description="only where the status is asked for, not in events")


class Health(Document):
    """Whether the output may act and every link is up."""

    healthy: bool
    state: OutputState
    reason: str


class SeriesName(Document):
    """One series that can be asked for."""

    name: str
    kind: Literal[
        "temperature",
        "label",
        "label_reference",
        "estimated",
        "band",
        "measured",
        "requested",
        "written",
        "applied",
        "spindle",
        "motor",
    ]
    unit: Literal["degC", "um", "um/m", "1/min"]
    component: str | None = None
    part: str | None = None
    label: str | None = None
    sensor: int | None = None
    axis: str | None = None
    channel: str | None = None
    position: list[float] | None = Field(None, description="on the drawing of the machine, where it is known")


class Names(Document):
    """The series that exist, and from when to when something is recorded."""

    series: list[SeriesName]
    first: float | None = Field(description="first recorded time, UTC [s]; null while nothing is")
    last: float | None


class Series(Document):
    """One series, decimated: of each bucket its mean time, least, greatest and mean value."""

    t: list[float]
    min: list[float]
    max: list[float]
    mean: list[float]


class Sensor(Document):
    """One sensor now."""

    name: str
    id: int
    component: str
    part: str | None
    label: str | None
    degc: float | None = Field(description="cleansed; null where it has no usable value")
    measured_degc: float | None = Field(description="as it came over the wire")
    quality: Literal["good", "held", "missing"]
    reason: str = Field(description="why it is not good, in words")
    age_s: float | None = Field(description="time since its last accepted value")


class Sensors(Document):
    """All sensors now."""

    time: float | None
    sensors: list[Sensor]
    line_faults: dict[str, list[str]] = Field(description="faults of each line's latest pass")


class ReferenceMark(Document):
    """A reference that was set."""

    id: str
    time: Utc
    source: str


class Contribution(Document):
    """How much of a channel's estimate one sensor carries."""

    sensor: int
    component: str
    part: str | None
    um: float


class ChannelEstimate(Document):
    """One channel of the model."""

    thermal_error_um: float | None
    band_um: float | None
    measured_um: float | None = Field(description="measured since the reference, where the machine measures it")
    residual_um: float | None = Field(description="measured minus estimated")
    pivot_mm: float | None = Field(
        None, description="of an axis with a slope: where thermal_error_um holds; measured and residual: at position_mm"
    )
    position_mm: float | None = Field(None, description="of an axis with a slope: where it stands, null: not known")
    not_judged: str | None = Field(None, description="of an axis with a slope: why measured and residual are null")
    axes: list[str]
    unit: str | None = Field(None, description="um/m where this is a slope along an axis; else left out, and um")
    contributions: list[Contribution] | None = Field(
        description="by sensor, the largest first; null where the model does not tell, or nobody asked"
    )


class Estimate(Document):
    """The estimate now."""

    time: float | None
    model_id: str | None
    reference: str | None
    confidence: float | None
    in_domain: bool | None
    imputed: list[int] = Field(description="sensors that were imputed")
    channels: dict[str, ChannelEstimate]
    references: list[ReferenceMark] = Field(description="of the last 24 hours")
    why: str = Field(description="why there is no estimate; empty when there is one")


class Write(Document):
    """One write in the audit."""

    id: int
    time: Utc
    cause: str
    person: str | None
    state: str | None
    reason: str | None
    requested_um: dict[str, float | None]
    compensation_um: dict[str, float | None]
    applied_um: dict[str, float | None]
    limits_hit: list[str]
    macros: list[list[float | None]] = Field(description="number and value, in the order written")
    old: list[float | None] = Field(description="what each of them held before, as far as the audit knows")
    read_back: list[float | None]
    outcome: Outcome
    detail: str | None
    model_id: str | None
    delay_s: dict[str, float]
    echoed_after_s: float | None


class Writes(Document):
    """Writes, the newest first."""

    writes: list[Write]
    more: bool = Field(description="there are older ones in the interval")


class Event(Document):
    """Something that happened."""

    time: Utc
    kind: str
    text: str
    person: str | None


class Events(Document):
    """What happened, the newest first."""

    events: list[Event]
    kinds: dict[str, int] = Field(description="kind -> how many hold the text in the interval, whatever `kind` asks")
    more: bool = Field(description="there are older ones in the interval")


class Distribution(Document):
    """How many values lie between each two edges."""

    edges: list[float] = Field(description="one more than counts [s]")
    counts: list[int]


class Latency(Document):
    """Delays of every stage beside the published means."""

    stages: dict[str, Delays]
    published_s: dict[str, float]
    published_note: str
    histograms: dict[str, Distribution] = Field(description="of the latest delays, by stage")


class WorkingPoint(Document):
    """Where the spindle cuts."""

    speed_rpm: float | None = Field(description="as applied from the block, else as programmed")
    target_rpm: float | None = Field(description="of the latest plan; the NC takes it over at its next safe point")
    depth_mm: float | None = Field(description="the depth that the plan must allow; null before a plan")
    limiting_depth_mm: float | None = Field(description="what is stable there; null where it is not known")


class Lobes(Document):
    """The border of stability."""

    speed_rpm: list[float]
    limiting_depth_mm: list[float | None] = Field(description="null where no lobe limits it")


class Response(Document):
    """The tool point's frequency response."""

    frequency_hz: list[float]
    magnitude_um_per_n: dict[str, list[float]] = Field(description="by axis")


class Resonance(Document):
    """The resonance that the plans were made for, over time."""

    t: list[float]
    hz: dict[str, list[float | None]] = Field(description="by axis")


class Dynamics(Document):
    """What the operation under way was planned from; the curves come with its first plan."""

    operation: str | None
    state: str
    why: str
    working_point: WorkingPoint
    lobes: Lobes | None = None
    response: Response | None = None
    resonance: Resonance | None = None


class BandScore(Document):
    """How wide the band of one channel is, beside what a release takes."""

    channel: str
    band_um: float | None = Field(description="half width of the band on what was held out; null: nothing was")
    widest_um: float | None = Field(description="a wider band is not released; null: no axis follows the channel")
    unit: str | None = Field(None, description="um/m where this is a slope along an axis; else left out, and um")


class Scores(Document):
    """What a model's training says of it."""

    kind: str
    created: str
    recordings: list[str] = Field(description="what it was trained on")
    hours: float
    error_left: float | None = Field(
        description="RMSE with the model / without, on what was held out, mean of the channels: 1 and more would do "
        "harm; null: the file does not say"
    )
    refused: str = Field(description="why its own training refuses it; empty when it does not")
    bands: list[BandScore]


class Release(Document):
    """One release."""

    release: int
    model_id: str
    action: Literal["release", "rollback"]
    released_by: str
    released: str
    note: str
    checks: list[str] = Field(description="what was checked and found good")
    sha256: str


class Candidate(Document):
    """A model that waits among the proposals."""

    file: str
    model_id: str
    sha256: str
    released_as: int | None = Field(description="number of the release that holds this file")
    against: str = Field(description="why a release would refuse it now; empty when nothing stands against it")
    scores: Scores | None = Field(description="null: the file cannot be read as a model of this machine")


class Models(Document):
    """Models in force, releases, candidates, scores."""

    thermal: ModelSnapshot | None
    scores: Scores | None = Field(description="of the thermal model in force")
    bearings: ModelSnapshot | None
    releases: list[Release] = Field(description="the newest first")
    candidates: list[Candidate] = Field(description="the newest first")
    note: str


class Decided(Document):
    """What came of an action."""

    decided: bool = Field(description="false: the output has not decided yet; look at the status")
    state: str | None = None
    reason: str | None = None
    alarm: str | None = None


class Login(Document, defer_build=False):
    """Name and password."""

    name: str = Field(min_length=1, max_length=64)
    password: str = Field(min_length=1, max_length=MOST_PASSWORD)


class Enable(Document, defer_build=False):
    """What to switch on."""

    axes: list[Annotated[str, Field(min_length=1, max_length=32)]] | None = Field(
        None, min_length=1, max_length=16, description="none: every axis that has a model"
    )
    spindle_speed: bool = Field(False, description="the tuning of the spindle speed instead")


class Disable(Enable):
    """What to switch off."""

    zero: bool = Field(False, description="retreat to zero instead of to where the reference left it")


class Acknowledge(Document, defer_build=False):
    """Which FAULT is acknowledged: a newer one than that is not cleared."""

    fault: int = Field(ge=1, lt=2**31, description="its number, as the status tells it")


class ExportWhat(StrEnum):
    """What can be downloaded."""

    RECORDING = "recording"
    TEMPERATURES = "temperatures"
    WRITES = "writes"
    EVENTS = "events"


class ExportFormat(StrEnum):
    """In which form."""

    CSV = "csv"
    PARQUET = "parquet"
