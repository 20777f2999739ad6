"""A ridge as a member of a mean: one design on a part of the lags, its penalty chosen by what is left out."""

from collections.abc import Sequence

import numpy as np

from models.thermal.features import BoolArray, Design, IntArray, Layout
from models.thermal.model import HyperParameters
from models.thermal.solution import Solution
from models.thermal.training.families import Fit, fold_numbers, ridge_fit
from models.thermal.training.inputs import Inputs
from models.thermal.training.left_out_errors import LeftOutErrors, left_out_errors, only, relative_of, together
from models.thermal.training.ridge import PENALTIES, RidgeProblem

LEVELS = Design(departures=False)
DEPARTURES = Design(departures=True)
"""Of a ridge on temperatures, and of one on lags of them: what a part is warmer than it was decides how it bends."""


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
        if len(numbers) > 1:
            best, self.errors = nested_errors(self._tried(inputs, rows, fold, probe_min, numbers))
            self.penalty = PENALTIES[best]

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


class RidgeFamily:
    """A ridge on the columns of the inputs as they are, see `Prepare`."""

    def __init__(
        self, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None, design: Design = LEVELS
    ) -> None:
        self._member = RidgeMember("ridge", inputs, rows, fold, probe_min, design)
        self.hyper_parameters: HyperParameters = {
            "penalties": [self._member.penalty],
            "lags_min": list(inputs.layout.lags_min),
            "speed_lags_min": list(inputs.layout.speed_lags_min),
        }

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""
        return ridge_fit([self._member.solution(left_out)])


def nested_errors(tried: Sequence[LeftOutErrors]) -> tuple[int, LeftOutErrors]:
    """Return which leaves least, and what is left of each fold by what was best on the other folds.

    The best of many on the folds that it is then judged by looks better than it is.
    """
    tables = [one.scored() for one in tried]
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
