"""What may move the machine, how far and how fast."""

import math
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from config.schema.base import ChannelName, Days, KeyPath, MacroNumber, Name, Problems, Seconds, Section, checked

SequenceNumber = Annotated[int, Field(ge=0, le=99_999_999)]

SHARED_LIMITS = ("absolute_bound_um", "slew_um_per_min", "step_um")
"""Limits of an axis that its offset and its slope share."""


class ToolTermConfig(Section):
    """Thermal expansion of the tool between the spindle nose and the tool point."""

    length_mm: float = Field(gt=0, description="length from the spindle nose to the tool point [mm]", examples=[150.0])
    expansion_um_per_m_k: float = Field(11.0, gt=0, description="expansion coefficient [um/(m K)]")
    temperatures: dict[str, float] = Field(
        description="sensor labels and their weights; the weighted mean stands for the tool's temperature",
        examples=[{"Nose": 0.5, "Room": 0.5}],
    )
    direction: int = Field(-1, description="+1 or -1: the axis direction in which a longer tool moves its point")

    @checked
    def _sensible(self) -> Problems:
        if self.direction not in (-1, 1):
            yield ("direction",), "direction is +1 or -1"
        elif abs(sum(self.temperatures.values()) - 1.0) > 1e-6:
            total = sum(self.temperatures.values())
            yield ("temperatures",), f"the weights must sum to 1; they sum to {total:g}"


class SlopeConfig(Section):
    """Makes an entry of `axes` a slope along an axis: its micrometres count at one metre from the pivot (um/m)."""

    of: Name = Field(description="axis that the slope acts on", examples=["z"])
    pivot_mm: float = Field(
        ge=-100_000,
        le=100_000,
        allow_inf_nan=False,
        description="machine position at which the slope adds nothing [mm]: the model's pivot, and SD43920 on a "
        "SINUMERIK; on a FANUC and LinuxCNC the guard puts the slope in for where the axis stands when it is called",
        examples=[250.0],
    )
    travel_mm: tuple[float, float] = Field(
        description="lowest and highest machine position of the axis [mm]: between them offset and slope together stay "
        "within the axis' bound, slew rate and step; outside, the guard of a FANUC or LinuxCNC refuses with status 12",
        examples=[[0.0, 500.0]],
    )

    @checked
    def _sensible(self) -> Problems:
        lowest, highest = self.travel_mm
        if not -math.inf < lowest < highest < math.inf:
            yield ("travel_mm",), "the lowest position comes first, then the highest [mm]"

    @property
    def reach_m(self) -> float:
        """Distance from the pivot to the farther end of the travel [m]."""
        return max(abs(end - self.pivot_mm) for end in self.travel_mm) / 1000.0


class AxisConfig(Section):
    """One axis of the machine. Bound, slew rate and step have no defaults: a person must choose them."""

    estimate: ChannelName | None = Field(
        None,
        description="model channel that is this axis' thermal error; none: the axis stays disabled",
        examples=["Z1"],
    )
    tool_term: ToolTermConfig | None = Field(None, description="added for a cutting tool")
    absolute_bound_um: float = Field(
        gt=0, le=1000, description="the compensation never exceeds this [um]", examples=[50.0]
    )
    slew_um_per_min: float = Field(
        gt=0, le=100, description="the compensation never moves faster than this [um/min]", examples=[2.0]
    )
    step_um: float = Field(
        gt=0, le=100, description="the guard macro never applies a larger change at once [um]", examples=[5.0]
    )
    deadband_um: float = Field(0.1, ge=0, description="a smaller change of the request is not written [um]")
    slope: SlopeConfig | None = Field(
        None, description="this entry is a slope along another axis, and all its um are um/m; none: an offset"
    )

    @checked
    def _sensible(self) -> Problems:
        if self.deadband_um >= self.absolute_bound_um:
            yield ("deadband_um",), "must be below absolute_bound_um, or nothing is ever written"
        elif self.tool_term is not None and self.estimate is None:
            yield ("tool_term",), "an axis without `estimate` stays disabled and takes no tool term"
        elif self.tool_term is not None and self.slope is not None:
            yield ("tool_term",), "a slope takes no tool term: a tool grows the same everywhere"


class ReferenceConfig(Section):
    """When the thermal error is zero by definition: after work positioning."""

    program: int | None = Field(
        None, ge=1, description="O number whose sequence numbers count; none: any program", examples=[1000]
    )
    sequence_numbers: list[SequenceNumber] = Field(
        default_factory=list, description="passing one of these N numbers sets the reference"
    )
    policy: Literal["bumpless", "zero_first"] = Field(
        "bumpless",
        description="bumpless: what is applied at work positioning becomes the baseline; zero_first: it is taken out "
        "before, and a positioning with an offset sets no reference",
    )
    retreat_sequence_numbers: list[SequenceNumber] = Field(
        default_factory=list,
        description="zero_first: passing one of these N numbers ends the reference and takes the offset out",
    )
    positioning_dwell_s: Seconds | None = Field(
        None,
        description="the program stands at each of `sequence_numbers` at least this long; a gap between two polls that "
        "is as long or longer while the program ran may hide a positioning and ends the reference, unless the control "
        "proves the contrary; longer than cnc.poll_period_s; none: two poll periods",
        examples=[2.0],
    )
    positioning_counter: MacroNumber | None = Field(
        None,
        description="macro that the NC program raises before every positioning: unchanged over a gap between two polls "
        "it proves that none was missed, and raised it ends the reference until the block of `sequence_numbers` is "
        "seen; none: there is no such macro",
        examples=[560],
    )
    tool_counter: MacroNumber | None = Field(
        None,
        description="macro that the NC raises with every tool change: raised, the tool in the spindle is one that has "
        "just come, also where the number that a poll shows is the same; none: there is no such macro",
        examples=[561],
    )
    max_gap_s: Seconds | None = Field(
        None,
        description="no longer used, and refused from the next version on: `positioning_dwell_s` says what counts",
        examples=[5.0],
    )
    probe_bound_um: float = Field(
        20.0, gt=0, le=500, description="a probe value that would correct the estimate by more is refused [um]"
    )
    probe_noise_um: float | None = Field(
        None,
        ge=0,
        le=50,
        description="standard deviation of a probe value [um]: the noisier the probe, the less it moves the estimate; "
        "none: values that are repeated within two minutes tell it, and until there are three a probe counts as exact",
        examples=[1.0],
    )
    mean_s: Seconds = Field(60.0, description="the reference is the mean of this long; so is the model's input")
    max_outage_s: Seconds = Field(
        600.0, description="after a longer outage of the daemon an old reference is not used again"
    )

    @checked
    def _consistent(self) -> Problems:
        if self.policy == "zero_first" and not self.retreat_sequence_numbers:
            sentence = "zero_first needs to know where the program is before its next positioning: name N numbers"
            yield ("retreat_sequence_numbers",), sentence


class OutputConfig(Section):
    """Timing of the output and when it holds or retreats."""

    tick_s: Seconds = Field(1.0, description="the control tick: renews valid_until, feeds the watchdog")
    validity_s: Seconds = Field(30.0, description="how far valid_until lies ahead of the CNC's clock")
    stale_after_s: Seconds = Field(60.0, description="an estimate older than this and 2.5 cycle periods: HOLD")
    alarm_after_s: Seconds = Field(300.0, description="frozen for longer than this raises the alarm")
    hold_limit_s: Seconds = Field(600.0, description="frozen for longer than this retreats (RETREAT)")
    min_confidence: float = Field(
        0.7, ge=0, le=1, description="below this confidence (what the estimate is worth, 0 to 1) the output holds"
    )
    full_confidence: float = Field(
        0.9,
        ge=0,
        le=1,
        description="from this confidence on the estimate counts whole; between min_confidence and this its weight "
        "rises from 0 to 1, and changes only between cuts",
    )
    guard_alarm_after_s: Seconds = Field(
        1800.0, description="alarm when the guard has not run for longer than this while the program runs"
    )
    harm_above_um: float = Field(
        5.0,
        gt=0,
        le=500,
        description="where displacements or probes show that the estimate leaves more than this, and more than there "
        "would be without it, the output holds [um]",
    )
    safe_sequence_numbers: list[SequenceNumber] = Field(
        default_factory=list, description="N numbers at which the tool is away from the work (safe points)"
    )

    @checked
    def _ordered(self) -> Problems:
        if not self.stale_after_s <= self.alarm_after_s <= self.hold_limit_s:
            sentence = "stale_after_s <= alarm_after_s <= hold_limit_s must hold"
            yield ("alarm_after_s",), sentence
        elif self.full_confidence < self.min_confidence:
            yield ("full_confidence",), "must not be below min_confidence"
        elif self.validity_s <= self.tick_s:
            yield ("validity_s",), "must be longer than tick_s, or the block expires between two ticks"


class ReleaseConfig(Section):
    """What a thermal model must fulfil before it is released, and who may do it."""

    largest_band_um: float | None = Field(
        None,
        gt=0,
        description="a wider prediction band of a channel in use refuses a model [um]; none: the axis' absolute bound",
        examples=[10.0],
    )
    automatic: bool = Field(
        False, description="the release service may release a proposal without a person (`model release --by-policy`)"
    )


class RetrainingConfig(Section):
    """Proposals that the daemon trains by itself on its own history; releasing them is another matter."""

    every_hours: float = Field(8.0, ge=0.5, le=744, description="time between proposals [h]")
    days: Days = Field(30.0, description="so much of the history is trained on [d]")
    model: Literal["default", "increments", "increments-b0", "ridge", "pls", "lasso"] = Field(
        "default", description="family of models"
    )


class CompensationConfig(Section):
    """From estimate to command."""

    model_file: Path | None = Field(
        None,
        description="released thermal model (JSON), in a directory that the daemon cannot write; "
        "without it nothing is estimated",
        examples=["/var/lib/toolpoint-models/model.json"],
    )
    allow_writable_model_directory: bool = Field(
        False, description="load a model although the daemon could write it or it was not released (shown everywhere)"
    )
    release: ReleaseConfig = Field(default_factory=ReleaseConfig, description="release of thermal models")
    retraining: RetrainingConfig | None = Field(
        None, description="regular training of proposals on measured displacements; none: never"
    )
    commissioning_file: Path | None = Field(
        None,
        description="record of the commissioning of this machine; without it nothing is enabled",
        examples=["/etc/toolpoint/commissioning.json"],
    )
    axes: dict[Name, AxisConfig] = Field(
        min_length=1,
        max_length=9,
        description="the axes, in the order of the enable bits",
        examples=[{"z": {"estimate": "Z1", "absolute_bound_um": 50.0, "slew_um_per_min": 2.0, "step_um": 5.0}}],
    )
    reference: ReferenceConfig = Field(default_factory=ReferenceConfig, description="work positioning")
    output: OutputConfig = Field(default_factory=OutputConfig, description="timing and states")

    @checked
    def _slopes_leave_room(self) -> Problems:
        sloped: dict[str, str] = {}
        for name, slope in self.slopes.items():
            at: KeyPath = ("axes", name, "slope", "of")
            if slope.of not in self.axes or slope.of in self.slopes:
                offsets = ", ".join(axis for axis in self.axes if axis not in self.slopes)
                yield at, f"there is no axis {slope.of} that takes an offset; there are {offsets or 'none'}"
            elif slope.of in sloped:
                yield at, f"{sloped[slope.of]} is the slope of {slope.of} already"
            else:
                yield from self._without_room(name, slope)
            sloped.setdefault(slope.of, name)

    def _without_room(self, name: str, slope: SlopeConfig) -> Problems:
        """Yield which limits of a slope leave its axis' offset nothing."""
        for key in SHARED_LIMITS:
            of_slope, of_axis = getattr(self.axes[name], key), getattr(self.axes[slope.of], key)
            if (taken := of_slope * slope.reach_m) >= of_axis:
                sentence = (
                    f"makes {taken:g} um at {1000.0 * slope.reach_m:g} mm from the pivot, the far end of the travel, "
                    f"and leaves the offset nothing of the {of_axis:g} um of compensation.axes.{slope.of}.{key}"
                )
                yield ("axes", name, key), sentence

    @property
    def slopes(self) -> dict[str, SlopeConfig]:
        """Entries of `axes` that are slopes, by name."""
        return {name: axis.slope for name, axis in self.axes.items() if axis.slope is not None}

    @property
    def pivots_mm(self) -> dict[str, float]:
        """Machine position at which each slope adds nothing [mm], by the name of its entry."""
        return {name: slope.pivot_mm for name, slope in self.slopes.items()}

    @property
    def asked_for(self) -> tuple[str, ...]:
        """Axes that a request of the NC program may name by their places, '' for a slope, which it may not."""
        return tuple("" if axis in self.slopes else axis for axis in self.axes)

    @property
    def slope_channels(self) -> frozenset[str]:
        """Model channels that are slopes along an axis [um/m]."""
        return frozenset(axis.estimate for axis in self.axes.values() if axis.slope is not None and axis.estimate)

    def unit_of(self, axis: str) -> dict[str, str]:
        """Return what status says of the unit of a slope; nothing of an offset, which is in um."""
        return {"unit": "um/m"} if axis in self.slopes else {}

    def pivot_of(self, axis: str) -> dict[str, float]:
        """Return what status says of an offset that has a slope: where its numbers hold; nothing of others."""
        pivots_mm = [slope.pivot_mm for slope in self.slopes.values() if slope.of == axis]
        return {"pivot_mm": pivots_mm[0]} if pivots_mm else {}

    @cached_property
    def outputs(self) -> dict[str, AxisConfig]:
        """The axes with what offset and slope may do alone, so that they never exceed an axis' limits together.

        What the slope may make at the far end of the travel is taken off the offset's bound, slew rate and step.
        """
        found = dict(self.axes)
        for name, slope in self.slopes.items():
            whole = found[slope.of]
            left = {key: getattr(whole, key) - getattr(found[name], key) * slope.reach_m for key in SHARED_LIMITS}
            found[slope.of] = whole.model_copy(update=left)
        return found
