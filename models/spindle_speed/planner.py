"""From the dynamics of the tool point to the speed that an operation should have, and how sure that is.

This is the slow half of the tuning: it computes lobes, and may run anywhere. The quick half, `speed_tuning.step`,
decides what of it is commanded, and when.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from models.spindle_speed.choice import SpeedDemand, choose_speed, deepest_speed, rule_candidates_rpm
from models.spindle_speed.plan import SpeedChoice, SpeedPlan
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.verification import StabilityVerification
from models.stability.lobes import StabilityLobes
from models.stability.response import ToolPointResponse

LEAST_WIDTH = 0.005
"""At least this share of a speed that does not pass is left out to both sides."""
MOST_LOOKS = 12
"""Speeds that are looked at before nothing is taken to bear the demand."""
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

    Parameters
    ----------
    operation
        What is programmed.
    lobes_of
        Response -> lobes.
    check
        Takes a second look at each chosen speed; None: the lobes decide.

    """

    def __init__(
        self, operation: MillingOperation, lobes_of: LobesOf, check: StabilityVerification | None = None
    ) -> None:
        self.operation = operation
        self._lobes_of = lobes_of
        self._check = check
        self._ends: tuple[tuple[EstimatedToolPoint | None, ...], list[SpeedChoice]] = ((), [])

    def plan(self, known: EstimatedToolPoint) -> SpeedPlan:
        """Return the plan for the dynamics of now; raises StabilityError."""
        choice = self.choice(known)
        return SpeedPlan(choice=choice, flagged_span_rpm=self._span_rpm(choice, known))

    def choice(self, known: EstimatedToolPoint) -> SpeedChoice:
        """Return the speed that some dynamics ask for; raises StabilityError.

        Where nothing bears the depth with its margin, the deepest speed is taken if it bears the depth itself: the
        programmed one bears no more. A speed that does not pass the second look is left out, with its tolerance.
        """
        operation, candidates = self.operation, None
        if operation.offset_hz is not None:
            candidates = rule_candidates_rpm(
                tuple(known.resonance_hz.values()), operation.offset_hz, operation.teeth, operation.range_rpm
            )
        lobes, demand = self._lobes_of(known.response), operation.demand
        for _ in range(MOST_LOOKS):
            choice = choose_speed(lobes, demand, range_rpm=operation.range_rpm, candidates_rpm=candidates)
            if not choice.stable:
                break
            if self._passes(known, choice):
                return choice
            near = np.abs(lobes.speed_rpm / choice.speed_rpm - 1.0) <= max(demand.tolerance_fraction, LEAST_WIDTH)
            lobes = replace(lobes, limiting_depth_mm=np.where(near, 0.0, lobes.limiting_depth_mm))
        return deepest_speed(lobes, demand, operation.range_rpm) or choice

    def _passes(self, known: EstimatedToolPoint, choice: SpeedChoice) -> bool:
        demand = self.operation.demand
        return self._check is None or self._check.is_stable(
            known.response, choice.speed_rpm, demand.depth_mm, demand.tolerance_fraction
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

        Parameters
        ----------
        known
            The dynamics of now.
        moved
            Signal -> the dynamics with that signal one step higher.

        Returns
        -------
        dict
            Signal -> change [1/min].

        """
        here = self.choice(known).speed_rpm
        return {signal: abs(self.choice(each).speed_rpm - here) for signal, each in moved.items()}
