"""Plans the speed of an operation from the dynamics of the tool point, and says how sure it is.

This is the slow half of the tuning: it computes lobes, and may run anywhere. The quick half, `speed_tuning.step`,
decides what of it is commanded, and when.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from models.spindle_speed.choice import (
    SpeedDemand,
    choose_speed,
    deepest_speed,
    least_depth_mm,
    limiting_depth_mm,
    rule_candidates_rpm,
    stable_range_rpm,
)
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.tuning import SpeedChoice, SpeedPlan
from models.spindle_speed.verification import StabilityVerification
from models.stability.lobes import StabilityLobes
from models.stability.response import ToolPointResponse

LEAST_WIDTH = 0.005
"""At least this share of a speed that is denied is left out to both sides."""
MOST_TRIALS = 12
"""Speeds that are verified before none is taken to be stable."""
EDGE_WIDTH = 2e-4
"""Where verified speeds begin is known to this share of the speed."""
LobesOf = Callable[[ToolPointResponse], StabilityLobes]
"""Response at the tool point -> lobes over the range of speeds that is allowed, better a little beyond it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MillingOperation:
    """What is programmed, and within what the speed may be."""

    demand: SpeedDemand
    feed_mm_min: float
    teeth: int
    range_rpm: tuple[float, float]
    """Lowest and highest speed allowed [1/min]."""
    offset_hz: float | None = None
    """Signed f_o [Hz]: only speeds of equation 5-9 are candidates, of both axes and every lobe; None: all speeds."""


class SpeedPlanner:
    """Plans the speed of one operation.

    `operation`: what is programmed. `lobes_of`: response -> lobes. `check`: verifies each chosen speed; None: the lobes
    decide.
    """

    def __init__(
        self, operation: MillingOperation, lobes_of: LobesOf, check: StabilityVerification | None = None
    ) -> None:
        self.operation = operation
        self._lobes_of = lobes_of
        self._check = check
        self._ends: tuple[tuple[EstimatedToolPoint | None, ...], list[SpeedChoice]] = ((), [])

    def lobes(self, response: ToolPointResponse) -> StabilityLobes:
        """Return the lobes over the allowed speeds that it plans by; raises StabilityError."""
        return self._lobes_of(response)

    def plan(self, known: EstimatedToolPoint) -> SpeedPlan:
        """Return the plan for the dynamics of now; raises StabilityError."""
        choice = self.choice(known)
        return SpeedPlan(choice=choice, flagged_span_rpm=self._span_rpm(choice, known))

    def choice(self, known: EstimatedToolPoint) -> SpeedChoice:
        """Return the speed that some dynamics ask for; raises StabilityError, also where these cannot be verified.

        Where no speed is stable with its margin, the deepest one is taken if it is stable to the depth itself: the
        programmed one is no better. A speed whose verification denies it is left out, with its tolerance; what is
        taken then is the nearest verified speed, so that it moves with the dynamics and does not jump.
        """
        operation, candidates = self.operation, None
        if self._check is not None:
            self._check.modes(known.response)
        if operation.offset_hz is not None:
            candidates = rule_candidates_rpm(
                tuple(known.resonance_hz.values()), operation.offset_hz, operation.teeth, operation.range_rpm
            )
        lobes, demand = self._lobes_of(known.response), operation.demand
        choice = choose_speed(lobes, demand, range_rpm=operation.range_rpm, candidates_rpm=candidates)
        denied = dict[float, str]()
        if choice.stable:
            if not (denial := self._denial(known, lobes, choice.speed_rpm)):
                return choice
            denied[choice.speed_rpm] = denial
            low_rpm, high_rpm = operation.range_rpm
            programmed_rpm = min(max(demand.programmed_rpm, low_rpm), high_rpm)
            sides = [
                self._verified(known, lobes, side, candidates, denied)
                for side in ((low_rpm, programmed_rpm), (programmed_rpm, high_rpm))
            ]
            if found := [each for each in sides if each is not None]:
                return min(found, key=lambda each: abs(each.speed_rpm - programmed_rpm))
        deepest = deepest_speed(_without(lobes, denied, demand), demand, operation.range_rpm)
        if deepest is not None:
            if not (denial := self._denial(known, lobes, deepest.speed_rpm)):
                return deepest
            denied[deepest.speed_rpm] = denial
        if not denied:
            return choice
        return SpeedChoice(
            speed_rpm=demand.programmed_rpm,
            limiting_depth_mm=limiting_depth_mm(lobes, demand.programmed_rpm),
            pocket_rpm=(demand.programmed_rpm, demand.programmed_rpm),
            alarm=f"none of {len(denied)} speeds that the lobes offer is verified: "
            f"{next(iter(denied.values()))}; the programmed {demand.programmed_rpm:g} 1/min stays: cut less deep or "
            "widen the limits",
        )

    def _denial(self, known: EstimatedToolPoint, lobes: StabilityLobes, speed_rpm: float) -> str:
        """Return why a speed is not taken although the lobes offer it, '' when it is.

        The command may stand off it by the tolerance, which bears the depth by the verification, or by the lobes.
        """
        demand = self.operation.demand
        if self._check is not None:
            return self._check.denial(known.response, speed_rpm, demand.depth_mm, demand.tolerance_fraction)
        bears_mm = least_depth_mm(lobes, speed_rpm, demand.tolerance_fraction)
        if bears_mm >= demand.depth_mm:
            return ""
        return f"within {demand.tolerance_fraction:.1%} of {speed_rpm:.0f} 1/min it is stable to {bears_mm:.3g} mm only"

    def _verified(
        self,
        known: EstimatedToolPoint,
        lobes: StabilityLobes,
        range_rpm: tuple[float, float],
        candidates: tuple[float, ...] | None,
        denied: dict[float, str],
    ) -> SpeedChoice | None:
        """Return the nearest verified speed on one side of the programmed one, None without; notes what is denied."""
        demand = self.operation.demand
        for _ in range(MOST_TRIALS):
            left = _without(lobes, denied, demand)
            choice = choose_speed(left, demand, range_rpm=range_rpm, candidates_rpm=candidates)
            if not choice.stable:
                return None
            if not (denial := self._denial(known, lobes, choice.speed_rpm)):
                return choice if candidates is not None else self._nearest(known, lobes, choice, denied)
            denied[choice.speed_rpm] = denial
        return None

    def _nearest(
        self, known: EstimatedToolPoint, lobes: StabilityLobes, choice: SpeedChoice, denied: Mapping[float, str]
    ) -> SpeedChoice:
        """Return the choice moved towards the programmed speed, to where the verified ones of its pocket begin."""
        good, programmed_rpm = choice.speed_rpm, self.operation.demand.programmed_rpm
        if good == programmed_rpm:
            return choice
        upwards = programmed_rpm > good
        low, high = stable_range_rpm(lobes, self.operation.demand, good)
        ahead = [speed for speed in denied if (speed > good) is upwards]
        bad = min([*ahead, programmed_rpm, high]) if upwards else max([*ahead, programmed_rpm, low])
        if bad not in denied and not self._denial(known, lobes, bad):
            good = bad
        while abs(bad - good) > EDGE_WIDTH * good:
            middle = (good + bad) / 2.0
            if self._denial(known, lobes, middle):
                bad = middle
            else:
                good = middle
        return replace(
            choice,
            speed_rpm=good,
            limiting_depth_mm=limiting_depth_mm(lobes, good),
            pocket_rpm=(low, good) if upwards else (good, high),
        )

    def _span_rpm(self, choice: SpeedChoice, known: EstimatedToolPoint) -> float:
        """Return how far the choice moves when flagged properties are at the ends of their ranges [1/min].

        An end without a stable speed is no small move, whatever the programmed speed is.
        """
        ends = known.flagged_ends
        if any(end is None for end in ends):
            return float("inf")
        if ends is not self._ends[0]:
            found = [self.choice(end) for end in ends if end is not None]
            self._ends = (ends, found)
        if any(end.stable is not choice.stable for end in self._ends[1]):
            return float("inf")
        speeds = [choice.speed_rpm, *(end.speed_rpm for end in self._ends[1])]
        return max(speeds) - min(speeds)

    def change_per_step_rpm(
        self, known: EstimatedToolPoint, moved: Mapping[str, EstimatedToolPoint]
    ) -> dict[str, float]:
        """Return how far the choice moves when one signal reads one step of its resolution more [1/min].

        Result: signal -> change [1/min].

        `known`: the dynamics of now. `moved`: signal -> the dynamics with that signal one step higher.
        """
        here = self.choice(known).speed_rpm
        return {signal: abs(self.choice(each).speed_rpm - here) for signal, each in moved.items()}


def _without(lobes: StabilityLobes, denied: Mapping[float, str], demand: SpeedDemand) -> StabilityLobes:
    """Return lobes that are stable to no depth at the denied speeds and within their tolerance."""
    width, limits = max(demand.tolerance_fraction, LEAST_WIDTH), lobes.limiting_depth_mm
    for speed_rpm in denied:
        limits = np.where(np.abs(lobes.speed_rpm / speed_rpm - 1.0) <= width, 0.0, limits)
    return replace(lobes, limiting_depth_mm=limits)
