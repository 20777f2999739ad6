"""How the error that a model leaves grows over months after its release, and when it should be trained anew.

Measured errors of the machine (probe values, displacements) are set against what the estimate leaves of them, in blocks
of a week: share = rms of what is left / rms of what there is without. A line through the shares of the last weeks tells
the trend; its interval allows for neighbouring weeks that err alike (the lag-1 correlation of the residuals widens it
by sqrt((1 + r) / (1 - r))). Retraining is asked for when the line has crossed the bound, or will within `LEAD_D`.
"""

import math
from dataclasses import dataclass

import numpy as np

from models.errors import RefusedInputError
from models.records import FloatArray

WEEK_D = 7.0
FIRST_WEEKS = 8
"""Weeks after the release that say what the model was worth."""
KEPT = 0.8
"""Without another bound, a model must keep so much of the error that it took away in these weeks."""
LEAST_WEEKS = 16
"""Fewer weeks show no trend, and ask for nothing."""
WINDOWS = (26, 52)
"""The trend is sought in the last so many weeks."""
DEVIATIONS = 3.0
"""A trend counts when it is so many standard errors from zero (of a normal distribution).

Chosen with the two above on made-up years of even seeds (tests/models/test_drift.py judges on odd ones)."""
LEAD_D = 60.0
"""Retraining is asked for when the bound is nearer than this [d]."""
LEAST_PAIRS = 5
"""A week with fewer measurements does not count."""
LARGEST_CORRELATION = 0.8
OUTLIER_DEVIATIONS = 5.0
"""What is left counts as at most so many robust standard deviations of its week: a chip under the probe is no drift.

The larger deviation counts of all and of where the error is large: in a week that the machine mostly stood, what a
worn model leaves of the few hours of work was taken for such chips."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trend:
    """A line through weekly shares."""

    share: float
    """At the end of the last week."""
    share_error: float
    """Its standard error; both intervals are this times `deviations`."""
    per_d: float
    """Growth of the share [1/d]."""
    per_d_error: float
    deviations: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """What the weeks since a release tell."""

    weeks: int
    """Weeks that count."""
    first_share: float
    """Share of the error that the model left in its first weeks."""
    share: float
    """The same now."""
    share_interval: tuple[float, float]
    per_30_d: float
    """Growth of the share in 30 days."""
    per_30_d_interval: tuple[float, float]
    bound: float
    """Share at which the model counts as worn out."""
    until_bound_d: float | None
    """Days until the line crosses the bound, 0 when it has; None: it does not."""
    until_bound_interval_d: tuple[float | None, float | None]
    """Earliest and latest by the intervals; None: not foreseeable."""
    retrain: bool
    """Retraining is asked for."""


def weekly_shares(
    time_d: FloatArray, without_um: FloatArray, left_um: FloatArray, least_error_um: float
) -> tuple[FloatArray, FloatArray]:
    """Return the middle of each week that counts [d] and the share of the error that was left in it.

    `time_d`: times of the measurements, shape (n,) [d]. `without_um`, `left_um`: error without compensation, and what
    the estimate leaves of it, shape (n,) [um]. `least_error_um`: weeks in which both are below this say nothing [um].
    """
    known = np.isfinite(time_d) & np.isfinite(without_um) & np.isfinite(left_um)
    time_d, without_um, left_um = time_d[known], without_um[known], left_um[known]
    middles, shares = [], []
    if len(time_d):
        week = np.floor((time_d - time_d.min()) / WEEK_D).astype(np.intp)
        for number in np.unique(week):
            of_week = week == number
            if of_week.sum() < LEAST_PAIRS:
                continue
            without, left = without_um[of_week], left_um[of_week]
            there = _rms(without)
            large = left[np.abs(without) >= there / 2.0]
            most = max(_most(left), _most(large) if len(large) >= LEAST_PAIRS else 0.0)
            remains = _rms(np.clip(left, -most, most))
            if max(there, remains) < least_error_um or there == 0.0:
                continue
            middles.append(float(time_d.min()) + WEEK_D * (float(number) + 0.5))
            shares.append(remains / there)
    return np.array(middles), np.array(shares)


def judge_drift(
    time_d: FloatArray,
    without_um: FloatArray,
    left_um: FloatArray,
    *,
    bound: float | None = None,
    least_error_um: float = 5.0,
) -> Drift | None:
    """Return what the measurements since a model's release tell; None with fewer than `FIRST_WEEKS` weeks.

    Raises RefusedInputError when the arrays differ in length or the bound is not positive.

    `time_d`, `without_um`, `left_um`, `least_error_um`: see `weekly_shares`. `bound`: share at which the model counts
    as worn out; None: where it has lost 1 - `KEPT` of what it took away at first.
    """
    if not len(time_d) == len(without_um) == len(left_um):
        raise RefusedInputError(f"{len(time_d)} times, {len(without_um)} errors and {len(left_um)} rests do not fit")
    if bound is not None and not 0.0 < bound < math.inf:
        raise RefusedInputError(f"bound {bound}: give the share of the error that may be left, such as 0.4")
    return drift_of_shares(*weekly_shares(time_d, without_um, left_um, least_error_um), bound)


def drift_of_shares(middles: FloatArray, shares: FloatArray, bound: float | None = None) -> Drift | None:
    """Return what weekly shares tell; None with fewer than `FIRST_WEEKS`.

    `middles`, `shares`: from `weekly_shares`. `bound`: see `judge_drift`.
    """
    if len(shares) < FIRST_WEEKS:
        return None
    first = float(np.mean(shares[:FIRST_WEEKS]))
    limit = bound if bound is not None else max(1.0 - KEPT * (1.0 - first), first)
    trend, asks = _asks(middles, shares, limit)
    before = len(shares) > LEAST_WEEKS and _asks(middles[:-1], shares[:-1], limit)[1]
    half, slope_half = trend.deviations * trend.share_error, trend.deviations * trend.per_d_error
    low, high = trend.per_d - slope_half, trend.per_d + slope_half
    return Drift(
        weeks=len(shares),
        first_share=first,
        share=trend.share,
        share_interval=(max(trend.share - half, 0.0), trend.share + half),
        per_30_d=30.0 * trend.per_d,
        per_30_d_interval=(30.0 * low, 30.0 * high),
        bound=limit,
        until_bound_d=_until(limit, trend.share, trend.per_d),
        until_bound_interval_d=(_until(limit, trend.share + half, high), _until(limit, trend.share - half, low)),
        retrain=bool(asks and before),
    )


def _asks(middles: FloatArray, shares: FloatArray, bound: float) -> tuple[Trend, bool]:
    """Return the trend of the window that crosses the bound first, and whether it asks for retraining."""
    found = [_trend(middles[-size:], shares[-size:]) for size in WINDOWS]
    asking = [trend for trend in found if _worn(trend, bound)]
    return (asking or found[-1:])[0], bool(asking)


def _worn(trend: Trend, bound: float) -> bool:
    if trend.share - trend.deviations * trend.share_error > bound:
        return True
    until_d = _until(bound, trend.share, trend.per_d)
    return trend.per_d > trend.deviations * trend.per_d_error and until_d is not None and until_d < LEAD_D


def _until(bound: float, share: float, per_d: float) -> float | None:
    if share >= bound:
        return 0.0
    return (bound - share) / per_d if per_d > 1e-9 else None


def _trend(middles: FloatArray, shares: FloatArray) -> Trend:
    """Return a least-squares line with the standard errors of residuals that are correlated from week to week."""
    count = len(shares)
    if count < LEAST_WEEKS:
        recent = shares[-FIRST_WEEKS:]
        error = float(np.std(recent, ddof=1)) / math.sqrt(len(recent))
        return Trend(
            share=float(np.mean(recent)),
            share_error=error,
            per_d=0.0,
            per_d_error=math.inf,
            deviations=_student(DEVIATIONS, len(recent) - 1.0),
        )
    end = float(middles[-1]) + WEEK_D / 2.0
    centred = middles - middles.mean()
    spread = float(centred @ centred)
    per_d = float(centred @ shares) / spread
    residual = shares - shares.mean() - per_d * centred
    energy = float(residual @ residual)
    correlation = float(residual[1:] @ residual[:-1]) / energy if energy > 0.0 else 0.0
    correlation = min(max(correlation, 0.0), LARGEST_CORRELATION)
    wider = math.sqrt((1.0 + correlation) / (1.0 - correlation))
    deviation = math.sqrt(energy / (count - 2)) * wider
    reach = end - float(middles.mean())
    return Trend(
        share=float(shares.mean()) + per_d * reach,
        share_error=deviation * math.sqrt(1.0 / count + reach**2 / spread),
        per_d=per_d,
        per_d_error=deviation / math.sqrt(spread),
        deviations=_student(DEVIATIONS, max(count / wider**2 - 2.0, 2.0)),
    )


def _student(deviations: float, freedom: float) -> float:
    """Return the deviations of Student's distribution that are as rare (Cornish-Fisher, to the second order)."""
    z = deviations
    return z + (z**3 + z) / (4.0 * freedom) + (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * freedom**2)


def _most(left: FloatArray) -> float:
    """Return what counts at most of what is left [um]."""
    middle = float(np.median(left))
    return abs(middle) + OUTLIER_DEVIATIONS * max(1.4826 * float(np.median(np.abs(left - middle))), 1e-9)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
