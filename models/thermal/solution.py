"""One fitted linear map from features to thermal error, from which sensors can be left out afterwards."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from models.model_file import ModelError, Numbers, Packed
from models.records import FloatArray
from models.thermal.features import BoolArray, Design, IntArray, Layout, canonical, design_columns

FULL_DISTANCE = 8.0
"""Up to so many times the farthest that training went, distance alone takes nothing from confidence ..."""
NO_DISTANCE = 16.0
"""... and here it leaves nothing: no machine is linear for ever ..."""
KNOWN_SHARE = 0.01
"""... the less, the smaller than this is the share of the change that training does not know: where it knows the
direction so well, the ranges of temperatures and speed say how far is too far."""
FULL_SPEED = 1.5
"""Up to so many times the highest spindle speed of training, speed takes nothing from confidence ..."""
NO_SPEED = 3.0
"""... and here it leaves nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """A ridge with all that leaving sensors out takes, or a fit of which only the weights are known.

    A sensor that is left out of a ridge is expected from all other features, and the rest is then exactly
    the ridge fitted without it. Of any other fit a sensor is taken for the mean of those beside it.
    """

    layout: Layout
    design: Design
    gain: Numbers
    """1 / scale of each column; 0 for a column that does not move, shape (d,)."""
    weights: Numbers
    """Solution in scaled columns [um], shape (d, n_channels)."""
    directions: Packed | None = None
    """Of a ridge: orthonormal principal directions of the scaled columns, shape (d, k)."""
    remaining: Numbers | None = None
    """Of a ridge: penalty / (eigenvalue + penalty) of each direction, shape (k,)."""

    def __post_init__(self) -> None:
        """Check shapes and numbers; raises ModelError."""
        columns = self.layout.columns
        if self.gain.shape != (columns,) or self.weights.ndim != 2 or len(self.weights) != columns:
            raise ModelError("solutions", f"has shapes {self.gain.shape}, {self.weights.shape}; {columns} columns")
        arrays: list[npt.NDArray[np.floating[Any]]] = [self.gain, self.weights]
        if (self.directions is None) != (self.remaining is None):
            raise ModelError("solutions", "directions and remaining go together")
        if self.directions is not None and self.remaining is not None:
            if self.directions.shape != (columns, len(self.remaining)):
                raise ModelError("solutions", f"directions have shape {self.directions.shape} for {columns} columns")
            if np.any(self.remaining < 0.0) or np.any(self.remaining > 1.0):
                raise ModelError("solutions", "a remaining share lies between 0 and 1")
            arrays += [self.directions, self.remaining]
        elif self.layout.lags_min or self.design.departures:
            raise ModelError("solutions", "only a model without lags does without directions")
        for array in arrays:
            if not np.isfinite(array).all():
                raise ModelError("solutions", "holds a number that is not finite")
            array.flags.writeable = False
        if np.any(self.gain < 0.0):
            raise ModelError("solutions", "a gain is not negative")

    def coefficients(self, without: Sequence[int] = (), beside: IntArray | None = None) -> FloatArray:
        """Return the coefficients of the features, fitted without some sensors.

        Leaving columns S out of the ridge ``(G + penalty) w = b`` changes the others to
        ``w - Q[:, S] Q[S, S]^-1 w[S]`` with Q the inverse of ``G + penalty``.

        Result of shape (layout.columns, n_channels): [um per unit of the feature]; zeros for the columns left out.

        `without`: indices of the sensors, from 0, with all their lags. `beside`, shape (n_sensors,): component of each
        sensor, as a number; None: all are on one. A ridge does not need it.
        """
        weights = self.weights
        if len(without) and self.directions is None:
            full = canonical(weights * self.gain[:, None], self.layout, self.design)
            return np.asarray(self._means(without, beside).T @ full)
        if len(without):
            out, to_out, worth = self.eliminated(without)
            weights = weights - to_out @ worth
            weights[out] = 0.0
        return canonical(weights * self.gain[:, None], self.layout, self.design)

    def eliminated(self, without: Sequence[int]) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return what leaving sensors out of a ridge takes, see `coefficients`.

        Result: the columns S, ``Q[:, S]``, and ``Q[S, S]^-1 w[S]`` of shape (len(S), n_channels) [um].

        `without`: indices of the sensors, from 0, with all their lags.
        """
        out = self.layout.of_sensors(without)
        to_out = self._inverse(out)
        return out, to_out, np.asarray(np.linalg.solve(to_out[out], self.weights[out]))

    def lost_share(self, without: Sequence[int]) -> float:
        """Return how much of the variance that a ridge explains in training it loses without some sensors, 0..1.

        Leaving columns S out adds ``w[S]^T Q[S, S]^-1 w[S]`` to the sum of squares that is left, Q the inverse of
        ``G + penalty``; before, ``w^T G w`` was explained. Of the worst channel.

        `without`: indices of the sensors, from 0, with all their lags.
        """
        assert self.directions is not None and self.remaining is not None
        known = self.remaining / np.maximum(1.0 - self.remaining, 1e-12)
        explained = (np.square(self.directions.T @ self.weights) / known[:, None]).sum(axis=0)
        return float(np.clip(self._lost(without) / np.maximum(explained, 1e-300), 0.0, 1.0).max())

    def _lost(self, without: Sequence[int]) -> FloatArray:
        """Return ``w[S]^T Q[S, S]^-1 w[S]`` of each channel, Q but for the same factor as in `leverage_and_size`."""
        out, _, worth = self.eliminated(without)
        return np.asarray((self.weights[out] * worth).sum(axis=0))

    def imputed_variance(self, without: Sequence[int]) -> FloatArray:
        """Return how far what a ridge takes some sensors for may be off: variance over leverage, shape (n_channels,).

        With Gaussian columns of precision Q the columns S deviate from what the others R let be expected of them by
        ``Q[S, S]^-1``, so the estimate by ``w[S]^T Q[S, S]^-1 w[S]``. How large all of it is since the reference says
        what the others have done: ``x[R]^T Q x[R]`` is the leverage, and in training it is as large as there are
        directions that training knows, ``sum(eigenvalue / (eigenvalue + penalty))``.

        `without`: indices of the sensors, from 0, with all their lags.
        """
        assert self.remaining is not None
        return self._lost(without) / max(float((1.0 - self.remaining).sum()), 1e-12)

    def departure_um(self, change: FloatArray, without: Sequence[int], beside: IntArray | None = None) -> FloatArray:
        """Return how far means taken for some sensors may be off [um], shape (n_channels,); of a fit that is no ridge.

        Each may have departed from the mean as far as that of those beside it which has departed farthest; the mean
        itself is as sure as there are many. With one alone all of its change is in doubt.

        `change`, shape (layout.columns,): change of the features. `without`, `beside`: see `coefficients`.
        """
        weights = self.weights * self.gain[:, None]
        group = np.zeros(self.layout.sensors, dtype=np.intp) if beside is None else beside
        found = np.zeros(weights.shape[1])
        for number in {int(group[sensor]) for sensor in without}:
            of_group = [sensor for sensor in without if group[sensor] == number]
            others = change[np.flatnonzero(self._others(of_group[0], without, group))]
            farthest = float(np.abs(others - others.mean()).max()) if len(others) > 1 else float(np.abs(others).sum())
            of_mean = np.square(weights[of_group].sum(axis=0)) / max(len(others), 1)
            found += farthest**2 * (np.square(weights[of_group]).sum(axis=0) + of_mean)
        return np.sqrt(found)

    def imputed(self, change: FloatArray, without: Sequence[int], beside: IntArray | None = None) -> FloatArray:
        """Return a change of the features with what the fit without some sensors takes theirs for.

        The ridge fitted without them gives what the whole one gives when the scaled columns S left out are
        ``-Q[S, S]^-1 Q[S, R] x[R]``, R the others: the values that the penalised fit expects of them.

        Result of the shape of the change: in the units of the features; a column that did not move in training is taken
        not to move.

        `change`, shape (layout.columns,) or (n, layout.columns): change of the features; what it holds for the sensors
        left out does not count. `without`: indices of the sensors, from 0, with all their lags. `beside`: see
        `coefficients`.
        """
        if self.directions is None:
            return np.asarray(change @ self._means(without, beside).T)
        out = self.layout.of_sensors(without)
        columns = design_columns(np.atleast_2d(change), self.layout, self.design).copy()
        scaled = columns * self.gain
        scaled[:, out] = 0.0
        to_out = self._inverse(out)
        expected = -np.linalg.solve(to_out[out], to_out.T @ scaled.T).T
        moves = self.gain[out] > 0.0
        columns[:, out] = np.where(moves, expected / np.where(moves, self.gain[out], 1.0), 0.0)
        found = np.atleast_2d(change).copy()
        found[:, out] = design_columns(columns, self.layout, self.design)[:, out]
        return found.reshape(change.shape)

    def _inverse(self, out: IntArray) -> FloatArray:
        """Return some columns of Q, the inverse of ``G + penalty``, but for a factor; shape (d, len(out))."""
        assert self.directions is not None and self.remaining is not None
        if self.directions.shape[0] == self.directions.shape[1]:
            return np.asarray(self.directions @ (self.directions[out] * self.remaining).T)
        to_out = self.directions @ (self.directions[out] * (self.remaining - 1.0)).T
        to_out[out] += np.eye(len(out))
        return np.asarray(to_out)

    def _means(self, without: Sequence[int], beside: IntArray | None) -> FloatArray:
        """Return the matrix that puts means for the sensors left out: of those beside them, else of all others."""
        group = np.zeros(self.layout.sensors, dtype=np.intp) if beside is None else beside
        found = np.eye(self.layout.columns)
        for sensor in without:
            others = self._others(sensor, without, group)
            found[sensor] = 0.0
            found[sensor, np.flatnonzero(others)] = 1.0 / max(int(others.sum()), 1)
        return found

    def _others(self, sensor: int, without: Sequence[int], group: IntArray) -> BoolArray:
        """Return of which sensors the mean is taken for one that is left out."""
        used = np.ones(self.layout.sensors, dtype=np.bool_)
        used[list(without)] = False
        near = used & (group == group[sensor])
        return near if near.any() else used


def imputed_mean(
    solutions: Sequence[Solution], change: FloatArray, without: Sequence[int], beside: IntArray | None = None
) -> FloatArray:
    """Return a change of the features with what several solutions take that of some sensors for in the mean.

    Of a lag the mean is taken over those that use it. Result of the shape of the change; see `Solution.imputed`.
    """
    if not len(without):
        return change
    uses = np.array([one.gain > 0.0 for one in solutions], dtype=np.float64)
    uses[:, ~uses.any(axis=0)] = 1.0
    share = uses / uses.sum(axis=0)
    imputed = [one.imputed(change, without, beside) for one in solutions]
    return np.asarray(np.sum([weight * each for weight, each in zip(share, imputed, strict=True)], axis=0))


def leverage_and_size(solutions: Sequence[Solution], change: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the leverage of changes of the features, and ``x^T x``: what it would be if training said nothing.

    A ridge with penalty p on columns with cross products G says of a change x how little training knows of it:
    ``p x^T (G + p)^-1 x``. With Gaussian weights that is the variance of the estimate but for a constant, so its
    root is a length, and a residual beyond the domain is expected to grow with it. A ridge without directions adds
    nothing. `change`, shape (n, d): features minus features at a reference.
    """
    total, size = np.zeros(len(change)), np.zeros(len(change))
    for ridge in solutions:
        if ridge.directions is None or ridge.remaining is None:
            continue
        scaled = design_columns(change, ridge.layout, ridge.design) * ridge.gain
        scores = np.square(scaled.astype(ridge.directions.dtype, copy=False) @ ridge.directions)
        total += scores @ ridge.remaining
        size += scores.sum(axis=1)
    return total, size


def band_factor(distance: FloatArray | float) -> FloatArray:
    """Return by how much a band is widened at a distance from the reference: not at all inside the domain.

    Result: of the same shape; beyond the domain the distance itself, because the deviation of the estimate is
    proportional to it.

    `distance`: the root of leverage over its largest value in training: 1 at the farthest that training went.
    """
    return np.maximum(1.0, distance)


def far_confidence(distance: float, unknown_share: float) -> float:
    """Return how far an estimate may be followed beyond the domain of training, 0..1.

    A far change in directions that training excited is known well; one in new directions is not, however near it is.

    `distance`: see `band_factor`. `unknown_share`: leverage over what it would be if training said nothing, 0..1.
    """
    beyond = max(distance - FULL_DISTANCE, 0.0) * min(unknown_share / KNOWN_SHARE, 1.0)
    near = max(1.0 - beyond / (NO_DISTANCE - FULL_DISTANCE), 0.0)
    unknown = min(unknown_share / max(1.0 - unknown_share, 1e-9), 1e3) if distance > 1.0 else 0.0
    return near / (1.0 + unknown * unknown)


def fast_confidence(speed_rpm: float, highest_rpm: float) -> float:
    """Return how far an estimate may be followed at a spindle speed beyond that of training, 0..1.

    Leverage sees only what the features hold, and temperatures do not tell at once of losses that grow with speed.

    `speed_rpm`: of now. `highest_rpm`: of training; 0 where none was recorded.
    """
    if highest_rpm <= 0.0:
        return 1.0
    return float(np.clip((NO_SPEED - abs(speed_rpm) / highest_rpm) / (NO_SPEED - FULL_SPEED), 0.0, 1.0))
