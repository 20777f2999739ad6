"""A linear model without some of its sensors: what is left of it, and what it takes their features for."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.features import IntArray
from models.thermal.model import LinearParameters
from models.thermal.solution import imputed_mean, leverage_and_size
from models.thermal.start import NORMAL_95

MOST_EXCLUSIONS_KEPT = 64
"""So many sets of excluded sensors keep their coefficients at hand."""

UNCOUNTED = 0.25
"""Up to this share of a ridge's sensors may be absent without their number counting; the watch needs the rest."""


class LeftOut:
    """A model of which sensors (indices from 0) are left out.

    `model`: the model. `beside`, shape (n_sensors,): component of each sensor, as a number; None: all are on one.
    """

    def __init__(self, model: LinearParameters, beside: IntArray | None) -> None:
        self.model = model
        self.beside = beside
        self._weight = np.abs(model.coefficients()[: model.layout.sensors])
        self._coefficients: dict[tuple[int, ...], FloatArray] = {}
        self._shares: dict[tuple[int, ...], float] = {}
        self._variances: dict[tuple[int, ...], list[FloatArray]] = {}

    def coefficients(self, excluded: tuple[int, ...]) -> FloatArray:
        """Return the coefficients of the features without some sensors, kept at hand, shape (d, n_channels)."""
        if (found := self._coefficients.get(excluded)) is None:
            if len(self._coefficients) >= MOST_EXCLUSIONS_KEPT:
                self._coefficients.clear()
            found = self._coefficients[excluded] = self.model.coefficients(excluded, self.beside)
        return found

    def distance(self, change: FloatArray, excluded: tuple[int, ...]) -> tuple[float, float, FloatArray]:
        """Return how far the features have gone, how much of that training says nothing of, and what is in doubt.

        Each solution takes sensors that do not count for what it expects of them itself: what another one expects of
        a temperature and of its lags may differ by more than the two ever did in training.

        Result: 1 at the farthest that training went, a share of 0..1, and by how much what is imputed may be off [um],
        shape (n_channels,): of ridges 90 % of the time.
        """
        limit, imputed_um = self.model.domain.leverage_limit, np.zeros(len(self.model.channels))
        total, whole = 0.0, 0.0
        for place, (share, one) in enumerate(zip(self.model.shares, self.model.solutions, strict=True)):
            if one.directions is None:
                imputed_um += share * one.departure_um(change, excluded, self.beside)
                continue
            known = one.imputed(change, excluded, self.beside) if excluded else change
            found, size = leverage_and_size([one], known[None])
            total, whole = total + float(found[0]), whole + float(size[0])
            if excluded:
                imputed_um += share * NORMAL_95 * np.sqrt(self._imputed_variances(excluded)[place] * float(found[0]))
        if limit is None:
            return 0.0, 0.0, imputed_um
        return float(np.sqrt(total / limit)), total / whole if whole > 0.0 else 0.0, imputed_um

    def _imputed_variances(self, excluded: tuple[int, ...]) -> list[FloatArray]:
        if excluded not in self._variances:
            ridges = [one if one.directions is not None else None for one in self.model.solutions]
            none = np.zeros(len(self.model.channels))
            self._variances = {excluded: [none if one is None else one.imputed_variance(excluded) for one in ridges]}
        return self._variances[excluded]

    def level_um(self, uncertainty_k: FloatArray, excluded: tuple[int, ...]) -> float:
        """Return by how much the thermal error may be wrong, of the worst channel [um].

        `uncertainty_k`, shape (n_sensors,): by how much each sensor's level may be wrong since the reference [K].
        `excluded`: indices of the sensors that do not count.
        """
        doubted = np.flatnonzero(uncertainty_k)
        if not len(doubted):
            return 0.0
        layout = self.model.layout
        columns = self.coefficients(excluded)[: layout.temperature_columns]
        by_lag = columns.reshape(-1, layout.sensors, columns.shape[1])[:, doubted]
        worst = np.abs(np.cumsum(by_lag, axis=0)).max(axis=0)  # a lag follows its temperature later
        return float((np.abs(uncertainty_k[doubted]) @ worst).max())

    def share(self, excluded: tuple[int, ...]) -> float:
        """Return how much of the model counts without some sensors, 0..1.

        Ridges replace a sensor by all others: what counts is how much less they explain of training without it, and
        sensors are counted beyond a quarter of them. Means do not: the weight that is lost is, of the worst channel.
        """
        if not excluded:
            return 1.0
        if self.model.domain.leverage_limit is not None:
            if excluded not in self._shares:
                self._shares = {excluded: self._share_of_ridges(excluded)}
            return self._shares[excluded]
        lost, total = self._weight[list(excluded)].sum(axis=0), self._weight.sum(axis=0)
        share = np.divide(lost, total, out=np.zeros_like(lost), where=total > 0.0)
        return float(np.clip(1.0 - share.max(), 0.0, 1.0))

    def _share_of_ridges(self, excluded: tuple[int, ...]) -> float:
        ridges = [one for one in self.model.solutions if one.directions is not None]
        lost = min(float(np.mean([one.lost_share(excluded) for one in ridges])), 1.0 - 1e-9) if ridges else 0.0
        ratio = lost / (1.0 - lost)
        absent = len(excluded) / self.model.layout.sensors
        return min(1.0 / (1.0 + ratio * ratio), 1.0 - max(absent - UNCOUNTED, 0.0) / (1.0 - UNCOUNTED))

    def imputed(self, change: FloatArray, without: Sequence[int]) -> FloatArray:
        """Return a change of the features with that of some sensors imputed from all other features.

        Of several solutions the mean, see `imputed_mean`: each gives with its own what it gives without these sensors.

        `change`, shape (layout.columns,) or (n, layout.columns): change of the features; what it holds for the sensors
        left out does not count. `without`: indices of the sensors, from 0.
        """
        return imputed_mean(self.model.solutions, change, without, self.beside)

    def started_lags(self, features: FloatArray, started: npt.NDArray[np.bool_], without: Sequence[int]) -> FloatArray:
        """Return the lags, those of some sensors started so that they stand as far from them as expected [degC].

        A sensor that has a value after a long silence has no lags of its own. Those of the others tell how far each
        lag is behind; from there on the lags follow the sensor, and what was wrong in the beginning fades with them.
        """
        layout = self.model.layout
        count, lags = layout.sensors, len(layout.lags_min)
        degc, lagged = features[:count], features[count : layout.temperature_columns].reshape(lags, count)
        if len(without) == count:
            return np.where(started, degc, lagged)
        centre = self.model.centre
        expected = self.imputed(features - centre, without) + centre
        expected_lags = expected[count : layout.temperature_columns].reshape(lags, count)
        return np.where(started, degc + expected_lags - expected[:count], lagged)
