"""Ridge regression on whole levels, prepared once so that folds, penalties and sensors can be left out cheaply.

The cross products of every fold are kept. A fit on some of the folds adds them up and takes one
symmetric eigenvalue decomposition, which serves every penalty; a fit without some of the sensors
follows from it by block elimination, exactly, without another decomposition.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.features import BoolArray, Design, IntArray, design_columns
from models.thermal.solution import Solution
from models.thermal.training.inputs import Inputs

PENALTIES: tuple[float, ...] = tuple(10.0 ** (half / 2.0) for half in range(-14, 4))
"""Candidates, relative to the mean variance of the columns."""
MOST_COLUMNS = 200
"""More columns are first turned into their leading principal directions, this many."""
DIRECTION_ROWS = 900
"""So many rows, evenly spread, tell these directions; neighbouring rows say nearly the same."""
MOST_AT_ONCE = 256
"""Rows of which all columns are made at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Piece:
    """Cross products of the rows of one fold in one run."""

    fold: int
    run: int
    rows: int
    sum_x: FloatArray
    sum_y: FloatArray
    xx: FloatArray
    xy: FloatArray


class RidgeProblem:
    """A ridge on some rows of recordings, of which folds can be left out.

    Every run has an intercept of its own, because the zero of its displacements is its own.

    `rows`, shape (n,): training rows. `fold`, shape (n,): fold of every row; -1 is never left out. `design`: columns.
    """

    def __init__(self, inputs: Inputs, rows: BoolArray, fold: IntArray, design: Design) -> None:
        self._layout, self._design = inputs.layout, design
        mean, spread, largest = _scale(inputs, rows, design)
        moves = spread > 1e-9 * np.maximum(1.0, largest)
        self._gain = np.where(moves, 1.0 / np.where(moves, spread, 1.0), 0.0)

        def scaled(some: IntArray) -> FloatArray:
            """Return the columns of some rows about their mean, over their deviation."""
            columns = design_columns(inputs.features[some], inputs.layout, design) - mean
            columns *= self._gain
            return columns

        used = np.flatnonzero(rows)
        self._basis: npt.NDArray[np.float32] | None = None
        if inputs.layout.columns > MOST_COLUMNS:
            self._basis = _leading_directions(scaled(used[:: 1 + len(used) // DIRECTION_ROWS])).astype(np.float32)
            parts = [scaled(used[at : at + MOST_AT_ONCE]) @ self._basis for at in range(0, len(used), MOST_AT_ONCE)]
            x = np.vstack(parts)
        else:
            x = scaled(used)
        self._pieces = _pieces(inputs, used, fold, x)

    def solve(self, left_out: frozenset[int], penalties: Sequence[float]) -> list[Solution]:
        """Return the fits on everything but some folds, one per relative penalty."""
        used = [piece for piece in self._pieces if piece.fold not in left_out]
        xx, xy = _centred(used)
        rows = sum(piece.rows for piece in used)
        eigenvalues, vectors = np.linalg.eigh(xx)
        eigenvalues = np.maximum(eigenvalues, 0.0)
        moving = max(int((self._gain > 0.0).sum()), 1)
        unit = max(float(eigenvalues.sum()) / moving, 1e-12 * max(rows, 1))
        projected = vectors.T @ xy
        directions = vectors if self._basis is None else self._basis @ vectors
        found = []
        for relative in penalties:
            damped = eigenvalues + relative * unit
            found.append(
                Solution(
                    layout=self._layout,
                    design=self._design,
                    gain=self._gain,
                    weights=directions @ (projected / damped[:, None]),
                    directions=directions,
                    remaining=relative * unit / damped,
                )
            )
        return found


def _scale(inputs: Inputs, rows: BoolArray, design: Design) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean, deviation and largest absolute value of each column of a design, each of shape (d,).

    Hundreds of sensors with all their lags are some hundred megabytes, so only some rows are looked at together.
    """
    used = np.flatnonzero(rows)
    parts = [used[at : at + MOST_AT_ONCE] for at in range(0, len(used), MOST_AT_ONCE)]
    total, largest, squares = (np.zeros(inputs.layout.columns) for _ in range(3))
    for part in parts:
        columns = design_columns(inputs.features[part], inputs.layout, design)
        total += columns.sum(axis=0)
        largest = np.maximum(largest, np.abs(columns).max(axis=0))
    mean = total / max(len(used), 1)
    for part in parts:
        columns = design_columns(inputs.features[part], inputs.layout, design) - mean
        squares += np.einsum("ij,ij->j", columns, columns)
    return mean, np.sqrt(squares / max(len(used), 1)), largest


def _leading_directions(some: FloatArray) -> FloatArray:
    """Return the directions along which rows differ most, shape (d, at most `MOST_COLUMNS`).

    `some`, shape (n, d): standardised columns about their mean, of the rows that tell.
    """
    eigenvalues, vectors = np.linalg.eigh(some @ some.T)
    kept = np.argsort(eigenvalues)[::-1][: min(MOST_COLUMNS, some.shape[1])]
    kept = kept[eigenvalues[kept] > 1e-10 * max(float(eigenvalues[-1]), 1e-300)]
    return np.ascontiguousarray(some.T @ vectors[:, kept] / np.sqrt(eigenvalues[kept]))


def _pieces(inputs: Inputs, used: IntArray, fold: IntArray, x: FloatArray) -> list[_Piece]:
    y = inputs.cleansed_um[used]
    found = []
    for run in np.unique(inputs.run[used]):
        for number in np.unique(fold[used][inputs.run[used] == run]):
            part = (inputs.run[used] == run) & (fold[used] == number)
            found.append(
                _Piece(
                    fold=int(number),
                    run=int(run),
                    rows=int(part.sum()),
                    sum_x=x[part].sum(axis=0),
                    sum_y=y[part].sum(axis=0),
                    xx=x[part].T @ x[part],
                    xy=x[part].T @ y[part],
                )
            )
    return found


def _centred(pieces: Sequence[_Piece]) -> tuple[FloatArray, FloatArray]:
    """Return the cross products of several pieces about the mean of each run."""
    xx = np.sum([piece.xx for piece in pieces], axis=0)
    xy = np.sum([piece.xy for piece in pieces], axis=0)
    for run in {piece.run for piece in pieces}:
        of_run = [piece for piece in pieces if piece.run == run]
        count = sum(piece.rows for piece in of_run)
        sum_x, sum_y = sum(piece.sum_x for piece in of_run), sum(piece.sum_y for piece in of_run)
        xx = xx - np.outer(sum_x, sum_x) / count
        xy = xy - np.outer(sum_x, sum_y) / count
    return xx, xy
