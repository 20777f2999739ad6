"""What a model with lags takes the features of sensors without a value for: what it expects from all others."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.lagged_model import LaggedModel


def imputed_features(model: LaggedModel, change: FloatArray, without: Sequence[int]) -> FloatArray:
    """Return a change of the features with that of some sensors imputed from all other features.

    Each ridge gives with its own imputation exactly what it gives fitted without these sensors; of several
    ridges the mean is taken.

    Parameters
    ----------
    model
        The model.
    change : shape (layout.columns,)
        Change of the features; what it holds for the sensors left out does not count.
    without
        Indices of the sensors, from 0.

    Returns
    -------
    numpy.ndarray, shape (layout.columns,)
        In the units of the features.

    """
    if not len(without):
        return change
    return np.asarray(np.mean([ridge.imputed(change, without) for ridge in model.ridges], axis=0))


def started_lags(
    model: LaggedModel, features: FloatArray, started: npt.NDArray[np.bool_], without: Sequence[int]
) -> FloatArray:
    """Return the lags of temperatures, those of some sensors started so that they stand as far from them as expected.

    A sensor that speaks after a long silence has no lags of its own. Those of the others tell how far each lag
    is behind; from there on the lags follow the sensor, and what was wrong in the beginning fades with them.

    Parameters
    ----------
    model
        The model.
    features : shape (layout.columns,)
        Temperatures of now, their lags, and lagged speed.
    started : shape (n_sensors,)
        Sensors whose lags begin now.
    without
        Indices of all sensors whose values must not count, those that are started among them.

    Returns
    -------
    numpy.ndarray, shape (n_lags, n_sensors)
        Lags [degC].

    """
    count, lags = model.layout.sensors, len(model.layout.lags_min)
    degc, lagged = features[:count], features[count : model.layout.temperature_columns].reshape(lags, count)
    if len(without) == count:
        return np.where(started, degc, lagged)
    expected = imputed_features(model, features - model.centre, without) + model.centre
    expected_lags = expected[count : model.layout.temperature_columns].reshape(lags, count)
    return np.where(started, degc + expected_lags - expected[:count], lagged)
