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
from models.thermal.training.advice import advice
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
from models.thermal.training.gaussian_member import GaussianMember, gaussian_fit, widened_piece
from models.thermal.training.increment_family import increments_without_drift
from models.thermal.training.inputs import Inputs
from models.thermal.training.lags import FAST_MIN, columns_of, offered_lags, part_of, widened
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
DEPARTURES = {"fast": False, "slow": True}
"""Whether the Gaussian process on a part of the lags regresses on departures from them, or on the lags."""
MOST_MEMBERS = 4
"""No more than the best so many are in a mean: further ones hardly change it, and each takes memory in the daemon."""
LEAST_GAIN = 0.005
"""Less of the error is no difference between two families, whatever the standard error."""
WATCH_IS_WORTH = 0.02
"""A family of which no sensor can be left out, so that none can be watched, must leave so much less of the error."""
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
    advice: tuple[str, ...] = ()
    """What to record next, see `advice`."""


Member = RidgeMember | GaussianMember


@dataclass(slots=True, kw_only=True, eq=False)
class _Tried:
    family: str
    fit: Callable[[frozenset[int]], Fit]
    layout: Layout
    errors: LeftOutErrors | None
    hyper_parameters: HyperParameters = field(default_factory=dict)
    refused: str | None = None

    @property
    def score(self) -> float:
        """Left-out error over that without compensation, see `relative`; NaN where the family was not fitted."""
        return float("nan") if self.errors is None else relative(self.errors)


class ChosenProblem:
    """The family that the training rows support; see `Prepare` for the parameters.

    `families`: which of `ridge`, `pls`, `lasso`, `increments`, `lags` and `gaussian` are tried.
    """

    def __init__(
        self, families: Sequence[str], inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None
    ) -> None:
        self._inputs, self._rows, self._fold, self._probe_min = inputs, rows, fold, probe_min
        self._families = families
        self._lags = offered_lags(inputs, rows)
        numbers = fold_numbers(rows, fold)
        self._independent = independent_folds(inputs, rows, len(numbers)) if len(numbers) > 1 else 0
        plain = families if self._lags.all_min else (*families, "ridge")
        tried = [self._on_temperatures(name) for name in ON_TEMPERATURES if name in plain]
        chosen, others, why = self._choose([one for one in tried if one.refused is None])
        self._chosen = chosen
        self.layout = chosen.layout
        self.hyper_parameters: HyperParameters = chosen.hyper_parameters | {
            "family": chosen.family,
            "lags_min": list(chosen.layout.lags_min),
            "speed_lags_min": list(chosen.layout.speed_lags_min),
        }
        candidates = tuple(_candidate(one) for one in (*tried, *others))
        self.choice = Choice(
            family=chosen.family, why=why, candidates=candidates, advice=advice(inputs, rows, self._independent)
        )

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

    def _ridges(self, *, speed: bool) -> list[RidgeMember]:
        """Return the ridges on each part of the lags, with spindle speed or without."""
        made = []
        for part, (lags_min, speed_lags_min) in self._lags.parts(speed=speed).items():
            inputs = part_of(self._inputs, lags_min, speed_lags_min)
            made += [
                RidgeMember(f"{part} {name}", inputs, self._rows, self._fold, self._probe_min, design)
                for name, design in DESIGNS.items()
            ]
        return made

    def _processes(self, *, speed: bool) -> list[GaussianMember]:
        """Return the Gaussian processes on each part of the lags, with spindle speed or without."""
        return [
            GaussianMember(
                f"gaussian {part}",
                part_of(self._inputs, lags_min, speed_lags_min),
                self._rows,
                self._fold,
                self._probe_min,
                DEPARTURES[part],
            )
            for part, (lags_min, speed_lags_min) in self._lags.parts(speed=speed).items()
        ]

    def _choose(self, plain: Sequence[_Tried]) -> tuple[_Tried, list[_Tried], str]:
        """Return what is chosen, what else was tried with lags, and why it is that one."""
        best_plain, reasons = _plainest(plain)
        if not self._lags.all_min:
            if not plain:
                raise DatasetError("no run is long enough for any family; record longer runs")
            why = f"no run is longer than {FAST_MIN[0]:g} min, so there are no lags to choose"
            return best_plain or plain[0], [], why
        ridges = self._ridges(speed=False)
        others = [mean_of("lags", ridges, self._inputs, self._rows)]
        chosen = others[0]
        if self._inputs.layout.speed_lags_min:
            with_speed = self._ridges(speed=True)
            others.append(mean_of("lags with speed", with_speed, self._inputs, self._rows))
            chosen, reason = simpler(others[0], others[1])
            reasons.append(reason)
            if self._independent < FEWEST_TO_MIX:
                chosen = others[1]
            ridges = with_speed if chosen is others[1] else ridges
        if self._independent < FEWEST_TO_MIX:
            return (
                chosen,
                others,
                (
                    "fewer than three whole runs or cycles can be left out, too few to choose a family by; taken is "
                    f"the mean of ridges on {chosen.family}, which needs no choice"
                ),
            )
        if "gaussian" in self._families:
            processes = self._processes(speed=chosen is not others[0])
            others.append(mean_of("gaussian", processes, self._inputs, self._rows, ridges))
            if "lags" in self._families:
                others.append(mean_of("gaussian and ridges", [*processes, *ridges], self._inputs, self._rows, ridges))
                better = min(others[-2:], key=lambda one: one.score)
                if better.score < chosen.score:
                    reasons.append(
                        f"{better.family} leaves {better.score:.1%} of the left-out error, {chosen.family} "
                        f"{chosen.score:.1%}"
                    )
                    chosen = better
            else:
                chosen = others[-1]
        if best_plain is not None:
            chosen, reason = simpler(best_plain, chosen)
            reasons.append(reason)
        return chosen, others, "; ".join(reasons) or f"{chosen.family} was asked for by name"


def simpler(one: _Tried, other: _Tried, least: float = LEAST_GAIN) -> tuple[_Tried, str]:
    """Return the first, simpler family unless the other is better by more than a standard error, and why.

    `least`: what it must be better by in any case, as a share of the error.
    """
    if one.errors is None or other.errors is None:
        return other, "nothing could be left out, so nothing could be compared"
    gained, error = advantage(other.errors, one.errors)
    shares = f"{other.family} leaves {other.score:.1%} of the left-out error, {one.family} {one.score:.1%}"
    if gained > max(error, least):
        return other, f"{shares}: more than the standard error of the difference, {error:.1%}"
    return one, f"{shares}: not better than the simpler one by more than {max(error, least):.1%}"


def _nothing(left_out: frozenset[int]) -> Fit:
    raise DatasetError("this family could not be fitted")


def _plainest(tried: Sequence[_Tried]) -> tuple[_Tried | None, list[str]]:
    """Return the first on temperatures alone, a ridge, unless another one is better by more than a standard error."""
    chosen: _Tried | None = None
    reasons = []
    for one in tried:
        if not np.isfinite(one.score):
            continue
        if chosen is None:
            chosen = one
            continue
        before = chosen
        chosen, reason = simpler(before, one, WATCH_IS_WORTH)
        if chosen is not before:
            reasons.append(reason)
    return chosen, reasons


def mean_of(
    family: str, made: Sequence[Member], inputs: Inputs, rows: BoolArray, ridges: Sequence[RidgeMember] = ()
) -> _Tried:
    """Return the mean of those members that are nearly as good as the best.

    `ridges`: of which the best counts alone far out, where a member bends.
    """
    scores = [_score(one) for one in made]
    near = sorted(members(scores), key=lambda index: scores[index])[:MOST_MEMBERS]
    kept = [made[index] for index in sorted(near)]
    processes = [one for one in kept if isinstance(one, GaussianMember)]
    linear = [one for one in kept if isinstance(one, RidgeMember)]
    far = min(ridges, key=_score) if processes and ridges else None
    layout = joint_layout([one.layout for one in (*kept, *([far] if far is not None else []))])
    centre = inputs.features[rows].mean(axis=0)[columns_of(layout, inputs.layout)]

    def fit(left_out: frozenset[int]) -> Fit:
        """Return the mean of the members, fitted on everything but some folds."""
        solutions = {id(one): widened(one.solution(left_out), layout) for one in linear}
        if not processes:
            return ridge_fit(list(solutions.values()))
        assert far is not None
        away = solutions.get(id(far)) or widened(far.solution(left_out), layout)
        pieces = [widened_piece(one.piece(left_out), layout) for one in processes]
        limit = float(np.mean([one.deviation_limit for one in processes]))
        return gaussian_fit(pieces, list(solutions.values()), centre, away, limit)

    errors = [one.errors for one in kept if one.errors is not None]
    hyper_parameters: HyperParameters = {"members": ", ".join(one.name for one in kept)}
    if linear:
        hyper_parameters["penalties"] = [one.penalty for one in linear]
    for one in processes:
        hyper_parameters[one.name] = one.hyper_parameters
    if np.isfinite(scores).all():
        hyper_parameters["tried"] = ", ".join(one.name for one in made)
        hyper_parameters["left_out_relative_rmse"] = scores
    return _Tried(
        family=family,
        fit=fit,
        layout=layout,
        errors=mean_errors(errors) if len(errors) == len(kept) else None,
        hyper_parameters=hyper_parameters,
    )


def _score(member: Member) -> float:
    return float("nan") if member.errors is None else relative(member.errors)


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
