"""Chooses a family by what it leaves of whole runs or cycles that it has not seen, and says what was tried and why.

Members on temperatures, on their lags and on lagged speed are averaged: the few that leave least of what was left out,
or as much of each as makes the mean leave clearly less; nobody is a member because it always was one. A family on
temperatures alone is taken in place of the mean unless it is clearly worse, fold by fold. A channel of which members
and penalties of its own leave clearly less has these. What leaves more than there is without a model is refused.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray, Layout
from models.thermal.model import HyperParameters
from models.thermal.training.families import (
    Fit,
    Prepare,
    Problem,
    fold_numbers,
    ridge_fit,
)
from models.thermal.training.gaussian_member import GaussianMember, gaussian_fit, weighed_piece, widened_piece
from models.thermal.training.increment_family import increments_without_drift
from models.thermal.training.inputs import Inputs
from models.thermal.training.lags import FAST_MIN, columns_of, offered_lags, part_of, weighed, widened
from models.thermal.training.left_out_errors import (
    LeftOutErrors,
    advantage,
    beside,
    left_out_errors,
    mean_errors,
    of_channel,
    of_two_runs,
    only,
    relative,
    rmse_um,
)
from models.thermal.training.mixing import even_weights, mean_weights
from models.thermal.training.ridge import MOST_COLUMNS
from models.thermal.training.ridge_member import (
    DEPARTURES,
    LEVELS,
    ON_TEMPERATURES,
    RidgeFamily,
    RidgeMember,
    joint_layout,
)
from models.thermal.training.trust import independent_folds

ON_DEPARTURES = {"fast": False, "slow": True}
"""Whether the Gaussian process on a part of the lags regresses on departures from them, or on the lags."""
LEAST_GAIN = 0.005
"""Less of the error is no difference between two families, whatever the standard error."""
CLEARLY_BETTER = 0.5
"""By so many standard errors of the difference the mean must be better than a family on temperatures alone ..."""
PLAIN_BETTER = 1.0
"""... and one on temperatures alone than another of these."""
MIXED_BETTER = 1.0
"""By so many the mean of processes and ridges must be better than that of one kind: it is the best of more trials."""
OWN_BETTER = 2.0
"""By so many members of a channel's own must be better than those of all channels: every channel is a trial more."""
MOST_NUMBERS = 2_000_000
"""All solutions together hold no more, so that a model is 8 MiB in the daemon and an estimate takes 0.5 ms: with 302
sensors four to six of them; the channels that gain most then have members of their own."""
FEWEST_TO_PART = 5
"""Of so many runs or cycles left out at least: the error of a difference of four is itself known too badly."""
WATCH_IS_WORTH = 0.02
"""A family of which no sensor can be left out, so that none can be watched, must leave so much less of the error."""
FEWEST_TO_MIX = 3
"""With fewer independent folds scores are too few to mix families by ..."""
FEWEST_CYCLES_OF_ONE_RUN = 4
"""... and with fewer spindle cycles of a single run to take lags by: these are alike in what differs between days."""
LASTS_LAGS = 4.0
"""A single run must last so many times its longest lag, too: what it began in lasts through most of a shorter one, and
all of its cycles share that."""
TOO_FEW_FOR_LAGS = (
    f"fewer than three whole runs, or {FEWEST_CYCLES_OF_ONE_RUN} cycles of a single one that lasts {LASTS_LAGS:g} "
    "times its longest lag, can be left out, and lags that do well within a run may lead astray on another day"
)
BETTER_IN_BOTH = 0.8
"""Of two runs one family must leave less than this share of what another leaves, in each of them when only the other
was trained on."""
PLAIN: dict[str, Prepare] = {
    "ridge": RidgeFamily,
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


Member = RidgeMember | GaussianMember


@dataclass(slots=True, kw_only=True, eq=False)
class _Tried:
    family: str
    fit: Callable[[frozenset[int]], Fit]
    layout: Layout
    errors: LeftOutErrors | None
    hyper_parameters: HyperParameters = field(default_factory=dict)
    refused: str | None = None
    members: Sequence[tuple[Member, FloatArray | float]] = ()
    """Of which it is the weighted mean, where it is one."""

    @property
    def score(self) -> float:
        """Left-out error over that without compensation, see `relative`; NaN where the family was not fitted."""
        return float("nan") if self.errors is None else relative(self.errors)


class ChosenProblem:
    """The family that the training rows support; see `Prepare` for the parameters.

    `families`: which of `ridge`, `increments`, `lags` and `gaussian` are tried.
    """

    def __init__(
        self, families: Sequence[str], inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None
    ) -> None:
        self._inputs, self._rows, self._fold, self._probe_min = inputs, rows, fold, probe_min
        self._families = families
        self._lags = offered_lags(inputs, rows)
        self._made: tuple[list[RidgeMember], list[GaussianMember]] = [], []
        numbers = fold_numbers(rows, fold)
        self._independent = independent_folds(inputs, rows, len(numbers)) if len(numbers) > 1 else 0
        plain = families if self._lags.all_min else (*families, "ridge")
        without_lags = part_of(inputs, (), ())
        tried = [self._on_temperatures(name, without_lags) for name in PLAIN if name in plain]
        chosen, others, why = self._choose([one for one in tried if one.refused is None])
        self._chosen = chosen
        self.layout = chosen.layout
        self._inputs = without_lags  # hundreds of sensors with all their lags are tens of megabytes
        self.hyper_parameters: HyperParameters = chosen.hyper_parameters | {
            "family": chosen.family,
            "lags_min": list(chosen.layout.lags_min),
            "speed_lags_min": list(chosen.layout.speed_lags_min),
        }
        candidates = tuple(_candidate(one) for one in (*tried, *others))
        self.choice = Choice(family=chosen.family, why=why, candidates=candidates)

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""
        return self._chosen.fit(left_out)

    def _on_temperatures(self, name: str, plain: Inputs) -> _Tried:
        try:
            problem = PLAIN[name](plain, self._rows, self._fold, self._probe_min)
            errors = self._errors(plain, problem)
        except DatasetError as error:
            return _Tried(family=name, fit=_nothing, layout=plain.layout, errors=None, refused=str(error))
        return _Tried(
            family=name,
            fit=problem.fit,
            layout=plain.layout,
            errors=errors,
            hyper_parameters=problem.hyper_parameters,
            members=[(problem.member, 1.0)] if isinstance(problem, RidgeFamily) else (),
        )

    def _errors(self, inputs: Inputs, problem: Problem) -> LeftOutErrors | None:
        numbers = fold_numbers(self._rows, self._fold)
        if len(numbers) < 2:
            return None
        fits = {number: problem.fit(frozenset({number})) for number in numbers}
        return left_out_errors(inputs, self._rows, self._fold, fits, self._probe_min)

    def _parts(self, *, speed: bool) -> Iterator[tuple[str, Inputs]]:
        """Yield the inputs without lags and of each part of the lags, with lagged speed or not; one after the other."""
        lags = self._lags
        parts = {"temperatures": ((), lags.fast_speed_min if speed else ()), **lags.parts(speed=speed)}
        for name, part in parts.items():
            yield name, part_of(self._inputs, *part)

    def _ridges(self, *, speed: bool, lagged: bool) -> list[RidgeMember]:
        """Return the ridges on the parts of the lags, or on temperatures without lags; with spindle speed or not."""
        made = []
        for part, inputs in self._parts(speed=speed):
            if (part != "temperatures") is lagged:
                name, design = _named(f"{part} levels", speed), DEPARTURES if lagged else LEVELS
                made.append(RidgeMember(name, inputs, self._rows, self._fold, self._probe_min, design))
            del inputs  # before the next part is made: with hundreds of sensors each is tens of megabytes
        return made

    def _processes(self, *, speed: bool) -> list[GaussianMember]:
        """Return the Gaussian processes on each part of the lags, with speed or not."""
        made = []
        for part, inputs in self._parts(speed=speed):
            if part in ON_DEPARTURES:
                name, departures = _named(f"gaussian {part}", speed), ON_DEPARTURES[part]
                made.append(GaussianMember(name, inputs, self._rows, self._fold, self._probe_min, departures))
            del inputs
        return made

    def _choose(self, plain: Sequence[_Tried]) -> tuple[_Tried, list[_Tried], str]:
        """Return what is chosen, what else was tried with lags, and why it is that one."""
        best_plain, reasons = _plainest(plain)
        if not self._lags.all_min:
            if not plain:
                raise DatasetError("no run is long enough for any family; record longer runs")
            why = f"no run is longer than {FAST_MIN[0]:g} min, so there are no lags to choose"
            return best_plain or plain[0], [], why
        with_speed = bool(self._inputs.layout.speed_lags_min)
        if self._independent < FEWEST_TO_MIX:
            chosen = mean_of("lags", self._ridges(speed=with_speed, lagged=True), self._inputs, self._rows, mixed=False)
            others = [chosen]
            why = (
                "fewer than three whole runs or cycles can be left out, too few to choose members by, so the mean of "
                "ridges on lags has all alike"
            )
            if self._families == ("gaussian",):
                why = f"gaussian was asked for by name, but the model holds no Gaussian process: {why}"
        else:
            others = self._mixed([False, True] if with_speed else [False])
            chosen, why_mean = _best_mean(others)
            reasons += why_mean
            why = "; ".join(reasons) or f"{chosen.family} was asked for by name"
        if best_plain is None:
            return chosen, others, why
        if (both := self._of_two(best_plain, chosen)) is not None:
            chosen, reason = both
            others += [chosen] if chosen not in (best_plain, *others) else []
            return chosen, others, "; ".join([*reasons, reason])
        if not self._tells_lags():
            return best_plain, others, "; ".join([*reasons, f"{TOO_FEW_FOR_LAGS}: {best_plain.family} is taken"])
        chosen, reason = simpler(best_plain, chosen)
        reasons.append(reason)
        if (own := self._of_channels(chosen)) is not None:
            chosen, reason = own
            others, reasons = [*others, chosen], [*reasons, reason]
        return chosen, others, "; ".join(reasons)

    def _of_channels(self, chosen: _Tried) -> tuple[_Tried, str] | None:
        """Return the mean in which single channels have members of their own, and why; None: no channel has.

        What is seen of one channel may ask for much damping, or lags, and what is seen of another for little and none.
        """
        ridges, _ = self._made
        if self._independent < FEWEST_TO_PART or chosen.errors is None or not chosen.members or not ridges:
            return None
        names = self._inputs.channels
        used = [replace(chosen, errors=of_channel(chosen.errors, channel)) for channel in range(len(names))]
        own, why = [self._best_of_channel(channel) for channel in range(len(names))], {}
        for channel in sorted(range(len(names)), key=lambda channel: own[channel].score - used[channel].score):
            tried = [own[channel] if channel == place else other for place, other in enumerate(used)]
            if clearly_less(own[channel], used[channel]) and _numbers(_of_each(tried)) <= MOST_NUMBERS:
                shares = f"{own[channel].score:.1%} of its left-out error in place of {used[channel].score:.1%}"
                said = f"{names[channel]}, by itself, has {own[channel].family}, which leaves {shares}, clearly less"
                used, why[channel] = tried, said
        if not why:
            return None
        left = beside([one.errors for one in used if one.errors is not None])
        far, family = min(ridges, key=_score), f"{chosen.family} and channels by themselves"
        return _mean(family, _of_each(used), left, self._inputs, self._rows, far), "; ".join(why.values())

    def _best_of_channel(self, channel: int) -> _Tried:
        """Return what would be chosen if there were one channel alone."""
        made, processes = self._made
        ridges = [one.of_channel(channel) for one in made]
        mean, _ = _best_mean(self._means(ridges, [one.of_channel(channel) for one in processes]))
        plain = next((one for one in ridges if one.name == ON_TEMPERATURES), None)
        if plain is None:
            return mean
        alone = _mean("ridge", [(plain, 1.0)], plain.errors, self._inputs, self._rows, None)
        return simpler(alone, mean)[0]

    def _halves(self) -> IntArray | None:
        """Return in which half of the cycles of a single run each row lies, -1 elsewhere; None: too few, or several."""
        several = len(np.unique(self._inputs.run[self._rows])) > 1
        if several or not self._tells_lags() or self._independent < 2 * FEWEST_TO_MIX:
            return None
        second = fold_numbers(self._rows, self._fold)[self._independent // 2]
        return np.where(self._fold < 0, -1, (self._fold >= second).astype(np.intp))

    def _tells_lags(self) -> bool:
        """Return whether what can be left out tells of lags what they are worth on another day."""
        if len(np.unique(self._inputs.run[self._rows])) > 1:
            return self._independent >= FEWEST_TO_MIX
        if self._inputs.speed_rpm is None or self._independent < FEWEST_CYCLES_OF_ONE_RUN:
            return False
        return bool(np.ptp(self._inputs.time_min[self._rows]) >= LASTS_LAGS * max(self._lags.all_min))

    def _of_two(self, plain: _Tried, other: _Tried) -> tuple[_Tried, str] | None:
        """Return the one that is clearly better in each of two runs, else half of each, and why; None: not two.

        Of two halves of a run it is the simpler one where neither is clearly better in each.

        Cycles and blocks of a run are alike in what differs between two: scored by them, what fits a run best wins.
        """
        halves = self._halves()
        groups = self._inputs.run if halves is None else halves
        if other.errors is None:
            return None
        found = []
        for one in (plain, other):
            inputs = part_of(self._inputs, one.layout.lags_min, one.layout.speed_lags_min)
            if halves is None:
                fits = of_two_runs(inputs, self._rows, self._fold, one.fit)
            else:
                fits = {half: one.fit(frozenset(self._fold[self._rows & (halves == half)].tolist())) for half in (0, 1)}
            if fits is None:
                return None
            errors = left_out_errors(inputs, self._rows, groups, fits, self._probe_min)
            found.append(np.array([relative(only(errors, number)) for number in fits]))
        of_plain, of_other = found
        two = "runs" if halves is None else "halves of the run"
        left = f"of the two {two}, each left out whole, {{}} leaves {{:.1%}} and {{:.1%}}, {{}} {{:.1%}} and {{:.1%}}"
        said = left.format(other.family, *of_other, plain.family, *of_plain)
        if (of_other < BETTER_IN_BOTH * of_plain).all():
            return other, f"{said}: {other.family} leaves clearly less of both"
        if (of_plain < BETTER_IN_BOTH * of_other).all():
            return plain, f"{said}: {plain.family} leaves clearly less of both"
        if halves is not None:
            return plain, f"{said}: not clearly less of both, so the simpler one is taken"
        alone = f", as no mean can hold {plain.family}: --model {plain.family} is that alone"
        return (
            self._half_ridge(other, other.errors),
            f"{said}: two runs do not tell which is better, so it is half a ridge on temperatures"
            f"{alone if plain.family != 'ridge' else ''}",
        )

    def _half_ridge(self, other: _Tried, errors: LeftOutErrors) -> _Tried:
        """Return the mean of another mean and a ridge on temperatures alone."""
        plain = part_of(self._inputs, (), ())
        ridge = RidgeMember("temperatures levels", plain, self._rows, self._fold, self._probe_min, LEVELS)
        assert ridge.errors is not None
        return _mean(
            f"half ridge, half {other.family}",
            [(ridge, 0.5), *((one, 0.5 * weight) for one, weight in other.members)],
            mean_errors([ridge.errors, errors], [0.5, 0.5]),
            self._inputs,
            self._rows,
            ridge,
        )

    def _mixed(self, speeds: Sequence[bool]) -> list[_Tried]:
        """Return the means that are tried: of ridges, of Gaussian processes, of both."""
        ridges: list[RidgeMember] = []
        processes: list[GaussianMember] = []
        for speed in speeds:
            ridges += self._ridges(speed=speed, lagged=True)
        if "ridge" in self._families:
            for speed in speeds:
                ridges += self._ridges(speed=speed, lagged=False)
        if "gaussian" in self._families:
            processes = self._processes(speed=speeds[-1])
        self._made = ridges, processes
        return self._means(ridges, processes)

    def _means(self, ridges: list[RidgeMember], processes: list[GaussianMember]) -> list[_Tried]:
        """Return the means of members that are tried, that of both kinds last."""
        found = []
        if "lags" in self._families:
            found.append(mean_of("lags", ridges, self._inputs, self._rows))
        if processes:
            found.append(mean_of("gaussian", processes, self._inputs, self._rows, ridges))
        if "lags" in self._families and processes:
            found.append(mean_of("gaussian and ridges", [*processes, *ridges], self._inputs, self._rows, ridges))
        return found


def _best_mean(means: Sequence[_Tried]) -> tuple[_Tried, list[str]]:
    """Return the mean that is taken of those that are tried, that of both kinds the last of them, and why."""
    *of_one_kind, last = means
    chosen, reasons = min(of_one_kind or [last], key=lambda one: one.score), []
    if of_one_kind:
        reasons.append(_comparison(means))
        chosen, reason = simpler(chosen, last, errors=MIXED_BETTER)
        reasons += [reason] if chosen is last or last.score < chosen.score else []
    return chosen, reasons


def clearly_less(own: _Tried, of_all: _Tried) -> bool:
    """Whether members of a channel's own leave clearly less of it than those of all channels."""
    if own.errors is None or of_all.errors is None:
        return False
    gained, error = advantage(own.errors, of_all.errors)
    return gained > max(OWN_BETTER * error, LEAST_GAIN)


def _of_each(used: Sequence[_Tried]) -> list[tuple[Member, FloatArray]]:
    """Return members and how much each counts in each channel, from what each channel has."""
    kept: dict[tuple[str, float], tuple[Member, FloatArray]] = {}
    for channel, one in enumerate(used):
        for member, weight in one.members:
            penalty = member.penalty if isinstance(member, RidgeMember) else 0.0
            kept.setdefault((member.name, penalty), (member, np.zeros(len(used))))[1][channel] += weight
    return [*kept.values()]


def _numbers(kept: Sequence[tuple[Member, FloatArray]]) -> int:
    """Return how many numbers the directions of the members hold in one layout, in the model that the daemon loads."""
    columns = joint_layout([one.layout for one, _ in kept]).columns
    return columns * sum(min(one.layout.columns, MOST_COLUMNS) for one, _ in kept)


def _named(name: str, speed: bool) -> str:
    return f"{name} with speed" if speed else name


def _comparison(tried: Sequence[_Tried]) -> str:
    shares = ", ".join(f"{one.family} {one.score:.1%}" for one in sorted(tried, key=lambda one: one.score))
    return f"of the left-out error there remains with {shares}"


def simpler(
    one: _Tried, other: _Tried, least: float = LEAST_GAIN, errors: float = CLEARLY_BETTER
) -> tuple[_Tried, str]:
    """Return the first, simpler family unless the other is clearly better, and why.

    `least`: what it must be better by in any case, as a share of the error. `errors`: by so many standard errors of the
    difference, which is taken fold by fold.
    """
    if one.errors is None or other.errors is None:
        return other, "nothing could be left out, so nothing could be compared"
    gained, error = advantage(other.errors, one.errors)
    shares = f"{other.family} leaves {other.score:.1%} of the left-out error, {one.family} {one.score:.1%}"
    needed = max(errors * error, least)
    if gained > needed:
        return other, f"{shares}: clearly less, the standard error of the difference is {error:.1%}"
    return one, f"{shares}: not better than the simpler one by more than {needed:.1%}"


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
        chosen, reason = simpler(before, one, WATCH_IS_WORTH, PLAIN_BETTER)
        if chosen is not before:
            reasons.append(reason)
    return chosen, reasons


def mean_of(
    family: str,
    made: Sequence[Member],
    inputs: Inputs,
    rows: BoolArray,
    ridges: Sequence[RidgeMember] = (),
    *,
    mixed: bool = True,
) -> _Tried:
    """Return the mean of members, each counted as left-out errors say, see `mean_weights`.

    `ridges`: of which the best counts alone far out, where a member bends. `mixed`: else all members that are nearly as
    good as the best count alike, because there are too few scores to say more.
    """
    scores = [_score(one) for one in made]
    errors = [one.errors for one in made if one.errors is not None]
    known = len(errors) == len(made)
    weights, left = mean_weights(errors, mixed=mixed) if known else (even_weights(scores), None)
    kept = [(made[index], weight) for index, weight in weights.items()]
    far = min(ridges, key=_score, default=None)
    found = _mean(family, kept, left, inputs, rows, far)
    if np.isfinite(scores).all():
        found.hyper_parameters["tried"] = ", ".join(one.name for one in made)
        found.hyper_parameters["left_out_relative_rmse"] = scores
    return found


def _mean(
    family: str,
    kept: Sequence[tuple[Member, FloatArray | float]],
    left: LeftOutErrors | None,
    inputs: Inputs,
    rows: BoolArray,
    far: RidgeMember | None,
) -> _Tried:
    """Return the weighted mean of some members, and what it leaves; `far`: counts alone far out, if a member bends.

    `kept`: members and how much each counts, of all channels or of each.
    """
    processes = [(one, weight) for one, weight in kept if isinstance(one, GaussianMember)]
    linear = [(one, weight) for one, weight in kept if isinstance(one, RidgeMember)]
    used = [one for one, _ in kept] + ([far] if processes and far is not None else [])
    layout = joint_layout([one.layout for one in used])
    centre = inputs.features.mean(axis=0, where=rows[:, None])[columns_of(layout, inputs.layout)]

    def fit(left_out: frozenset[int]) -> Fit:
        """Return the mean of the members, fitted on everything but some folds."""
        solutions = {id(one): widened(one.solution(left_out), layout) for one, _ in linear}
        if not processes:
            return ridge_fit([weighed(solutions[id(one)], weight * len(linear)) for one, weight in linear])
        assert far is not None
        of_each = {id(one): float(np.mean(weight)) for one, weight in kept}
        away = solutions.get(id(far)) or widened(far.solution(left_out), layout)
        ridges = [
            solutions[id(one)] if np.ndim(weight) == 0 else weighed(solutions[id(one)], weight / of_each[id(one)])
            for one, weight in linear
        ]
        pieces = [
            weighed_piece(widened_piece(one.piece(left_out), layout), weight / of_each[id(one)])
            for one, weight in processes
        ]
        limit = float(np.mean([one.deviation_limit for one, _ in processes]))
        shares = [of_each[id(one)] for one, _ in (*processes, *linear)]
        return gaussian_fit(pieces, ridges, centre, shares, away, limit)

    hyper_parameters: HyperParameters = {
        "members": ", ".join(one.name for one, _ in kept),
        "shares": [float(np.mean(weight)) for _, weight in kept],
    }
    if linear:
        hyper_parameters["penalties"] = [one.penalty for one, _ in linear]
    for one, _ in processes:
        hyper_parameters[one.name] = one.hyper_parameters
    return _Tried(
        family=family,
        fit=fit,
        layout=layout,
        errors=left,
        hyper_parameters=hyper_parameters,
        members=kept,
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
