"""A ridge as a member of a mean: one design on a part of the lags, its penalty chosen by what is left out."""

from collections.abc import Sequence
from copy import copy

import numpy as np

from models.thermal.features import BoolArray, Design, IntArray, Layout
from models.thermal.model import HyperParameters
from models.thermal.solution import Solution
from models.thermal.training.evaluation import moving
from models.thermal.training.families import Fit, fold_numbers, ridge_fit
from models.thermal.training.inputs import Inputs
from models.thermal.training.left_out_errors import (
    LeftOutErrors,
    left_out_errors,
    of_channel,
    only,
    relative_of,
    together,
)
from models.thermal.training.ridge import PENALTIES, RidgeProblem

LEVELS = Design(departures=False)
DEPARTURES = Design(departures=True)
"""Of a ridge on temperatures, and of one on lags of them: what a part is warmer than it was decides how it bends."""

ON_TEMPERATURES = "temperatures levels"
"""What the ridge on temperatures alone is called among members."""


class RidgeMember:
    """One ridge on some lags.

    `name`: what reports call it. `inputs`: with the lags of this member alone. `rows`, `fold`, `probe_min`, `design`:
    see `RidgeProblem` and `Prepare`.
    """

    kind = "ridge"

    def __init__(
        self,
        name: str,
        inputs: Inputs,
        rows: BoolArray,
        fold: IntArray,
        probe_min: float | None,
        design: Design,
    ) -> None:
        self.name, self.layout = name, inputs.layout
        self._problem = RidgeProblem(inputs, rows, fold, design)
        numbers = fold_numbers(rows, fold)
        self.penalty = PENALTIES[len(PENALTIES) // 2]
        self.errors: LeftOutErrors | None = None
        self._of_channels: list[tuple[int, LeftOutErrors]] = []
        if len(numbers) > 1:
            tried = self._tried(inputs, rows, fold, probe_min, numbers)
            best, self.errors = nested_errors(tried)
            self.penalty = PENALTIES[best]
            channels = range(len(inputs.channels))
            self._of_channels = [nested_errors([of_channel(one, channel) for one in tried]) for channel in channels]

    def _tried(
        self, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None, numbers: list[int]
    ) -> list[LeftOutErrors]:
        """Return what each penalty leaves of the folds."""
        parts = []
        for number in numbers:
            solutions = self._problem.solve(frozenset({number}), PENALTIES)
            fits = [ridge_fit([solution]) for solution in solutions]
            parts.append([left_out_errors(inputs, rows, fold, {number: fit}, probe_min) for fit in fits])
        return [together(each) for each in zip(*parts, strict=True)]

    def solution(self, left_out: frozenset[int]) -> Solution:
        """Return the ridge on everything but some folds, in the columns of its own layout."""
        return self._problem.solve(left_out, [self.penalty])[0]

    def of_channel(self, channel: int) -> "RidgeMember":
        """Return this member with the penalty that leaves least of one channel, scored on that alone."""
        found = copy(self)
        best, found.errors = self._of_channels[channel]
        found.penalty = PENALTIES[best]
        return found


class RidgeFamily:
    """A ridge on the columns of the inputs as they are, see `Prepare`."""

    def __init__(
        self, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None, design: Design = LEVELS
    ) -> None:
        self.member = RidgeMember(ON_TEMPERATURES, inputs, rows, fold, probe_min, design)
        self.hyper_parameters: HyperParameters = {
            "penalties": [self.member.penalty],
            "lags_min": list(inputs.layout.lags_min),
            "speed_lags_min": list(inputs.layout.speed_lags_min),
        }

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""
        return ridge_fit([self.member.solution(left_out)])


def nested_errors(tried: Sequence[LeftOutErrors]) -> tuple[int, LeftOutErrors]:
    """Return which leaves least, and what is left of each fold by what was best on the other folds.

    The best of many on the folds that it is then judged by looks better than it is.
    """
    moves = moving(tried[0].measured_um)  # each leaves something of the same: hundreds of quantiles for each penalty
    tables = [one.scored(moves) for one in tried]
    numbers = np.unique(tried[0].folds)

    def best(kept: BoolArray) -> int:
        """Return which leaves least of some folds."""
        scores = [relative_of(without[kept], left[kept]) for without, left in tables]
        return int(np.nanargmin(scores)) if np.isfinite(scores).any() else len(scores) - 1

    parts = [only(tried[best(numbers != number)], int(number)) for number in numbers]
    return best(np.ones(len(numbers), dtype=np.bool_)), together(parts)


def joint_layout(layouts: list[Layout]) -> Layout:
    """Return the layout that has the lags of several."""
    return Layout(
        sensors=layouts[0].sensors,
        lags_min=tuple(sorted({lag for layout in layouts for lag in layout.lags_min})),
        speed_lags_min=tuple(sorted({lag for layout in layouts for lag in layout.speed_lags_min})),
    )
