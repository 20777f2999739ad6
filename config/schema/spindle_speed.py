"""Tuning of the spindle speed: for which operations, within what, and through which macro variables."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from config.schema.base import MacroNumber, Problems, Seconds, Section, checked, repeated


class SpeedMacrosConfig(Section):
    """The block that carries speed and feed to the CNC, and what the NC program says of its operation."""

    sequence_a: MacroNumber = Field(description="written first; equal to sequence_b: whole", examples=[530])
    for_tool: MacroNumber = Field(description="tool that the pair was made for", examples=[531])
    for_speed: MacroNumber = Field(description="programmed speed that it was made for [1/min]", examples=[532])
    for_feed: MacroNumber = Field(description="programmed feed that it was made for [mm/min]", examples=[533])
    for_depth: MacroNumber = Field(description="axial depth that it was made for, as the call says it", examples=[534])
    for_radial: MacroNumber = Field(description="radial depth that it was made for, as the call says", examples=[535])
    for_kind: MacroNumber = Field(description="K of the call that it was made for", examples=[536])
    speed: MacroNumber = Field(description="spindle speed to take [1/min]", examples=[537])
    feed: MacroNumber = Field(description="feed that belongs to it [mm/min]", examples=[538])
    valid_until: MacroNumber = Field(
        description="CNC clock until which the pair is valid [s]; must lie where power-off clears it (100-199)",
        examples=[121],
    )
    enable: MacroNumber = Field(description="1: the pair counts; 0: the programmed one does", examples=[539])
    check: MacroNumber | None = Field(
        None,
        description="a whole number made of all others that the daemon writes; the program makes it anew and takes "
        "nothing where the two differ. Name one within `writable` that nothing else uses; without it no speed is tuned",
        examples=[541],
    )
    sequence_b: MacroNumber = Field(description="written last", examples=[540])
    calls: MacroNumber = Field(
        description="raised by the NC with each call of the speed program; negative while the call is being written",
        examples=[550],
    )
    called_tool: MacroNumber = Field(description="tool of the operation, by `tool_variable`", examples=[551])
    called_speed: MacroNumber = Field(description="its programmed speed [1/min]", examples=[552])
    called_feed: MacroNumber = Field(description="its programmed feed [mm/min]", examples=[553])
    called_depth: MacroNumber = Field(description="its axial depth [mm]; 0: the configured one", examples=[554])
    called_radial: MacroNumber = Field(description="its radial depth [mm]; 0: that of the case", examples=[555])
    called_kind: MacroNumber = Field(
        description="K of the call, 1 where it says none; 0: this operation is not to be tuned", examples=[556]
    )
    called_text: MacroNumber = Field(description="number of the speed program's text, by its limits", examples=[557])
    echo_speed: MacroNumber = Field(description="speed that the NC has taken [1/min]", examples=[558])
    echo_feed: MacroNumber = Field(description="feed that the NC has taken [mm/min]", examples=[559])
    echo_status: MacroNumber = Field(description="what the speed program did: 0 the pair, else why not", examples=[560])

    @property
    def ours(self) -> tuple[int, ...]:
        """Macros that the daemon writes, in order."""
        return (
            self.sequence_a,
            self.for_tool,
            self.for_speed,
            self.for_feed,
            self.for_depth,
            self.for_radial,
            self.for_kind,
            self.speed,
            self.feed,
            self.valid_until,
            self.enable,
            *(() if self.check is None else (self.check,)),
            self.sequence_b,
        )

    @property
    def numbers(self) -> tuple[int, ...]:
        """All macros: ours first."""
        return tuple(self.model_dump(exclude_none=True).values())

    @checked
    def _distinct(self) -> Problems:
        seen: dict[int, str] = {}
        for key, number in self.model_dump(exclude_none=True).items():
            if number in seen:
                yield (key,), f"#{number} is used twice: it is {seen[number]} already"
            seen.setdefault(number, key)
            if not (100 <= number <= 199 or 500 <= number <= 999):
                yield (key,), f"only common variables (#100-#199, #500-#999) are ours, not #{number}"
        if not 100 <= self.valid_until <= 199:
            yield ("valid_until",), "must be one of #100-#199, which power-off clears"


Frequency = Annotated[float, Field(gt=0)]


class SpeedOperationConfig(Section):
    """One tool whose speed may be tuned, with what it cuts."""

    shipped: ClassVar[Mapping[str, str]] = {"spindles": "machine/data/spindles"}

    tool_number: int = Field(ge=1, description="tool in the spindle, as the CNC numbers it", examples=[7])
    program: int | None = Field(None, ge=1, description="O number; none: any program", examples=[1000])
    spindles: dict[Literal["x", "y"], Path] = Field(
        min_length=1,
        description="spindle file with holder and tool, or the name of one that ships, per machine axis; an axis that "
        "is left out is rigid",
        examples=[{"x": "/etc/toolpoint/spindle_x.yaml", "y": "/etc/toolpoint/spindle_y.yaml"}],
    )
    case: Path = Field(
        description="cutting case (YAML): teeth, engagement, coefficients, feed direction; its x and y are not used",
        examples=["/etc/toolpoint/case.yaml"],
    )
    one_feed_direction: bool = Field(False, description="the feed goes as the case's feed_deg alone; else every way")
    depth_mm: float | None = Field(
        None, gt=0, description="axial depth where the NC program does not say it [mm]", examples=[4.5]
    )
    highest_rpm: float | None = Field(None, gt=0, description="highest speed of the tool [1/min]", examples=[12000.0])
    near_hz: dict[Literal["x", "y"], Frequency] = Field(
        {},
        description="per machine axis, the resonance nearest to this is followed [Hz]; an axis that is left out: its "
        "highest peak",
        examples=[{"x": 650.0}],
    )


class SpindleSpeedConfig(Section):
    """The spindle speed follows the stability pockets. Limits, hysteresis and step have no defaults."""

    program: int = Field(9020, ge=1, le=9999, description="O number of the speed program that the CNC runs")
    tool_variable: int = Field(
        4120, ge=100, le=9999, description="where the NC finds the spindle's tool; on a SINUMERIK R, or 4120: $P_TOOLNO"
    )
    macros: SpeedMacrosConfig = Field(description="macro variables; those that are written, within `writable`")
    thermomechanical_model: Path = Field(
        description="released model of the bearings over temperature (JSON), in a directory that the daemon cannot "
        "write; `toolpoint model release --bearings` puts it there",
        examples=["/var/lib/toolpoint-models/bearings.json"],
    )
    operations: list[SpeedOperationConfig] = Field(min_length=1, description="tools whose speed may be tuned")
    lowest_rpm: float = Field(gt=0, description="lowest speed of the machine [1/min]", examples=[2000.0])
    highest_rpm: float = Field(gt=0, description="highest speed of the machine [1/min]", examples=[12000.0])
    max_change_percent: float = Field(
        gt=0, le=50, description="greatest change against the programmed speed [%]", examples=[15.0]
    )
    hysteresis_rpm: float = Field(
        gt=0, description="a nearer target changes nothing [1/min]; at most tolerance_percent of speed", examples=[50.0]
    )
    step_rpm: float = Field(
        gt=0, description="greatest change at one safe block inside a pocket [1/min]", examples=[200.0]
    )
    dwell_s: float = Field(20.0, ge=0, description="a target must last this long [s]")
    filter_s: float = Field(0.0, ge=0, description="time constant that smooths the target inside a pocket [s]; 0: none")
    keep_feed_per_tooth: bool = Field(True, description="the feed follows the speed; else the programmed feed stays")
    offset_hz: float | None = Field(
        None,
        description="choose only speeds whose tooth-passing frequency, or a harmonic of it, lies this far below a "
        "resonance [Hz]; negative: above; none: every speed",
        examples=[20.0],
    )
    margin_percent: float = Field(20.0, ge=0, le=500, description="limiting depth over the programmed one [%]")
    tolerance_percent: float = Field(2.0, ge=0, le=20, description="it holds this far to both sides of the speed [%]")
    verify_with_sdm: bool = Field(
        True,
        description="verify a chosen speed by the spectral radius that the semi-discretisation (SDM) has, which knows "
        "the flanks of pockets; what cannot be verified is denied",
    )
    sensor_step_k: float = Field(
        0.0625, gt=0, le=1, description="resolution of a sensor [K]; the hysteresis must exceed twice what it moves"
    )
    read_period_s: Seconds = Field(1.0, description="time between two readings of the operation")
    stale_after_s: Seconds = Field(60.0, description="without newer dynamics for this long the speed is frozen")
    validity_s: Seconds = Field(30.0, description="how far valid_until lies ahead of the CNC's clock")

    @checked
    def _sensible(self) -> Problems:
        for index, operation in enumerate(self.operations):
            for axis in operation.near_hz:
                if axis not in operation.spindles:
                    yield ("operations", index, "near_hz", axis), f"there is no spindle along {axis}"
        if self.lowest_rpm >= self.highest_rpm:
            yield ("lowest_rpm",), "must be below highest_rpm"
        for index, operation in enumerate(self.operations):
            if operation.highest_rpm is not None and operation.highest_rpm <= self.lowest_rpm:
                yield ("operations", index, "highest_rpm"), "must be above lowest_rpm"
        highest_rpm = min(self.highest_of(operation) for operation in self.operations)
        if self.hysteresis_rpm > (allowed_rpm := self.tolerance_rpm(highest_rpm)):
            text = f"more than tolerance_percent allows at the highest speed of {highest_rpm:g}: {allowed_rpm:g} 1/min"
            yield ("hysteresis_rpm",), f"{text} off the command is verified; change one of the two"
        for index, key in repeated((operation.tool_number, operation.program) for operation in self.operations):
            yield ("operations", index, "tool_number"), f"T{key[0]} is there already"
        if self.validity_s <= 3.0 * self.read_period_s:
            yield ("validity_s",), "must exceed three read_period_s, or the pair expires before the next reading"

    def tolerance_rpm(self, speed_rpm: float) -> float:
        """Return how far from a speed [1/min] what is verified of it holds [1/min]."""
        return self.tolerance_percent / 100.0 * speed_rpm

    def highest_of(self, operation: SpeedOperationConfig | None) -> float:
        """Return the highest speed of machine and tool [1/min]."""
        tool_rpm = None if operation is None else operation.highest_rpm
        return self.highest_rpm if tool_rpm is None else min(self.highest_rpm, tool_rpm)

    def operation_of(self, tool_number: int, program: int) -> SpeedOperationConfig | None:
        """Return the operation of a tool in a program; one that names the program goes before one that does not."""
        fitting = [
            each for each in self.operations if each.tool_number == tool_number and each.program in (None, program)
        ]
        return min(fitting, key=lambda each: each.program is None, default=None)
