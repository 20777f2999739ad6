"""How a machine with few recordings takes over what its sisters know: a combination of their models, then freer.

With no recording the mean of the fleet's models is taken. With one or two, a combination of them, no share negative,
and the mean, weighed: it cannot leave what sisters do, and so cannot do much harm, and what is special about a day is
not all taken for the machine. A channel whose error that makes larger takes over nothing. A fit that may go anywhere
from there is dangerous after one recording (it was worse than no model by a factor of five on one machine of eight).
From three recordings on, what leaves least of left-out recordings is taken: combinations that are pulled more or less,
of all channels or of each; from five on also free departures from them, or the machine's own ridge.

All is done on cross products, see `Products`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from models.records import FloatArray
from models.thermal.training.fleet.products import Products, summed
from models.thermal.training.ridge import PENALTIES

FEW = 2
"""Up to so many recordings nothing is chosen."""
FIRST_PULL = 0.3
"""Pull towards the mean, as a share of what the mean explains; chosen on the tuning sisters."""
FEW_PULL = 0.01
"""The same with one or two recordings, where the mean has its own weight beside."""
FEW_SHARE = 0.6
"""So much of what sets that combination apart from the mean is taken for the machine's; chosen so too."""
FREE_FROM = 5
"""With fewer recordings only combinations are tried: of three, left-out ones chose free fits on tuning sisters, which
were worse."""
PULLS = (0.1, 0.3, 1.0)
DEPARTURES = (1e-2, 1e-1, 1.0)
"""Penalties of free departures from a combination, relative to the mean variance of the columns."""
LONE_PENALTY = 1e-3
"""Of a ridge on a single recording, of which nothing can be left out."""
STALE_WEIGHT = 0.05
"""Recordings from before a change of the machine count so much."""
FEWEST_EACH = 2
"""So many recordings must lie before a change, and after it ..."""
FEWEST_IN_ALL = 5
"""... and there must be so many in all."""
LEAST_LEFT = 1e-3
"""Shares of the error below this tell nothing apart."""
CHANGE_PENALTY = 1e-2
"""Of the ridges that look for a change."""
BETTER = 0.7
"""Apart, no more than this share of what is left of the error together may remain, before the change and since; the
geometric mean over recordings, because one that goes where no other does must not decide."""

Fitter = Callable[[Sequence[Products]], FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Taken:
    """What a machine has taken over."""

    weights: FloatArray
    """In the directions of the space [um], shape (k, n_channels)."""
    how: str
    """In words."""
    fitter: Fitter
    """Fits the same on other recordings."""


def ridge(products: Sequence[Products], penalty: float, towards: FloatArray | None = None) -> FloatArray:
    """Return the ridge on recordings, shape (k, n_channels), pulled towards weights, or towards 0.

    `penalty`: relative to the mean variance of the columns.
    """
    whole = summed(products)
    size = len(whole.xx)
    damped = whole.xx + max(penalty * float(np.trace(whole.xx)) / size, 1e-12) * np.eye(size)
    if towards is None:
        return np.asarray(np.linalg.solve(damped, whole.xy))
    return np.asarray(towards + np.linalg.solve(damped, whole.xy - whole.xx @ towards))


def combination(
    products: Sequence[Products], members: FloatArray, pull: float = FIRST_PULL, *, by_channel: bool = False
) -> FloatArray:
    """Return the combination of sisters' models that explains recordings best, shape (k, n_channels).

    Its shares a solve ``min |y - sum_m a_m X w_m|^2 + p |a - 1/M|^2`` with all a_m >= 0, each channel over its own sum
    of squares, so that without anything to say it is the mean.

    `products`: of the recordings. `members`, shape (M, k, n_channels): the sisters' models. `pull`: p over M times what
    the mean explains of a channel. `by_channel`: each channel has shares of its own.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - never loaded by the resident daemon

    whole, count = summed(products), len(members)
    even = np.full(count, 1.0 / count)
    moves = whole.yy > 0.0
    scale = np.where(moves, 1.0 / np.where(moves, whole.yy, 1.0), 0.0)
    grams = np.einsum("mdc,de,nec->cmn", members, whole.xx, members, optimize=True) * scale[:, None, None]
    sides = np.einsum("mdc,dc->cm", members, whole.xy) * scale[:, None]

    def shares(gram: FloatArray, side: FloatArray) -> FloatArray:
        """Return the shares that the normal equations of some channels say."""
        strength = pull * float(even @ gram @ even) * count
        if not strength > 0.0:
            return even
        lower = np.linalg.cholesky(gram + (strength + 1e-12 * float(np.trace(gram))) * np.eye(count))
        return np.asarray(nnls(lower.T, np.linalg.solve(lower, side + strength * even))[0])

    if not by_channel:
        return np.asarray(np.einsum("m,mdc->dc", shares(grams.sum(axis=0), sides.sum(axis=0)), members))
    columns = [shares(grams[c], sides[c]) @ members[:, :, c] for c in range(members.shape[2])]
    return np.stack(columns, axis=1)


def own_ridge(products: Sequence[Products]) -> Taken:
    """Return a machine's own ridge, from its recordings alone; its penalty leaves least of recordings left out."""
    if len(products) < 2:
        return _taken(products, lambda some: ridge(some, LONE_PENALTY), "its own ridge")
    fitters = {f"its own ridge, penalty {p:.3g}": _ridge_of(p) for p in PENALTIES}
    return _best(products, fitters)


def taken_over(products: Sequence[Products], members: FloatArray) -> Taken:
    """Return what a machine takes over from its sisters.

    `products`: of its recordings, one after the other in time; none for the mean. `members`, shape (M, k, n_channels):
    the sisters' models.
    """
    mean = members.mean(axis=0)
    if not products:
        return Taken(weights=mean, how="the mean of the fleet", fitter=lambda some: mean)
    if len(products) <= FEW:
        return _taken(products, _weighed_with_mean(members), "a combination of the fleet's models")
    fitters: dict[str, Fitter] = {}
    for by_channel in (False, True):
        for pull in PULLS:
            of = " of each channel" if by_channel else ""
            fitters[f"a combination{of} of the fleet's models, pull {pull:g}"] = _combined(members, pull, by_channel)
    if len(products) >= FREE_FROM:
        for penalty in DEPARTURES:
            fitters[f"free departures from a combination, penalty {penalty:g}"] = _departing(members, penalty)
        best_own = own_ridge(products)
        fitters[best_own.how] = best_own.fitter
    return _best(products, fitters)


def first_that_counts(products: Sequence[Products]) -> int:
    """Return the first recording of a machine as it is now; 0 where it has not changed.

    It has changed where the recordings before and after are each predicted best by their own kind.
    """
    count = len(products)
    if count < FEWEST_IN_ALL:
        return 0

    def left(some: Sequence[Products]) -> FloatArray:
        """Return what a ridge on the others leaves of each recording, one after the other."""
        found = [relative(one, ridge(_without(some, at), CHANGE_PENALTY)) for at, one in enumerate(some)]
        return np.maximum(np.nan_to_num(found, nan=1.0), LEAST_LEFT)

    together = left(products)
    ratios = {
        at: np.log(np.append(left(products[:at]), left(products[at:])) / together)
        for at in range(FEWEST_EACH, count - 1)
    }
    place = min(ratios, key=lambda at: float(ratios[at].sum()))
    apart = max(ratios[place][:place].mean(), ratios[place][place:].mean())
    return place if apart <= np.log(BETTER) else 0


def weighed(products: Sequence[Products]) -> list[Products]:
    """Return recordings in time, those from before a change of the machine counting little."""
    first = first_that_counts(products)
    return [one.times(STALE_WEIGHT if at < first else 1.0) for at, one in enumerate(products)]


def relative(products: Products, weights: FloatArray) -> float:
    """Return the mean over the channels that move of RMSE with / without weights."""
    moves = products.since_yy > 0.0
    if not moves.any():
        return float("nan")
    return float(np.sqrt(products.left_um2(weights)[moves] / products.since_yy[moves]).mean())


def _weighed_with_mean(members: FloatArray) -> Fitter:
    mean = members.mean(axis=0)

    def fit(some: Sequence[Products]) -> FloatArray:
        weights = mean + FEW_SHARE * (combination(some, members, FEW_PULL) - mean)
        whole = summed(some)
        return np.where(whole.left_um2(weights) < whole.since_yy, weights, 0.0)

    return fit


def _combined(members: FloatArray, pull: float, by_channel: bool) -> Fitter:
    return lambda some: combination(some, members, pull, by_channel=by_channel)


def _departing(members: FloatArray, penalty: float) -> Fitter:
    return lambda some: ridge(some, penalty, combination(some, members))


def _ridge_of(penalty: float) -> Fitter:
    return lambda some: ridge(some, penalty)


def _taken(products: Sequence[Products], fitter: Fitter, how: str) -> Taken:
    return Taken(weights=fitter(products), how=how, fitter=fitter)


def _best(products: Sequence[Products], fitters: dict[str, Fitter]) -> Taken:
    """Return what leaves least of recordings that are left out in turn."""
    left = {how: _left_out(products, fitter) for how, fitter in fitters.items()}
    how = min(left, key=lambda name: left[name])
    return _taken(products, fitters[how], how)


def _left_out(products: Sequence[Products], fitter: Fitter) -> float:
    squares = sum(one.left_um2(fitter(_without(products, at))) for at, one in enumerate(products))
    without = summed(products).since_yy
    moves = without > 0.0
    return float(np.sqrt(np.asarray(squares)[moves] / without[moves]).mean()) if moves.any() else 0.0


def _without(products: Sequence[Products], place: int) -> list[Products]:
    return [one for at, one in enumerate(products) if at != place]
