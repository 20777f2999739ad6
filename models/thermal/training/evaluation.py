"""Measures how good an estimate is: residuals with and without it, from one reference on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.jumps import scatter_um
from models.records import FloatArray
from models.thermal.features import BoolArray

NOISE_FACTOR = 4.0
"""A channel moves when its values between 5 and 95 % span more than so many times the scatter of neighbouring rows."""


def spans_um(stretches: Sequence[FloatArray]) -> FloatArray:
    """Return the largest span within a stretch between 5 and 95 % of each channel's values [um], see `moving`."""
    spans = [[_span_um(column[np.isfinite(column)]) for column in each.T] for each in stretches]
    return np.asarray(np.max(spans, axis=0), dtype=np.float64)


def _span_um(values: FloatArray) -> float:
    return float(np.subtract(*np.quantile(values, (0.95, 0.05)))) if len(values) else 0.0


def moving(stretches: Sequence[FloatArray]) -> BoolArray:
    """Return which channels have a say in how good a model is: those that move, or all where none does.

    Nothing can be learned about one that never leaves its noise, so what is left of it says nothing of a model.

    `stretches`: measured displacements [um], each of shape (n, n_channels), NaN where missing.
    """
    if not len(stretches):
        return np.ones(0, dtype=np.bool_)
    moves = spans_um(stretches) > NOISE_FACTOR * scatter_um(stretches)
    return moves if moves.any() else np.ones_like(moves)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualMetrics:
    """Residuals of each channel after both series are referenced to the first sample."""

    channels: tuple[str, ...]
    rmse_without_um: FloatArray
    """Root mean square of the measured thermal error [um], shape (n_channels,)."""
    max_without_um: FloatArray
    """Its largest absolute value [um]."""
    rmse_with_um: FloatArray
    """Root mean square of measured minus estimated [um]."""
    max_with_um: FloatArray

    @property
    def relative_rmse(self) -> FloatArray:
        """RMSE with / without the estimate, shape (n_channels,); 0 for a channel that never moves."""
        moves = self.rmse_without_um > 0.0
        return np.divide(self.rmse_with_um, self.rmse_without_um, out=np.zeros(len(self.channels)), where=moves)


def residual_metrics(channels: tuple[str, ...], measured_um: FloatArray, estimated_um: FloatArray) -> ResidualMetrics:
    """Return RMSE and largest residual with and without the estimate.

    Result: NaN for a channel that was never measured. Raises ValueError when shapes differ, there is no row, or an
    estimate is not finite.

    `channels`: names of the channels. `measured_um` and `estimated_um`, shape (n, n_channels): measured and estimated
    displacements [um]. Both are referenced to the first row in which the channel was measured; rows without a measured
    value are left out.
    """
    if measured_um.shape != estimated_um.shape or measured_um.shape[1:] != (len(channels),) or not len(measured_um):
        raise ValueError(
            f"{len(channels)} channels need measured and estimated tables of the same rows, "
            f"got {measured_um.shape} and {estimated_um.shape}"
        )
    if not np.isfinite(estimated_um).all():
        raise ValueError("an estimate is not finite")
    figures = np.full((4, len(channels)), np.nan)
    for channel in range(len(channels)):
        known = np.flatnonzero(np.isfinite(measured_um[:, channel]))
        if not len(known):
            continue
        error_um = measured_um[known, channel] - measured_um[known[0], channel]
        residual_um = error_um - (estimated_um[known, channel] - estimated_um[known[0], channel])
        figures[:, channel] = (*_rmse_and_max(error_um), *_rmse_and_max(residual_um))
    return ResidualMetrics(
        channels=channels,
        rmse_without_um=figures[0],
        max_without_um=figures[1],
        rmse_with_um=figures[2],
        max_with_um=figures[3],
    )


def _rmse_and_max(values: FloatArray) -> tuple[float, float]:
    return float(np.sqrt(np.mean(np.square(values)))), float(np.max(np.abs(values)))
