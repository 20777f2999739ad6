"""The thermal error now, from a model, temperatures now and temperatures at the reference."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.model import ThermalModel, thermal_error_um

DOMAIN_WIDENING = 0.5
"""The range of increments seen in training is widened on both sides by this share of its width."""
DOMAIN_MARGIN_K = 0.5
"""And by at least this [K]: eight steps of a TMP102, so that a quiet sensor's noise is no departure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimation:
    """Thermal error since the reference, and how far it may be trusted."""

    thermal_error_um: FloatArray
    """Actual minus nominal [um], shape (n_channels,); always finite."""
    confidence: float
    """1 minus the share of the model's weight on imputed sensors, of the worst channel."""
    in_domain: bool
    """Every usable sensor lies within the range that training covered."""
    imputed: tuple[int, ...]
    """IDs of the sensors without a usable increment, which were imputed."""
    outside: tuple[int, ...]
    """IDs of the sensors outside the range that training covered."""
    increment_k: FloatArray
    """Increment since the reference that each sensor counted with [K], imputed where it has none itself."""
    band_factor: float = 1.0
    """By how much the model's band is widened here, beyond the domain of training; at least 1."""


class Estimator(Protocol):
    """What the pipeline asks of a family of models, stateless or not.

    `LinearEstimator` depends on the temperatures now and at the reference only. A family with
    states (lags) advances them in `renew`, and says by its confidence that they are not yet filled.
    """

    def renew(self, degc: FloatArray, reference_degc: FloatArray, elapsed_min: float) -> Estimation | None:
        """Return the estimate for new temperatures in the model's sensor order; None without any usable sensor."""
        ...


class LinearEstimator:
    """The telescoped increment model with imputation of missing sensors.

    Parameters
    ----------
    model
        The model.
    components
        Machine component of each sensor of the model, in its order.

    Raises
    ------
    ValueError
        When the number of components is not that of the model's sensors.

    """

    def __init__(self, model: ThermalModel, components: tuple[str, ...]) -> None:
        if len(components) != len(model.sensor_ids):
            raise ValueError(f"{len(components)} components for {len(model.sensor_ids)} sensors of {model.model_id}")
        self.model = model
        names = sorted(set(components))
        self._group = np.array([names.index(component) for component in components], dtype=np.intp)
        self._groups = len(names)
        self._weight = np.abs(model.coefficients_um_per_k)
        self._total = self._weight.sum(axis=1)
        widening_k = np.maximum(
            DOMAIN_WIDENING * (model.highest_increment_k - model.lowest_increment_k), DOMAIN_MARGIN_K
        )
        self._lowest_k = model.lowest_increment_k - widening_k
        self._highest_k = model.highest_increment_k + widening_k

    def renew(self, degc: FloatArray, reference_degc: FloatArray, elapsed_min: float) -> Estimation | None:
        """Return the estimate; see `estimate`."""
        increment_k = degc - reference_degc
        usable = np.isfinite(increment_k)
        if not usable.any():
            return None
        outside = (increment_k < self._lowest_k) | (increment_k > self._highest_k)
        imputed: tuple[int, ...] = ()
        confidence = 1.0
        if not usable.all():
            increment_k = self._impute(increment_k, usable)
            imputed = self._ids(~usable)
            confidence = self._confidence(~usable)
        model = self.model
        return Estimation(
            thermal_error_um=thermal_error_um(
                model.coefficients_um_per_k, model.drift_um_per_min, increment_k, elapsed_min
            ),
            confidence=confidence,
            in_domain=not outside.any(),
            imputed=imputed,
            outside=self._ids(outside) if outside.any() else (),
            increment_k=increment_k,
        )

    def _impute(self, increment_k: FloatArray, usable: npt.NDArray[np.bool_]) -> FloatArray:
        known = np.where(usable, increment_k, 0.0)
        count = np.bincount(self._group, weights=usable, minlength=self._groups)
        total = np.bincount(self._group, weights=known, minlength=self._groups)
        means = np.where(count > 0, total / np.maximum(count, 1.0), total.sum() / count.sum())
        return np.where(usable, increment_k, means[self._group])

    def _confidence(self, missing: npt.NDArray[np.bool_]) -> float:
        lost = self._weight[:, missing].sum(axis=1)
        share = np.divide(lost, self._total, out=np.zeros_like(lost), where=self._total > 0.0)
        return float(np.clip(1.0 - share.max(), 0.0, 1.0))

    def _ids(self, mask: npt.NDArray[np.bool_]) -> tuple[int, ...]:
        return tuple(self.model.sensor_ids[index] for index in np.flatnonzero(mask))


@lru_cache(maxsize=8)
def linear_estimator(model: ThermalModel, components: tuple[str, ...]) -> LinearEstimator:
    """Return the estimator of a model, prepared once; models are compared by identity."""
    return LinearEstimator(model, components)


def estimate(
    model: ThermalModel,
    degc: FloatArray,
    reference_degc: FloatArray,
    elapsed_min: float,
    components: tuple[str, ...],
) -> Estimation | None:
    """Return the thermal error since the reference (telescoped equation 3-5).

    A sensor without a temperature now or at the reference is imputed over the whole interval by
    the mean increment of the usable sensors on its component, or of all where there is none.

    Parameters
    ----------
    model
        Linear thermal model.
    degc, reference_degc : shape (n_sensors,)
        Temperatures now and at the reference [degC], in the model's sensor order, NaN where there
        is none that may be used.
    elapsed_min
        Time since the reference [min].
    components : length n_sensors
        Machine component of each sensor.

    Returns
    -------
    Estimation or None
        None when no sensor at all is usable.

    Raises
    ------
    ValueError
        When shapes do not fit the model or the elapsed time is not finite.

    """
    shape = (len(model.sensor_ids),)
    if degc.shape != shape or reference_degc.shape != shape:
        raise ValueError(
            f"model {model.model_id} needs {shape[0]} temperatures, got {degc.shape}, {reference_degc.shape}"
        )
    if not np.isfinite(elapsed_min):
        raise ValueError(f"elapsed_min must be finite, got {elapsed_min}")
    return linear_estimator(model, components).renew(degc, reference_degc, elapsed_min)
