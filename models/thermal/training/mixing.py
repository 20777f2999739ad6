"""How much each member counts in a mean: all good ones alike, unless what was chosen by their errors is clearly better.

The weights that are chosen: members are added one after the other, by what the mean leaves of left-out runs, after
Caruana et al., Ensemble selection from libraries of models (ICML 2004), with replacement: what is added twice counts
twice. It begins with the best member alone. Whether that is better is judged on folds that had no say in the weights,
because with few folds such a choice follows what is left by chance.
"""

from collections.abc import Callable, Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.training.evaluation import moving
from models.thermal.training.families import members
from models.thermal.training.left_out_errors import (
    LeftOutErrors,
    advantage,
    mean_errors,
    only,
    relative_of,
    together,
)

STEPS = 6
"""So many are added, the first and repetitions counted."""
MOST_MEMBERS = 4
"""No more different ones than this: further ones hardly change the mean, and each takes memory in the daemon."""
ADDED_BETTER = 1.0
"""By so many standard errors of the difference weights that were chosen must be better than even ones."""


def mean_weights(errors: Sequence[LeftOutErrors], *, mixed: bool = True) -> tuple[dict[int, float], LeftOutErrors]:
    """Return how much each member counts, by index, and what the mean leaves of each fold by weights of the others.

    The weights are positive and sum to 1; the even ones are kept unless those that were chosen leave clearly less.

    `errors`: what each member leaves of the same stretches. `mixed`: else even ones are all that is tried.
    """
    without, products = _products(errors)
    even, left_by_even = _judged(errors, without, products, _even_by_products)
    if not mixed:
        return even, left_by_even
    added, left_by_added = _judged(errors, without, products, _added_by_products)
    gained, error = advantage(left_by_added, left_by_even)
    return (added, left_by_added) if gained > ADDED_BETTER * error else (even, left_by_even)


def even_weights(scores: Sequence[float]) -> dict[int, float]:
    """Return even weights of the few best of all members that are nearly as good as the best, by index.

    `scores`: what each leaves of the left-out error; NaN where nothing could be left out.
    """
    kept = sorted(members(scores), key=lambda index: scores[index])[:MOST_MEMBERS]
    return dict.fromkeys(sorted(kept), 1.0 / len(kept))


def _judged(
    errors: Sequence[LeftOutErrors],
    without: FloatArray,
    products: FloatArray,
    weigh: Callable[[FloatArray, FloatArray], dict[int, float]],
) -> tuple[dict[int, float], LeftOutErrors]:
    """Return the weights by all folds, and what is left of each fold by the weights of the others."""
    numbers = np.unique(errors[0].folds)
    parts = []
    for place, number in enumerate(numbers):
        others = np.arange(len(numbers)) != place
        weights = weigh(without[others], products[:, :, others])
        some = [only(errors[index], int(number)) for index in weights]
        parts.append(mean_errors(some, list(weights.values())))
    return weigh(without, products), together(parts)


def _alone(without: FloatArray, products: FloatArray) -> list[float]:
    return [relative_of(without, products[index, index]) for index in range(len(products))]


def _even_by_products(without: FloatArray, products: FloatArray) -> dict[int, float]:
    return even_weights(_alone(without, products))


def _added_by_products(without: FloatArray, products: FloatArray) -> dict[int, float]:
    def left(counts: dict[int, int]) -> float:
        """Return what the mean leaves, see `relative`."""
        total = sum(counts.values())
        rest = sum(one * other * products[i, j] for i, one in counts.items() for j, other in counts.items())
        return relative_of(without, np.asarray(rest) / total**2)

    alone = _alone(without, products)
    if not np.isfinite(alone).any():
        return even_weights(alone)
    first = int(np.nanargmin(alone))
    best = {first: 1}, alone[first]
    counts = best[0]
    for _ in range(STEPS - 1):
        offered = [index for index in range(len(products)) if index in counts or len(counts) < MOST_MEMBERS]
        tried = [counts | {index: counts.get(index, 0) + 1} for index in offered]
        scores = [left(each) for each in tried]
        counts = tried[int(np.nanargmin(scores))]
        best = min(best, (counts, min(scores)), key=lambda each: each[1])
    total = sum(best[0].values())
    return {index: count / total for index, count in sorted(best[0].items())}


def _products(errors: Sequence[LeftOutErrors]) -> tuple[FloatArray, FloatArray]:
    """Return sums over the rows of each fold: measured squared, and each residual times each other [um^2].

    Result, of the channels that move: of shapes (n_folds, n_channels) and (n_members, n_members, n_folds, n_channels).
    """
    numbers = np.unique(errors[0].folds)
    channels = errors[0].measured_um[0].shape[1]
    without = np.zeros((len(numbers), channels))
    products = np.zeros((len(errors), len(errors), len(numbers), channels))
    for index, number in enumerate(errors[0].folds):
        place = int(np.searchsorted(numbers, number))
        residual = np.stack([each.probed_um(index) for each in errors])
        without[place] += np.square(errors[0].measured_um[index]).sum(axis=0)
        products[:, :, place] += np.einsum("anc,bnc->abc", residual, residual)
    moves = moving(errors[0].measured_um)
    return without[:, moves], products[..., moves]
