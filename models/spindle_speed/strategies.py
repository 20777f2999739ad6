"""Three ways to choose the spindle speed: none, the dissertation's rule (5-9), and tuning by limiting depth.

Each is asked once with every reading of the temperatures and answers with the pair of speed and feed that is in force.
"""

from dataclasses import dataclass, replace
from typing import Protocol

from models.errors import StabilityError
from models.records import Phase
from models.spindle_speed.choice import resonance_speed_rpm
from models.spindle_speed.planner import LobesOf, MillingOperation, SpeedPlanner
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.tuning import SpeedTuningInputs, SpeedTuningSettings, initial_memory, step
from models.spindle_speed.verification import StabilityVerification


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedInForce:
    """What the NC applies."""

    speed_rpm: float
    feed_mm_min: float
    state: str
    alarm: str | None = None


def pair_at(operation: MillingOperation, speed_rpm: float, state: str) -> SpeedInForce:
    """Return a speed [1/min] with the feed that keeps the programmed feed per tooth."""
    feed_mm_min = operation.feed_mm_min * speed_rpm / operation.demand.programmed_rpm
    return SpeedInForce(speed_rpm=speed_rpm, feed_mm_min=feed_mm_min, state=state)


class SpeedStrategy(Protocol):
    """One way to choose the speed."""

    def renew(self, now_s: float, phase: Phase, known: EstimatedToolPoint | None) -> SpeedInForce:
        """Return the pair in force, given the time [s], what the machine does and what is known of the tool point."""


class ProgrammedSpeed:
    """The programmed speed, whatever happens."""

    def __init__(self, operation: MillingOperation) -> None:
        self._operation = operation

    def renew(self, now_s: float, phase: Phase, known: EstimatedToolPoint | None) -> SpeedInForce:
        """Return the programmed pair."""
        return pair_at(self._operation, self._operation.demand.programmed_rpm, "programmed")


class ResonanceRule:
    """Equation 5-9 on one axis: the speed follows the tracked resonance at every safe block.

    `operation`: what is programmed. `axis`: the axis whose resonance is followed. `offset_hz`: signed f_o [Hz].
    """

    def __init__(self, operation: MillingOperation, *, axis: str, offset_hz: float = 20.0) -> None:
        self._operation, self._axis, self._offset_hz = operation, axis, offset_hz
        self._lobe: int | None = None
        """k_c: at the first safe block, the one whose speed is nearest to the programmed one."""
        self._pair = pair_at(operation, operation.demand.programmed_rpm, "programmed")

    def renew(self, now_s: float, phase: Phase, known: EstimatedToolPoint | None) -> SpeedInForce:
        """Return the pair of the rule; outside the range of speeds the last one stays. Raises StabilityError."""
        if phase is not Phase.SAFE_POINT or known is None:
            return self._pair
        if self._axis not in known.resonance_hz:
            raise StabilityError(f"axis {self._axis} has no resonance to follow; choose the other axis")
        fastest = resonance_speed_rpm(known.resonance_hz[self._axis], self._offset_hz, self._operation.teeth, 1)
        if self._lobe is None:
            self._lobe = max(round(fastest / self._operation.demand.programmed_rpm), 1)
        speed_rpm = fastest / self._lobe
        low, high = self._operation.range_rpm
        if low <= speed_rpm <= high:
            self._pair = pair_at(self._operation, speed_rpm, "followed")
        else:
            text = f"{speed_rpm:.0f} 1/min of the rule lies outside {low:.0f} to {high:.0f}"
            self._pair = replace(self._pair, state="outside", alarm=text)
        return self._pair


class TunedSpeed:
    """The speed nearest to the programmed one that is stable to the depth, commanded by `speed_tuning.step`.

    `operation`: what is programmed. `settings`: hysteresis, dwell, step, filter. `lobes_of`: response -> lobes.
    `check`: verifies each chosen speed; None: the lobes decide.
    """

    def __init__(
        self,
        operation: MillingOperation,
        settings: SpeedTuningSettings,
        lobes_of: LobesOf,
        check: StabilityVerification | None = None,
    ) -> None:
        self._operation, self._settings = operation, settings
        self._planner = SpeedPlanner(operation, lobes_of, check)
        self._memory = initial_memory(operation.demand.programmed_rpm)

    def renew(self, now_s: float, phase: Phase, known: EstimatedToolPoint | None) -> SpeedInForce:
        """Return the pair in force. Raises StabilityError and SpeedTuningError."""
        plan = self._planner.plan(known) if known is not None and not known.inhibit else None
        command, self._memory = step(
            self._memory,
            SpeedTuningInputs(
                now_s=now_s,
                phase=phase,
                enabled=True,
                programmed_rpm=self._operation.demand.programmed_rpm,
                programmed_feed_mm_min=self._operation.feed_mm_min,
                choice=plan.choice if plan is not None else None,
                flagged_span_rpm=plan.flagged_span_rpm if plan is not None else 0.0,
            ),
            self._settings,
        )
        return SpeedInForce(
            speed_rpm=command.speed_rpm, feed_mm_min=command.feed_mm_min, state=command.state.value, alarm=command.alarm
        )
