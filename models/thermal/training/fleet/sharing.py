"""How much each machine of a fleet counts in what all know: by what its model tells of the other machines.

A model that was fitted on a single recording, on a machine that was changed in the middle, or on one of another type
tells the others little, and would spoil a plain mean. So the shares are those of a combination that leaves least of
every machine's error, each machine told by the others alone; without anything to say they are even, but for machines
of fewer rows than usual, which count by these.
"""

from collections.abc import Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.training.fleet.products import Products

PULL = 1.0
"""Pull of the shares towards plain ones, over what a usual model explains; chosen on made-up types of machine."""


class Sharing:
    """What the models of machines say of each other's recordings.

    `models`, shape (M, k, n_channels); `products`: of all recordings of each machine.
    """

    def __init__(self, models: FloatArray, products: Sequence[Products]) -> None:
        size = len(models)
        self._models = models
        self._grams, self._sides = np.empty((size, size, size)), np.empty((size, size))
        rows = np.array([one.rows for one in products], dtype=np.float64)
        self._counts = np.minimum(rows / np.median(rows), 1.0)
        usual_um2 = np.median([one.since_yy / one.rows for one in products], axis=0)
        for at, one in enumerate(products):
            moved = np.maximum(one.since_yy, usual_um2 * one.rows)
            scale = np.where(moved > 0.0, 1.0 / np.where(moved > 0.0, moved, 1.0), 0.0)
            scaled = models * scale
            explained = np.einsum("de,mec->mdc", one.since_xx, models, optimize=True)
            self._grams[at] = np.tensordot(scaled, explained, axes=((1, 2), (1, 2)))
            self._sides[at] = np.tensordot(scaled, one.since_xy, axes=((1, 2), (0, 1)))

    def members(self, places: Sequence[int]) -> FloatArray:
        """Return the models of some machines, each times its share and their number: their mean is what they know.

        Nothing else is used of the machines that are not among them.
        """
        return np.asarray(self._models[list(places)] * (len(places) * self._shares(places))[:, None, None])

    def _shares(self, places: Sequence[int]) -> FloatArray:
        """Return the shares of some machines, none negative, of sum 1."""
        from scipy.optimize import nnls  # noqa: PLC0415 - never loaded by the resident daemon

        count, counts = len(places), self._counts[list(places)]
        plain = counts / counts.sum()
        if count < 3:
            return np.asarray(plain)
        grams, sides = self._grams[np.ix_(places, places, places)], self._sides[np.ix_(places, places)]
        others = 1.0 - np.eye(count)  # no machine is told by its own model
        gram = (grams * others[:, :, None] * (counts[:, None] * others)[:, None, :]).sum(axis=0)
        side = (sides * counts[:, None] * others).sum(axis=0)
        strength = PULL * float(np.median(np.diag(gram)))
        if not strength > 0.0:
            return np.asarray(plain)
        lower = np.linalg.cholesky(gram + strength * np.eye(count))
        found = nnls(lower.T, np.linalg.solve(lower, side + strength * plain * count / (count - 1)))[0]
        return np.asarray(found / found.sum() if found.any() else plain)


def usual_motion(moved_um: FloatArray) -> FloatArray:
    """Return by what an error of each channel of each machine counts, shape (n_machines, n_channels) [um].

    That is how far it moves; where it happens to move little, what one usually does on machines, times how far the
    other channels of its machine move for usual ones.

    `moved_um`: root mean squares.
    """
    usual_um = np.median(moved_um, axis=0)
    moves = usual_um > 0.0
    if not moves.any():
        return moved_um
    size = np.median(moved_um[:, moves] / usual_um[moves], axis=1)
    return np.maximum(moved_um, size[:, None] * usual_um)
