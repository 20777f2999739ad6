"""How wrong an estimate may be because nobody recorded the past that its lags stand for.

Lags begin as if the first sample had lasted for ever. What they then stand away from the truth fades with their
time constants, so a share of every lag is unknown: all of it at the beginning on a machine that is not at rest, the
part that a gap covers after one, none after some hours of history.
"""

from dataclasses import dataclass

import numpy as np

from models.model_file import ModelError, Numbers
from models.records import FloatArray

LEAST_UNKNOWN = 0.1
"""Share of the lags that stays unknown at the beginning on a machine that stands as training found it at rest."""
RESTLESS_SHARE = 0.5
"""Temperatures that stand so far from rest, as a share of what training saw, say nothing of the past."""
NORMAL_95 = 1.645
"""The half width of a band of 90 % over the deviation."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StartDeviation:
    """What training says of lags that begin at equilibrium."""

    covariance_um2: Numbers
    """Second moments, over training, of what each lag adds to the estimate beyond equilibrium [um^2], those of each
    channel below those of the channel before: shape (n_channels * n_lags, n_lags), lags of speed last."""
    signal_um: Numbers
    """Root mean square thermal error between two instants of a run [um], shape (n_channels,)."""
    rest_degc: Numbers
    """Temperatures at the beginnings of the runs about their mean [K], shape (n_sensors,)."""
    spread_k: float
    """Root mean square departure from that in training [K]."""
    begun_k: float = 0.0
    """So far from rest_degc began the runs of training [K]: what is left of left-out runs holds what that makes."""

    def __post_init__(self) -> None:
        """Check shapes and numbers; raises ModelError."""
        lags, channels = self.covariance_um2.shape[-1], len(self.signal_um)
        if self.covariance_um2.size != channels * lags**2:
            shape = self.covariance_um2.shape
            raise ModelError("start.covariance_um2", f"has shape {shape} for {channels} channels and {lags} lags")
        for key in ("covariance_um2", "signal_um", "rest_degc"):
            if not np.isfinite(getattr(self, key)).all():
                raise ModelError(f"start.{key}", "holds a number that is not finite")
            getattr(self, key).flags.writeable = False
        for key in ("spread_k", "begun_k"):
            if not 0.0 <= getattr(self, key) < np.inf:
                raise ModelError(f"start.{key}", f"{getattr(self, key)} must be finite and not negative")

    def unknown_at_start(self, degc: FloatArray) -> float:
        """Return the share of the lags that is unknown when they begin with some temperatures, 0..1.

        `degc`, shape (n_sensors,): temperatures in the model's order [degC], NaN where missing.
        """
        pattern = degc - self.rest_degc
        known = np.isfinite(pattern)
        if known.sum() < 2 or self.spread_k <= 0.0:
            return 1.0
        away_k = max(float(np.std(pattern[known])) - self.begun_k, 0.0)
        return float(np.clip(away_k / (RESTLESS_SHARE * self.spread_k), LEAST_UNKNOWN, 1.0))

    def variance_um2(self, unknown: FloatArray) -> FloatArray:
        """Return the variance of the estimate when so much of each lag is unknown [um^2], shape (n_channels,)."""
        lags = self.covariance_um2.shape[-1]
        table = self.covariance_um2.reshape(len(self.signal_um), lags, lags)
        found: FloatArray = np.maximum(np.einsum("clm,l,m->c", table, unknown, unknown), 0.0)
        return found

    def known(self, variance_um2: FloatArray) -> float:
        """Return how far an estimate with such a variance may be followed, 0..1.

        Half of it at a deviation as large as the thermal error; at the thresholds of the output that are shipped all
        of the estimate counts while a third of the variance is unknown, and none of it from two thirds on.
        """
        signal = np.square(self.signal_um)
        moves = signal > 0.0
        if not moves.any():
            return 1.0
        ratio = float(np.mean(variance_um2[moves] / signal[moves]))
        return 1.0 / (1.0 + ratio * ratio)


def grown_unknown(unknown: FloatArray, elapsed_min: float, constants_min: FloatArray, bridge_min: float) -> FloatArray:
    """Return the shares of the lags that are unknown after an interval.

    Result: what was unknown fades; after an interval without samples that is longer than a gap which is bridged, all
    that the lags have taken in of it is unknown.

    `unknown`, shape (n_lags,): at its beginning. `elapsed_min`: its length [min]. `constants_min`, shape (n_lags,):
    time constants [min]. `bridge_min`: a longer interval is a gap [min].
    """
    left: FloatArray = np.exp(-max(elapsed_min, 0.0) / constants_min)
    return unknown * left if elapsed_min <= bridge_min else 1.0 - (1.0 - unknown) * left
