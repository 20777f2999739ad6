"""How much each member counts in a mean: they are added one after the other, by what the mean leaves of left-out runs.

After Caruana et al., Ensemble selection from libraries of models (ICML 2004), with replacement: what is added twice
counts twice. It begins with the best member alone.
"""

from collections.abc import Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.training.left_out_errors import LeftOutErrors, relative_of

STEPS = 6
"""So many are added, the first and repetitions counted."""
MOST_MEMBERS = 4
"""No more different ones than this: further ones hardly change the mean, and each takes memory in the daemon."""


def mixing_weights(errors: Sequence[LeftOutErrors]) -> dict[int, float]:
    """Return how much each member counts, by index; the weights are positive and sum to 1.

    `errors`: what each member leaves of the same stretches.
    """
    without, products = _products(errors)

    def left(counts: dict[int, int]) -> float:
        """Return what the mean leaves, see `relative`."""
        total = sum(counts.values())
        rest = sum(one * other * products[i, j] for i, one in counts.items() for j, other in counts.items())
        return relative_of(without, np.asarray(rest) / total**2)

    alone = [left({index: 1}) for index in range(len(errors))]
    if not np.isfinite(alone).any():
        return dict.fromkeys(range(min(len(errors), MOST_MEMBERS)), 1.0 / min(len(errors), MOST_MEMBERS))
    first = int(np.nanargmin(alone))
    best = {first: 1}, alone[first]
    counts = best[0]
    for _ in range(STEPS - 1):
        offered = [index for index in range(len(errors)) if index in counts or len(counts) < MOST_MEMBERS]
        tried = [counts | {index: counts.get(index, 0) + 1} for index in offered]
        scores = [left(each) for each in tried]
        counts = tried[int(np.nanargmin(scores))]
        best = min(best, (counts, min(scores)), key=lambda each: each[1])
    total = sum(best[0].values())
    return {index: count / total for index, count in sorted(best[0].items())}


def _products(errors: Sequence[LeftOutErrors]) -> tuple[FloatArray, FloatArray]:
    """Return sums over the rows of each fold: measured squared, and each residual times each other [um^2].

    Result of shapes (n_folds, n_channels) and (n_members, n_members, n_folds, n_channels).
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
    return without, products
