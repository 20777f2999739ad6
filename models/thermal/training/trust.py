"""Decides whether a fitted model may be used, and how wide its prediction band is: both from training rows alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError
from models.recordings.findings import counted
from models.recordings.jumps import scatter_um
from models.records import FloatArray
from models.thermal.bias import BiasFilter
from models.thermal.features import BoolArray, IntArray
from models.thermal.solution import band_factor
from models.thermal.training.advice import more_runs
from models.thermal.training.domain import farthest_leverage, leverage_positions
from models.thermal.training.evaluation import ResidualMetrics
from models.thermal.training.families import Fit, Problem, fold_numbers, held_out_metrics, relative_rmse
from models.thermal.training.folds import FEWEST_CYCLES, cycles, fold_segments
from models.thermal.training.inputs import Inputs
from models.thermal.training.left_out_errors import of_two_runs
from models.thermal.training.probing import probed_residual_um, wander_um2_per_min
from models.thermal.training.watch_fit import smoothed

BAND_QUANTILE = 0.95
"""Of what was left of left-out runs, and of Student's factor for their number. Chosen among 0.9 to 0.97 on the
tuning half of the zoo: with less, more machines of few runs fall below 85 %."""
SHORTEST_WANDER_MIN = 30.0
"""How far an offset wanders is not seen over less than this [min]; 10 to 60 min do equally well."""
LATER = np.array([1.5, 2.0, 3.0, 4.0, 6.0, 8.0])
"""The farthest that an offset goes is looked for over so many times the time between probes."""
LONGEST_CORRELATION_MIN = 6000.0
"""An offset that does not wander stays for so long [min]."""
LEAST_WANDER = 0.1
"""No more than the rest of what an offset was seen to wander is put down to noise."""
USUAL_PROBE_MIN = 60.0
"""How far an offset wanders between probes is told for this time between them [min], where none is asked for."""
HALF_LIFE = 2.0
"""A forward-chained fold counts half as much as one that comes so many folds later."""
FEWEST_FOLDS_BEFORE = 2
"""A fold is predicted from at least so many before it: one warm-up alone is no alternating operation."""
EXCURSION_SHARE = 0.3
"""An excursion moves a channel by this share of its span."""
FEWEST_EXCURSIONS = 2
"""So many alternating excursions must have been seen ..."""
FEWEST_RUNS = 3
"""... or so many separate runs."""
SMOOTHING_MIN = 10.0
"""Excursions are counted on displacements smoothed over this time [min]."""
NOISE_FACTOR = 4.0
"""A channel moves when its span exceeds the scatter about the smoothed curve by this factor."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trust:
    """What training says about a model."""

    refused: str | None
    """Why it must not be activated; None when it may."""
    band_um: FloatArray
    """Half width of the prediction band inside the domain of training [um], shape (n_channels,); NaN where nothing
    could be left out."""
    held_out_relative_rmse: float
    """RMSE with / without the model on what was left out, mean over the channels; NaN when nothing was."""
    forward_skill: tuple[float, ...]
    """1 - RMSE with / without of each fold, predicted from the folds before it."""
    bias_filter: BiasFilter | None = None
    """How a probe corrects the offset, from what was left out; None where nothing was."""
    held_out: ResidualMetrics | None = None
    """Residuals on what was left out; None when nothing was."""


def judge(
    inputs: Inputs, rows: BoolArray, fold: IntArray, problem: Problem, *, probe_min: float | None = None
) -> Trust:
    """Return whether a model may be used, and its band.

    The gate: at least two alternating excursions of more than 30 % of the span, or three separate
    runs; positive skill on what was left out; and positive skill in the mean of the forward-chained
    folds, each predicted only from what came before it, of which the latest count most. Parts of one or two runs
    are not independent of each other: there every one must have positive skill.

    `inputs`, `rows`, `fold`: training rows and their folds, see `inner_folds`. `problem`: the prepared family.
    `probe_min`: time between probes [min] for which the band is wanted; None without probes.
    """
    numbers = fold_numbers(rows, fold)
    nothing = np.full(len(inputs.channels), np.nan)
    if len(numbers) < 2:
        return Trust(
            refused="nothing could be left out, so it is not known how good the model is; record longer",
            band_um=nothing,
            held_out_relative_rmse=float("nan"),
            forward_skill=(),
        )
    try:
        fits = {number: problem.fit(frozenset({number})) for number in numbers}
        score = relative_rmse(inputs, rows, fold, fits, probe_min)
        series_um = left_out_series_um(inputs, rows, fold, fits)
        bias_filter = fit_bias_filter(inputs, rows, series_um, USUAL_PROBE_MIN if probe_min is None else probe_min)
        of_runs = of_two_runs(inputs, rows, fold, problem.fit)
        left_out = (fold, fits) if of_runs is None else (inputs.run, of_runs)
        band_um = _band_um(inputs, rows, left_out, probe_min, bias_filter)
    except DatasetError as error:
        return Trust(
            refused=f"without one of its folds it cannot be fitted ({error})",
            band_um=nothing,
            held_out_relative_rmse=float("nan"),
            forward_skill=(),
        )
    skill = _forward_skill(inputs, rows, fold, problem, probe_min)
    return Trust(
        refused=_reason(inputs, rows, score, skill),
        band_um=band_um,
        held_out_relative_rmse=score,
        forward_skill=tuple(skill),
        bias_filter=bias_filter,
        held_out=held_out_metrics(inputs, rows, fold, fits, probe_min),
    )


def _reason(inputs: Inputs, rows: BoolArray, score: float, skill: list[float]) -> str | None:
    runs = len(np.unique(inputs.run[rows]))
    seen, more = excursions(inputs, rows), FEWEST_RUNS - runs
    if seen < FEWEST_EXCURSIONS and runs < FEWEST_RUNS:
        return (
            f"training saw {counted(seen, 'excursion')} of more than {EXCURSION_SHARE:.0%} of the span in "
            f"{counted(runs, 'run')}; "
            f"{FEWEST_EXCURSIONS} alternating ones or {FEWEST_RUNS} separate runs are needed: record "
            f"{more_runs(more)} of about 4 h, {'each ' * (more > 1)}warming for half of the time and then cooling"
        )
    if not score < 1.0:
        return f"{score:.0%} of the error remains on what was left out: it is no better than no compensation"
    bad = [value for value in skill if not value > 0.0]
    if bad and runs < FEWEST_RUNS:
        return (
            f"predicted from what came before, {len(bad)} of {len(skill)} parts of the same run are worse than without "
            f"compensation (by {-min(bad):.0%} at worst), which runs of their own would have to outweigh; record "
            f"{FEWEST_RUNS} separate runs"
        )
    if skill and not (recently := recent_skill(skill)) > 0.0:
        return (
            f"predicted from what came before, {len(bad)} of {len(skill)} folds are worse than without compensation "
            f"(by {-min(bad):.0%} at worst), and {-recently:.0%} worse in the mean of which the latest count most; "
            "record 2 more runs of about 4 h, each warming at another speed for half of the time and then cooling"
        )
    return None


def recent_skill(skill: Sequence[float]) -> float:
    """Return the mean of the skills of folds in order of time, of which the latest count most.

    A fold counts half as much as another so many folds later; what is worse than twice the error counts no more than
    that, and a fold of which nothing is known as no skill.

    `skill`: 1 - RMSE with / without of each, at least one.
    """
    ages = np.arange(len(skill))[::-1]
    return float(np.average(np.clip(np.nan_to_num(skill, nan=-1.0), -1.0, 1.0), weights=0.5 ** (ages / HALF_LIFE)))


def _forward_skill(
    inputs: Inputs, rows: BoolArray, fold: IntArray, problem: Problem, probe_min: float | None
) -> list[float]:
    """Return the skill of each fold that has enough before it, predicted from those."""
    found, numbers = [], fold_numbers(rows, fold)
    for position in range(min(FEWEST_FOLDS_BEFORE, len(numbers) - 1), len(numbers)):
        later = frozenset(numbers[position:])
        try:
            fit = problem.fit(later)
        except DatasetError:
            continue
        found.append(1.0 - relative_rmse(inputs, rows, fold, {numbers[position]: fit}, probe_min))
    return found


def excursions(inputs: Inputs, rows: BoolArray) -> int:
    """Return how many alternating excursions the channel that moves most has made in some rows.

    An excursion is a move by more than 30 % of the channel's span, of the smoothed displacement,
    in the direction opposite to the one before. A channel that hardly leaves its own scatter has none.
    """
    best, widest = 0, 0.0
    for channel in range(len(inputs.channels)):
        known = rows & np.isfinite(inputs.measured_um[:, channel])
        segments = [part for part in fold_segments(inputs, known) if len(part) > 2]
        if not segments:
            continue
        smooth = [
            smoothed(inputs.time_min[part], inputs.measured_um[part, channel][:, None], SMOOTHING_MIN)[:, 0]
            for part in segments
        ]
        span = max(float(np.ptp(curve)) for curve in smooth)
        steps = np.concatenate([np.diff(inputs.measured_um[part, channel]) for part in segments])
        scatter = 1.4826 * float(np.median(np.abs(steps - np.median(steps)))) / np.sqrt(2.0)
        if span <= widest or span <= NOISE_FACTOR * scatter:
            continue
        widest, best = span, sum(_alternations(curve, EXCURSION_SHARE * span) for curve in smooth)
    return best


def _alternations(values: FloatArray, least: float) -> int:
    """Return how many moves of at least `least` in alternating directions a curve makes."""
    count, direction = 0, 0
    low = high = float(values[0])
    for value in values:
        low, high = min(low, float(value)), max(high, float(value))
        if direction <= 0 and value - low >= least:
            count, direction, high = count + 1, 1, float(value)
        elif direction >= 0 and high - value >= least:
            count, direction, low = count + 1, -1, float(value)
    return count


def _band_um(
    inputs: Inputs,
    rows: BoolArray,
    left_out: tuple[IntArray, Mapping[int, Fit]],
    probe_min: float | None,
    bias_filter: BiasFilter | None,
) -> FloatArray:
    """Return the half width of the band, each stretch that is left out from its own first row on.

    Without probes a left-out residual counts over the factor by which the band of the fit without it is widened there.

    `left_out`: what is left out together, as numbers of shape (n,), and by number the fit without it.
    """
    groups, fits = left_out
    left_um = []
    for number, fit in fits.items():
        out, parts = rows & (groups == number), []
        limit = farthest_leverage(inputs, rows & ~out, fit.solutions) if probe_min is None else 1.0
        for run in np.unique(inputs.run[out]):
            chosen = np.flatnonzero(out & (inputs.run == run))
            time_min, features = inputs.time_min[chosen], inputs.features[chosen]
            level_um = inputs.measured_um[chosen] - fit.estimate_um(features, features[0], time_min - time_min[0])
            residual_um = level_um - level_um[0]
            if probe_min is None:
                points = leverage_positions(fit.solutions, inputs.features, chosen) / np.sqrt(limit)
                parts.append(residual_um / band_factor(np.linalg.norm(points - points[0], axis=1))[:, None])
            else:
                parts.append(probed_residual_um(time_min, residual_um, probe_min, bias_filter))
        left_um.append(np.vstack(parts))
    runs = len(np.unique(inputs.run[rows]))
    return half_width_um(left_um, independent_folds(inputs, rows, len(left_um)), whole_runs=runs >= FEWEST_RUNS)


def half_width_um(left_out_um: Sequence[FloatArray], independent: int, *, whole_runs: bool = False) -> FloatArray:
    """Return the half width of the band, from what was left of each run that was left out, shape (n_channels,).

    Rows of a run are nearly equal, so that runs count alike however many rows they have, and how many rows there are
    says nothing of how sure the width is: the number of runs does, by Student's factor.

    `left_out_um`: of each run, at least one, shape (n_rows, n_channels) [um]. `independent`: how many of them count as
    independent. `whole_runs`: they are three whole runs or more, of which the root of that factor is enough.
    """
    from scipy.special import ndtri, stdtrit  # noqa: PLC0415 - never loaded by the resident daemon

    table = np.abs(np.vstack(left_out_um))
    shares = np.concatenate([np.full(len(each), 1.0 / len(each)) for each in left_out_um]) / len(left_out_um)
    order = np.argsort(table, axis=0)
    below = np.cumsum(shares[order], axis=0)
    place = np.minimum((below < BAND_QUANTILE - 1e-9).sum(axis=0), len(table) - 1)
    widest = np.take_along_axis(table, np.take_along_axis(order, place[None], axis=0), axis=0)[0]
    factor = stdtrit(independent, BAND_QUANTILE) / ndtri(BAND_QUANTILE)
    return np.asarray((np.sqrt(factor) if whole_runs else factor) * widest)


def independent_folds(inputs: Inputs, rows: BoolArray, folds: int) -> int:
    """Return how many of the folds count as independent: blocks of one or two spindle cycles are only two.

    `inputs` and `rows`: training rows. `folds`: how many were left out in turn.
    """
    runs = len(np.unique(inputs.run[rows]))
    if inputs.speed_rpm is None or runs >= FEWEST_RUNS:
        return folds
    return 2 if 1 <= len(cycles(inputs, rows)) < FEWEST_CYCLES else folds


def fit_bias_filter(inputs: Inputs, rows: BoolArray, series_um: FloatArray, probe_min: float) -> BiasFilter:
    """Return how a probe corrects the offset of this model.

    Result: its noise is the scatter of displacements about what moves smoothly; its wander is what the left-out
    residual gains beyond that noise between two probes, or over half an hour where probes come more often: what a model
    misses drifts, which nothing shows within the noise of a minute. A correction is bounded by the channel's span.

    `inputs`, `rows`: training rows. `series_um`, shape (n, n_channels): what the model left of rows it was not fitted
    on, see `left_out_series_um` [um]. `probe_min`: time between probes [min].
    """
    segments = fold_segments(inputs, rows)
    noise_um = scatter_um([inputs.measured_um[part] for part in segments])
    longest_min = max(float(inputs.time_min[part[-1]] - inputs.time_min[part[0]]) for part in segments)
    over_min = min(max(probe_min, SHORTEST_WANDER_MIN), max(0.5 * longest_min, inputs.period_min))
    wander = np.zeros(len(inputs.channels))
    for part in segments:
        wander = np.maximum(wander, wander_um2_per_min(inputs.time_min[part], series_um[part], over_min))
    most_um2 = wander * over_min
    for longer_min in LATER * over_min:
        gained = [wander_um2_per_min(inputs.time_min[part], series_um[part], longer_min) for part in segments]
        most_um2 = np.maximum(most_um2, longer_min * np.max(gained, axis=0))
    span = np.nanmax(inputs.measured_um[rows], axis=0) - np.nanmin(inputs.measured_um[rows], axis=0)
    return BiasFilter(
        wander_um2_per_min=np.maximum(wander - 2.0 * np.square(noise_um) / over_min, LEAST_WANDER * wander),
        noise_um=noise_um,
        largest_step_um=np.maximum(span, 1e-9),
        correlation_min=np.maximum(
            np.divide(most_um2, wander, out=np.full_like(wander, LONGEST_CORRELATION_MIN), where=wander > 0.0), over_min
        ),
    )


def left_out_series_um(inputs: Inputs, rows: BoolArray, fold: IntArray, fits: dict[int, Fit]) -> FloatArray:
    """Return measured minus estimated over all training rows, each fold by the fit that left it out.

    Result of shape (n, n_channels): about the mean of the same run's rows that the fit was trained on [um]; NaN
    elsewhere.

    `inputs`, `rows` and `fold`: training rows and their folds. `fits`: fold -> the fit without it.
    """
    series_um = np.full(inputs.measured_um.shape, np.nan)
    for number, fit in fits.items():
        level_um = inputs.measured_um - fit.estimate_um(inputs.features, inputs.features[0], inputs.time_min)
        out = rows & (fold == number)
        for run in np.unique(inputs.run[out]):
            of_run = inputs.run == run
            trained = level_um[rows & of_run & ~out]
            trained = trained[np.isfinite(trained).all(axis=1)]
            zero = trained.mean(axis=0) if len(trained) else 0.0
            series_um[out & of_run] = level_um[out & of_run] - zero
    return series_um
