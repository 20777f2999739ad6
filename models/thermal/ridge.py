"""Ridge regression on whole levels, prepared once so that folds, penalties and sensors can be left out cheaply.

The cross products of every fold are kept. A fit on some of the folds adds them up and takes one
symmetric eigenvalue decomposition, which serves every penalty; a fit without some of the sensors
follows from it by block elimination, exactly, without another decomposition.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.records import FloatArray
from models.thermal.inputs import BRIDGE_MIN, BoolArray, Inputs, IntArray, Layout

PENALTIES: tuple[float, ...] = tuple(10.0 ** (half / 2.0) for half in range(-14, 4))
"""Candidates, relative to the mean variance of the columns."""
MOST_COLUMNS = 400
"""More columns are first turned into their leading principal directions, this many."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """How the columns and rows of one ridge are made."""

    departures: bool
    """Regress on temperatures minus their lags in place of the lags: another prior, the same space."""
    correlation_min: float | None
    """Correlation time of what the model does not explain [min]: rows are then weighed by generalised
    least squares, each minus the share of its predecessor that persists. None: rows as they are."""


def design_columns(features: FloatArray, layout: Layout, design: Design) -> FloatArray:
    """Return the columns that a design regresses on, shape (n, layout.columns)."""
    if not design.departures:
        return features
    columns = features.copy()
    for first in range(layout.sensors, layout.temperature_columns, layout.sensors):
        lag = slice(first, first + layout.sensors)
        columns[:, lag] = features[:, : layout.sensors] - features[:, lag]
    return columns


def canonical(coefficients: FloatArray, layout: Layout, design: Design) -> FloatArray:
    """Return the coefficients of features from those of a design's columns, shape (layout.columns, n_channels)."""
    if not design.departures:
        return coefficients
    found = coefficients.copy()
    for first in range(layout.sensors, layout.temperature_columns, layout.sensors):
        lag = slice(first, first + layout.sensors)
        found[: layout.sensors] += coefficients[lag]
        found[lag] = -coefficients[lag]
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RidgeSolution:
    """One fitted ridge, from which sensors can be left out afterwards."""

    layout: Layout
    design: Design
    gain: FloatArray
    """1 / scale of each column; 0 for a column that does not move, shape (d,)."""
    weights: FloatArray
    """Solution in scaled columns [um], shape (d, n_channels)."""
    directions: FloatArray
    """Orthonormal principal directions of the scaled columns, shape (d, k)."""
    remaining: FloatArray
    """penalty / (eigenvalue + penalty) of each direction, shape (k,)."""

    def coefficients(self, without: Sequence[int] = ()) -> FloatArray:
        """Return the coefficients of the features, fitted without some sensors.

        Leaving columns S out of ``(G + penalty) w = b`` changes the others to
        ``w - Q[:, S] Q[S, S]^-1 w[S]`` with Q the inverse of ``G + penalty``.

        Parameters
        ----------
        without
            Indices of the sensors, from 0, with all their lags.

        Returns
        -------
        numpy.ndarray, shape (layout.columns, n_channels)
            [um per unit of the feature]; zeros for the columns left out.

        """
        weights = self.weights
        if len(without):
            out = self.layout.of_sensors(without)
            to_out = self._inverse(out)
            weights = weights - to_out @ np.linalg.solve(to_out[out], weights[out])
            weights[out] = 0.0
        return canonical(weights * self.gain[:, None], self.layout, self.design)

    def imputed(self, change: FloatArray, without: Sequence[int]) -> FloatArray:
        """Return a change of the features with what the fit without some sensors takes theirs for.

        That fit gives what this one gives when the scaled columns S left out are
        ``-Q[S, S]^-1 Q[S, R] x[R]``, R the others: the values that the penalised fit expects of them.

        Parameters
        ----------
        change : shape (layout.columns,)
            Change of the features; what it holds for the sensors left out does not count.
        without
            Indices of the sensors, from 0, with all their lags.

        Returns
        -------
        numpy.ndarray, shape (layout.columns,)
            In the units of the features; a column that did not move in training is taken not to move.

        """
        out = self.layout.of_sensors(without)
        columns = design_columns(change[None], self.layout, self.design)[0].copy()
        scaled = columns * self.gain
        scaled[out] = 0.0
        to_out = self._inverse(out)
        expected = -np.linalg.solve(to_out[out], to_out.T @ scaled)
        moves = self.gain[out] > 0.0
        columns[out] = np.where(moves, expected / np.where(moves, self.gain[out], 1.0), 0.0)
        found = change.copy()
        found[out] = design_columns(columns[None], self.layout, self.design)[0][out]
        return found

    def _inverse(self, out: IntArray) -> FloatArray:
        """Return some columns of Q, the inverse of ``G + penalty``, but for a factor; shape (d, len(out))."""
        if self.directions.shape[0] == self.directions.shape[1]:
            return np.asarray(self.directions @ (self.directions[out] * self.remaining).T)
        to_out = self.directions @ (self.directions[out] * (self.remaining - 1.0)).T
        to_out[out] += np.eye(len(out))
        return np.asarray(to_out)


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

    Parameters
    ----------
    inputs
        The recordings.
    rows : shape (n,)
        Training rows.
    fold : shape (n,)
        Fold of every row; -1 is never left out.
    design
        Columns and rows.

    """

    def __init__(self, inputs: Inputs, rows: BoolArray, fold: IntArray, design: Design) -> None:
        self._layout, self._design = inputs.layout, design
        columns = design_columns(inputs.features, inputs.layout, design)
        spread = columns[rows].std(axis=0)
        moves = spread > 1e-9 * np.maximum(1.0, np.abs(columns[rows]).max(axis=0))
        self._gain = np.where(moves, 1.0 / np.where(moves, spread, 1.0), 0.0)
        scaled = (columns - columns[rows].mean(axis=0)) * self._gain
        self._basis: FloatArray | None = None
        if scaled.shape[1] > MOST_COLUMNS:
            eigenvalues, vectors = np.linalg.eigh(scaled[rows].T @ scaled[rows])
            self._basis = np.ascontiguousarray(vectors[:, np.argsort(eigenvalues)[::-1][:MOST_COLUMNS]])
            scaled = scaled @ self._basis
        self._pieces = _pieces(inputs, rows, fold, design, scaled)

    def solve(self, left_out: frozenset[int], penalties: Sequence[float]) -> list[RidgeSolution]:
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
                RidgeSolution(
                    layout=self._layout,
                    design=self._design,
                    gain=self._gain,
                    weights=directions @ (projected / damped[:, None]),
                    directions=directions,
                    remaining=relative * unit / damped,
                )
            )
        return found


def _pieces(inputs: Inputs, rows: BoolArray, fold: IntArray, design: Design, scaled: FloatArray) -> list[_Piece]:
    used, x, y = np.flatnonzero(rows), scaled[rows], inputs.cleansed_um[rows]
    if design.correlation_min is not None:
        elapsed_min = np.diff(inputs.time_min[used])
        follows = (np.diff(inputs.run[used]) == 0) & (np.diff(fold[used]) == 0)
        follows &= (elapsed_min > 0.0) & (elapsed_min <= max(BRIDGE_MIN, 1.5 * inputs.period_min))
        persists = np.exp(-elapsed_min / design.correlation_min)[:, None]
        x, y = (x[1:] - persists * x[:-1])[follows], (y[1:] - persists * y[:-1])[follows]
        used = used[1:][follows]
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
