"""Chooses a family by what it leaves of whole runs or cycles that it has not seen, and says what was tried and why.

Members that use the same inputs are averaged when they are nearly as good as the best of them; nobody is a member
because it always was one. A family with more inputs (lags, lagged speed) must be better than one with fewer by more
than the standard error of their difference, because what more inputs learn by chance is extrapolated later. What
leaves more than there is without a model is refused.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from models.recordings.dataset import DatasetError
from models.thermal.features import BoolArray, Design, IntArray, Layout
from models.thermal.model import HyperParameters
from models.thermal.training.families import (
    CORRELATION_MIN,
    Fit,
    Prepare,
    Problem,
    fold_numbers,
    members,
    ridge_family,
    ridge_fit,
)
from models.thermal.training.increment_family import increments_without_drift
from models.thermal.training.inputs import Inputs
from models.thermal.training.lags import offered_lags, part_of, widened
from models.thermal.training.left_out_errors import (
    LeftOutErrors,
    advantage,
    left_out_errors,
    mean_errors,
    relative,
    rmse_um,
)
from models.thermal.training.linear_families import LassoProblem, PartialLeastSquaresProblem
from models.thermal.training.ridge_member import RidgeMember, joint_layout
from models.thermal.training.trust import independent_folds

DESIGNS = {
    "levels": Design(departures=True, correlation_min=None),
    "persistent": Design(departures=False, correlation_min=CORRELATION_MIN),
}
"""The two ridges on each part of the lags: levels on departures from lags, generalised least squares on lags."""
FEWEST_TO_MIX = 3
"""With fewer independent folds scores are too few to mix families by."""
ON_TEMPERATURES: dict[str, Prepare] = {
    "ridge": ridge_family,
    "pls": PartialLeastSquaresProblem,
    "lasso": LassoProblem,
    "increments": increments_without_drift,
}
"""Families on temperatures alone, which are tried against those with lags."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """What was tried."""

    family: str
    rmse_um: tuple[float, ...]
    """Of each channel on what was left out [um]; NaN where nothing was."""
    reduction_rmse: tuple[float, ...]
    """1 - RMSE with / without of each channel."""
    relative_rmse: float
    """Mean over the channels of RMSE with / without."""
    refused: str | None
    """Why it cannot be used; None when it can."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What was chosen, and why."""

    family: str
    why: str
    candidates: tuple[Candidate, ...]


@dataclass(slots=True, kw_only=True, eq=False)
class _Tried:
    family: str
    fit: Callable[[frozenset[int]], Fit]
    layout: Layout
    errors: LeftOutErrors | None
    members: tuple[RidgeMember, ...] = ()
    hyper_parameters: HyperParameters = field(default_factory=dict)
    refused: str | None = None

    @property
    def score(self) -> float:
        return float("nan") if self.errors is None else relative(self.errors)


class ChosenProblem:
    """The family that the training rows support; see `Prepare` for the parameters.

    `families`: which of `ridge`, `pls`, `lasso`, `increments` and `lags` are tried.
    """

    def __init__(
        self, families: Sequence[str], inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None
    ) -> None:
        self._inputs, self._rows, self._fold, self._probe_min = inputs, rows, fold, probe_min
        numbers = fold_numbers(rows, fold)
        self._independent = independent_folds(inputs, rows, len(numbers)) if len(numbers) > 1 else 0
        tried = [self._on_temperatures(name) for name in ON_TEMPERATURES if name in families]
        lagged = self._lagged() if "lags" in families else []
        chosen, why = self._choose([one for one in tried if one.refused is None], lagged)
        self._chosen = chosen
        self.layout = chosen.layout
        self.hyper_parameters: HyperParameters = chosen.hyper_parameters | {
            "family": chosen.family,
            "lags_min": list(chosen.layout.lags_min),
            "speed_lags_min": list(chosen.layout.speed_lags_min),
        }
        everything = [*tried, *lagged]
        self.choice = Choice(family=chosen.family, why=why, candidates=tuple(_candidate(one) for one in everything))

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""
        return self._chosen.fit(left_out)

    def _on_temperatures(self, name: str) -> _Tried:
        plain = part_of(self._inputs, (), ())
        try:
            problem = ON_TEMPERATURES[name](plain, self._rows, self._fold, self._probe_min)
            errors = self._errors(plain, problem)
        except DatasetError as error:
            return _Tried(family=name, fit=_nothing, layout=plain.layout, errors=None, refused=str(error))
        return _Tried(
            family=name,
            fit=problem.fit,
            layout=plain.layout,
            errors=errors,
            hyper_parameters=problem.hyper_parameters,
        )

    def _errors(self, inputs: Inputs, problem: Problem) -> LeftOutErrors | None:
        numbers = fold_numbers(self._rows, self._fold)
        if len(numbers) < 2:
            return None
        fits = {number: problem.fit(frozenset({number})) for number in numbers}
        return left_out_errors(inputs, self._rows, self._fold, fits, self._probe_min)

    def _lagged(self) -> list[_Tried]:
        """Return the means of ridges on lags, without spindle speed and, where it was recorded, with it."""
        lags = offered_lags(self._inputs, self._rows)
        found = []
        for speed in (False, True) if self._inputs.layout.speed_lags_min else (False,):
            made = []
            for part, (lags_min, speed_lags_min) in lags.parts(speed=speed).items():
                inputs = part_of(self._inputs, lags_min, speed_lags_min)
                made += [
                    RidgeMember(f"{part} {name}", inputs, self._rows, self._fold, self._probe_min, design)
                    for name, design in DESIGNS.items()
                ]
            found.append(mean_of("lags with speed" if speed else "lags", made))
        return found

    def _choose(self, plain: Sequence[_Tried], lagged: Sequence[_Tried]) -> tuple[_Tried, str]:
        """Return the simplest that no other beats by more than a standard error, and why it is that one."""
        if self._independent < FEWEST_TO_MIX and lagged:
            return lagged[-1], (
                "fewer than three whole runs or cycles can be left out, too few to choose a family by; taken is the "
                "mean of ridges on lags, which needs no choice"
            )
        steps = [_best(plain), *lagged]
        possible = [one for one in steps if one is not None and np.isfinite(one.score)]
        if not possible:
            last = [*plain, *lagged][-1]
            return last, "nothing could be left out, so nothing could be compared"
        chosen, reasons = possible[0], []
        for other in possible[1:]:
            assert other.errors is not None and chosen.errors is not None
            gained, error = advantage(other.errors, chosen.errors)
            if gained > error:
                reasons.append(
                    f"{other.family} leaves {other.score:.1%} of the left-out error, {chosen.family} "
                    f"{chosen.score:.1%}: more than the standard error of the difference, {error:.1%}"
                )
                chosen = other
            else:
                reasons.append(
                    f"{other.family} ({other.score:.1%}) is not better than the simpler {chosen.family} "
                    f"({chosen.score:.1%}) by more than a standard error, {error:.1%}"
                )
        return chosen, "; ".join(reasons) or f"{chosen.family} is all that there is to choose"


def _nothing(left_out: frozenset[int]) -> Fit:
    raise DatasetError("this family could not be fitted")


def _best(tried: Sequence[_Tried]) -> _Tried | None:
    known = [one for one in tried if np.isfinite(one.score)]
    return min(known, key=lambda one: one.score) if known else None


def mean_of(family: str, made: Sequence[RidgeMember]) -> _Tried:
    """Return the mean of those members that are nearly as good as the best."""
    scores = [float("nan") if one.errors is None else relative(one.errors) for one in made]
    kept = [made[index] for index in members(scores)]
    layout = joint_layout([one.layout for one in kept])

    def fit(left_out: frozenset[int]) -> Fit:
        """Return the mean of the members, fitted on everything but some folds."""
        return ridge_fit([widened(one.solution(left_out), layout) for one in kept])

    errors = [one.errors for one in kept if one.errors is not None]
    hyper_parameters: HyperParameters = {
        "members": ", ".join(one.name for one in kept),
        "penalties": [one.penalty for one in kept],
    }
    if np.isfinite(scores).all():
        hyper_parameters["tried"] = ", ".join(one.name for one in made)
        hyper_parameters["left_out_relative_rmse"] = scores
    return _Tried(
        family=family,
        fit=fit,
        layout=layout,
        errors=mean_errors(errors) if len(errors) == len(kept) else None,
        members=tuple(kept),
        hyper_parameters=hyper_parameters,
    )


def _candidate(tried: _Tried) -> Candidate:
    if tried.errors is None:
        return Candidate(
            family=tried.family, rmse_um=(), reduction_rmse=(), relative_rmse=float("nan"), refused=tried.refused
        )
    without, left = rmse_um(tried.errors)
    reduction = 1.0 - np.divide(left, without, out=np.full_like(left, np.nan), where=without > 0.0)
    score = tried.score
    worse = None if score < 1.0 else f"leaves {score:.0%} of the error on what was left out: worse than nothing"
    return Candidate(
        family=tried.family,
        rmse_um=tuple(left.tolist()),
        reduction_rmse=tuple(reduction.tolist()),
        relative_rmse=score,
        refused=tried.refused or worse,
    )
