"""Decides when a planned spindle speed may be commanded: safe blocks, hysteresis, dwell, one pair of S and F.

`step` takes what is known now and what was remembered, and returns the command and the new memory.
It knows neither clock nor wire. Within a cut nothing changes, whatever happens to the data.
"""

import math
from dataclasses import dataclass, replace
from enum import StrEnum

from models.records import Phase


class SpeedTuningError(ValueError):
    """Settings or inputs that no speed can be commanded from; the text says why and what to do."""


class SpeedState(StrEnum):
    """What the tuning is doing."""

    OFF = "OFF"
    """Not enabled: the programmed speed."""
    TUNED = "TUNED"
    """The chosen speed, or the programmed one because it is stable."""
    HOLD = "HOLD"
    """Frozen: within a cut, without data, blocked by a flagged property, or off the stable range for a moment."""
    NO_STABLE_SPEED = "NO_STABLE_SPEED"
    """The programmed speed and an alarm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedTuningSettings:
    """How eagerly the speed follows."""

    hysteresis_rpm: float
    """A target nearer to the command than this changes nothing [1/min]."""
    dwell_s: float
    """A target must last this long [s]."""
    step_rpm: float
    """Greatest change at one safe block inside a pocket [1/min]."""
    filter_s: float = 0.0
    """Time constant that smooths the target inside a pocket [s]; 0: none."""
    keep_feed_per_tooth: bool = True
    """The feed follows the speed."""

    def __post_init__(self) -> None:
        """Refuse what cannot work. Raises SpeedTuningError."""
        bad = [name for name in ("hysteresis_rpm", "step_rpm") if not getattr(self, name) > 0.0]
        bad += [name for name in ("dwell_s", "filter_s") if not getattr(self, name) >= 0.0]
        if bad:
            raise SpeedTuningError(f"{' and '.join(bad)} out of range; hysteresis and step above 0, times at least 0")

    def check_resolution(self, change_per_step_rpm: float) -> None:
        """Refuse settings that one step of a sensor's resolution could set in motion.

        Raises SpeedTuningError when the hysteresis is not above twice that change.

        `change_per_step_rpm`: largest change of the wanted speed per step of one sensor [1/min].
        """
        if not self.hysteresis_rpm > 2.0 * change_per_step_rpm:
            raise SpeedTuningError(
                f"one step of a sensor moves the speed by {change_per_step_rpm:.0f} 1/min and the hysteresis is "
                f"{self.hysteresis_rpm:g}: the speed would hunt; set the hysteresis above "
                f"{2 * change_per_step_rpm:.0f}, or cut less deep"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedChoice:
    """The chosen speed, or the programmed one and an alarm."""

    speed_rpm: float
    limiting_depth_mm: float
    """At that speed [mm]; inf where no lobe limits it, NaN where it is not known."""
    pocket_rpm: tuple[float, float]
    """The stable range that holds the chosen speed [1/min]; the same number twice with an alarm."""
    alarm: str | None = None
    """Why no stable speed was found."""
    margin_met: bool = True
    """The demand is met with its margin; without, this is the deepest speed, stable to the depth itself."""

    @property
    def stable(self) -> bool:
        """Whether the demand is met."""
        return self.alarm is None


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedPlan:
    """The speed that the dynamics of now ask for."""

    choice: SpeedChoice
    flagged_span_rpm: float
    """How far it moves over the physical ranges of flagged properties [1/min]; inf where a mode is lost there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedTuningInputs:
    """Everything that one step may depend on."""

    now_s: float
    """Monotonic time [s]."""
    phase: Phase
    enabled: bool
    programmed_rpm: float
    programmed_feed_mm_min: float
    choice: SpeedChoice | None
    """For the operation and the temperatures of now; None: no data."""
    flagged_span_rpm: float = 0.0
    """How far the target moves when flagged properties go from one end of their range to the other [1/min]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedTuningMemory:
    """Memory of the tuning from step to step."""

    programmed_rpm: float
    """Of the operation that is under way [1/min]; another value begins another operation."""
    commanded_rpm: float
    """Last command [1/min]."""
    begun: bool = False
    """The operation has had its first safe block, so that hysteresis and dwell hold."""
    target_rpm: float = math.nan
    """The smoothed target [1/min]."""
    off_since_s: float = math.nan
    """Since when the target has been off the command by more than the hysteresis [s]; NaN: it is not."""
    last_s: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleSpeedCommand:
    """What is to be written as one pair."""

    speed_rpm: float
    feed_mm_min: float
    state: SpeedState
    reason: str
    due: bool
    """A safe block would change the pair now."""
    write: bool
    """Only at a safe block, and only when the pair changes."""
    jump: bool = False
    """To another pocket, in one."""
    alarm: str | None = None


def initial_memory(programmed_rpm: float) -> SpeedTuningMemory:
    """Return the memory at the start of an operation programmed at a speed [1/min]."""
    return SpeedTuningMemory(programmed_rpm=programmed_rpm, commanded_rpm=programmed_rpm)


def step(
    memory: SpeedTuningMemory, inputs: SpeedTuningInputs, settings: SpeedTuningSettings
) -> tuple[SpindleSpeedCommand, SpeedTuningMemory]:
    """Return the command and the next memory.

    Result: command and memory. Raises SpeedTuningError when the programmed speed or feed is no positive number.

    `memory`: from the step before, or `initial_memory`. `settings`: hysteresis, dwell, step, filter.
    """
    if not (0.0 < inputs.programmed_rpm < math.inf and 0.0 < inputs.programmed_feed_mm_min < math.inf):
        raise SpeedTuningError(
            f"S{inputs.programmed_rpm:g} and F{inputs.programmed_feed_mm_min:g} are no speed and feed; both above 0"
        )
    if inputs.programmed_rpm != memory.programmed_rpm:
        memory = replace(initial_memory(inputs.programmed_rpm), commanded_rpm=memory.commanded_rpm)
    state, target, reason, alarm = _wanted(memory, inputs, settings)
    memory = _watched(memory, inputs, settings, target)
    moved, jump = _moved(memory, inputs, settings, target)
    due = moved != memory.commanded_rpm
    write = due and inputs.phase is Phase.SAFE_POINT
    if inputs.phase is Phase.SAFE_POINT:
        memory = replace(
            memory,
            commanded_rpm=moved,
            begun=memory.begun or state in (SpeedState.TUNED, SpeedState.NO_STABLE_SPEED),
            off_since_s=math.nan if moved == target else memory.off_since_s,
        )
    if state is SpeedState.TUNED and (outside := _outside(memory, inputs, settings)):
        state, reason = SpeedState.HOLD, outside
    if due and inputs.phase is not Phase.SAFE_POINT and state is not SpeedState.OFF:
        reason = f"{reason}; waiting for a safe block"
    elif state is SpeedState.TUNED and inputs.phase is Phase.CUTTING:
        reason = f"{reason}; nothing changes within a cut"
    command = SpindleSpeedCommand(
        speed_rpm=memory.commanded_rpm,
        feed_mm_min=feed_mm_min(inputs, settings, memory.commanded_rpm),
        state=SpeedState.HOLD if inputs.phase is Phase.CUTTING and state is SpeedState.TUNED else state,
        reason=reason,
        due=due,
        write=write,
        jump=jump and write,
        alarm=alarm,
    )
    return command, memory


def feed_mm_min(inputs: SpeedTuningInputs, settings: SpeedTuningSettings, speed_rpm: float) -> float:
    """Return the feed that belongs to a speed [mm/min]: the programmed feed per tooth, or the programmed feed."""
    share = speed_rpm / inputs.programmed_rpm if settings.keep_feed_per_tooth else 1.0
    return inputs.programmed_feed_mm_min * share


def _wanted(
    memory: SpeedTuningMemory, inputs: SpeedTuningInputs, settings: SpeedTuningSettings
) -> tuple[SpeedState, float | None, str, str | None]:
    """Return state, target [1/min] (None: keep the command), reason and alarm.

    What is frozen is the command of this operation; before its first one, the programmed speed.
    """
    if not inputs.enabled:
        return SpeedState.OFF, inputs.programmed_rpm, "not enabled", None
    frozen = None if memory.begun else inputs.programmed_rpm
    if inputs.choice is None:
        return SpeedState.HOLD, frozen, "no valid dynamics; the speed is frozen", None
    if not inputs.flagged_span_rpm <= settings.hysteresis_rpm:
        text = (
            f"a flagged property moves the speed by {inputs.flagged_span_rpm:.0f} 1/min over its physical range, "
            f"more than the hysteresis of {settings.hysteresis_rpm:g}; the speed is frozen"
        )
        return SpeedState.HOLD, frozen, text, text
    if inputs.choice.alarm is not None:
        return SpeedState.NO_STABLE_SPEED, inputs.programmed_rpm, "the programmed speed", inputs.choice.alarm
    return SpeedState.TUNED, inputs.choice.speed_rpm, f"stable to {inputs.choice.limiting_depth_mm:.3g} mm", None


def _watched(
    memory: SpeedTuningMemory, inputs: SpeedTuningInputs, settings: SpeedTuningSettings, target: float | None
) -> SpeedTuningMemory:
    """Smooth the target and note since when it has been off the command; one that has jumped has yet to last."""
    if target is None:
        return replace(memory, target_rpm=math.nan, off_since_s=math.nan, last_s=inputs.now_s)
    smoothed, stayed = target, _one_pocket(memory.target_rpm, inputs)
    if settings.filter_s > 0.0 and stayed:
        elapsed_s = max(inputs.now_s - memory.last_s, 0.0)
        smoothed = target + (memory.target_rpm - target) * math.exp(-elapsed_s / settings.filter_s)
    off = abs(smoothed - memory.commanded_rpm) > settings.hysteresis_rpm
    jumped = not stayed and abs(target - memory.target_rpm) > settings.hysteresis_rpm
    lasts = math.isfinite(memory.off_since_s) and not jumped
    since = (memory.off_since_s if lasts else inputs.now_s) if off else math.nan
    return replace(memory, target_rpm=smoothed, off_since_s=since, last_s=inputs.now_s)


def _outside(memory: SpeedTuningMemory, inputs: SpeedTuningInputs, settings: SpeedTuningSettings) -> str:
    """Return that the command is none of the stable speeds, '' where it is one or the operation has yet to begin."""
    choice, here = inputs.choice, memory.commanded_rpm
    if choice is None or not memory.begun or _one_pocket(here, inputs):
        return ""
    if abs(here - choice.speed_rpm) <= settings.hysteresis_rpm:
        return ""
    low, high = choice.pocket_rpm
    return (
        f"{here:.0f} 1/min is not among the stable speeds, {low:.0f} to {high:.0f}, of which one is taken when it has "
        f"lasted for {settings.dwell_s:g} s"
    )


def _one_pocket(speed_rpm: float, inputs: SpeedTuningInputs) -> bool:
    if inputs.choice is None:
        return False
    low, high = inputs.choice.pocket_rpm
    return low <= speed_rpm <= high


def _moved(
    memory: SpeedTuningMemory, inputs: SpeedTuningInputs, settings: SpeedTuningSettings, target: float | None
) -> tuple[float, bool]:
    """Return the speed that a safe block would take now [1/min], and whether that is a jump.

    Where no speed is stable to the demand, no hysteresis keeps another one than the programmed speed, which the alarm
    names.
    """
    here = memory.commanded_rpm
    if target is None:
        return here, False
    if not inputs.enabled or not memory.begun or (inputs.choice is not None and inputs.choice.alarm is not None):
        return target, abs(target - here) > settings.step_rpm
    if not math.isfinite(memory.off_since_s) or inputs.now_s - memory.off_since_s < settings.dwell_s:
        return here, False
    if inputs.choice is None or not _one_pocket(here, inputs):
        return target, True
    distance = memory.target_rpm - here
    return here + math.copysign(min(abs(distance), settings.step_rpm), distance), False
