"""Measures how good an estimate is: residuals with and without it, from one reference on."""

from dataclasses import dataclass

import numpy as np

from models.records import FloatArray


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
