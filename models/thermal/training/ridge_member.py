"""A ridge as a member of a mean: one design on a part of the lags, its penalty chosen by what is left out."""

from models.thermal.features import BoolArray, Design, IntArray, Layout
from models.thermal.solution import Solution
from models.thermal.training.families import Fit, chosen_with_score, fold_numbers, ridge_fit
from models.thermal.training.inputs import Inputs
from models.thermal.training.left_out_errors import LeftOutErrors, left_out_errors
from models.thermal.training.ridge import PENALTIES, RidgeProblem


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

        def candidates(number: int) -> list[Fit]:
            """Return one fit per penalty without the fold."""
            return [ridge_fit([solution]) for solution in self._problem.solve(frozenset({number}), PENALTIES)]

        best, _ = chosen_with_score(inputs, rows, fold, probe_min, candidates)
        self.penalty = PENALTIES[best]
        numbers = fold_numbers(rows, fold)
        fits = {number: ridge_fit([self.solution(frozenset({number}))]) for number in numbers}
        self.errors: LeftOutErrors | None = None
        if len(numbers) > 1:
            self.errors = left_out_errors(inputs, rows, fold, fits, probe_min)

    def solution(self, left_out: frozenset[int]) -> Solution:
        """Return the ridge on everything but some folds, in the columns of its own layout."""
        return self._problem.solve(left_out, [self.penalty])[0]


def joint_layout(layouts: list[Layout]) -> Layout:
    """Return the layout that has the lags of several."""
    return Layout(
        sensors=layouts[0].sensors,
        lags_min=tuple(sorted({lag for layout in layouts for lag in layout.lags_min})),
        speed_lags_min=tuple(sorted({lag for layout in layouts for lag in layout.speed_lags_min})),
    )
