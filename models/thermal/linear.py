"""The family of models that are linear in temperatures, their lags and lagged speed: default, increments, ridge .."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.model_file import file_text, record_of
from models.records import FloatArray
from models.thermal.estimation import Machine
from models.thermal.lags import feature_table
from models.thermal.layout import Design, Layout
from models.thermal.model import Domain, HyperParameters, LinearParameters, TestVector, TrainingData
from models.thermal.online import LinearOnline
from models.thermal.solution import Solution

FAMILY = "linear"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearModel(LinearParameters):
    """A linear model as the daemon loads it."""

    @property
    def period_s(self) -> float | None:
        """Time over which its inputs must be means [s]; None where it does not matter, without lags."""
        return self.period_min * 60.0 if self.layout.lags_min else None

    def runtime(self, machine: Machine) -> LinearOnline:
        """Return the model in use on a machine."""
        return LinearOnline(self, machine)

    def recorded_um(
        self, time_min: FloatArray, degc: FloatArray, speed_rpm: FloatArray | None, first: int
    ) -> FloatArray:
        """Return what it estimates over a recording since one of its rows, without watching its sensors.

        Parameters
        ----------
        time_min : shape (n,)
            Increasing times [min]; lags begin as if the first row had lasted for ever.
        degc : shape (n, n_sensors)
            Temperatures in the model's order [degC], finite.
        speed_rpm : shape (n,)
            Spindle speed [1/min]; NaN repeats the value before. None where it is not known at all.
        first
            The row that is the reference.

        Returns
        -------
        numpy.ndarray, shape (n - first, n_channels)
            Thermal error since the reference [um].

        """
        speed = np.zeros(len(degc)) if speed_rpm is None else speed_rpm
        known = np.maximum.accumulate(np.where(np.isfinite(speed), np.arange(len(speed)), -1))
        held = np.where(known >= 0, speed[np.maximum(known, 0)], 0.0)
        features = feature_table(self.layout, time_min, degc, held, self.speed_scale_rpm)
        return self.thermal_error_um(features[first:] - features[first], time_min[first:] - time_min[first])

    def to_json(self) -> str:
        """Return the text of its file; numbers are exact, large matrices in single precision."""
        return file_text(FAMILY, self)


def linear_model(content: bytes) -> LinearModel:
    """Return the model that the content of a file holds; raises ModelError."""
    return record_of(content, LinearModel)


def increment_model(
    *,
    model_id: str,
    kind: str,
    channels: tuple[str, ...],
    sensor_ids: tuple[int, ...],
    sensor_names: tuple[str, ...],
    coefficients_um_per_k: FloatArray,
    drift_um_per_min: FloatArray,
    lowest_increment_k: FloatArray,
    highest_increment_k: FloatArray,
    band_um: FloatArray,
    training: tuple[TrainingData, ...],
    created: str,
    test_pairs: Sequence[tuple[FloatArray, FloatArray]],
    hyper_parameters: HyperParameters | None = None,
    period_min: float = 1.0,
    refused: str | None = None,
    axis_positions: tuple[str, ...] = (),
) -> LinearModel:
    """Return the telescoped model of increments since the reference: a linear model without lags.

    Parameters
    ----------
    coefficients_um_per_k : shape (n_channels, n_sensors)
        b [um/K].
    drift_um_per_min : shape (n_channels,)
        b_0 [um/min].
    lowest_increment_k, highest_increment_k : shape (n_sensors,)
        Range of increments since any earlier instant of training [K].
    test_pairs
        Temperatures now and at the reference [degC], of which test vectors are made, 1, 2 .. hours apart.
    model_id, kind, channels, sensor_ids, sensor_names, band_um, training, created, hyper_parameters, period_min, \
refused, axis_positions
        See `LinearParameters`.

    """
    layout = Layout(sensors=len(sensor_ids), lags_min=(), speed_lags_min=())
    weights = np.ascontiguousarray(coefficients_um_per_k.T)
    return LinearModel(
        model_id=model_id,
        kind=kind,
        channels=channels,
        sensor_ids=sensor_ids,
        sensor_names=sensor_names,
        layout=layout,
        speed_scale_rpm=1.0,
        period_min=period_min,
        solutions=(
            Solution(
                layout=layout,
                design=Design(departures=False, correlation_min=None),
                gain=np.ones(layout.columns),
                weights=weights,
            ),
        ),
        drift_um_per_min=drift_um_per_min,
        centre=np.zeros(layout.columns),
        domain=Domain(of_increments=True, lowest=lowest_increment_k, highest=highest_increment_k),
        band_um=band_um,
        watch=None,
        hyper_parameters=hyper_parameters or {},
        refused=refused,
        training=training,
        created=created,
        test_vectors=tuple(
            TestVector(
                features=now,
                reference=then,
                elapsed_min=60.0 * hours,
                thermal_error_um=(now - then) @ weights + 60.0 * hours * drift_um_per_min,
            )
            for hours, (now, then) in enumerate(test_pairs, start=1)
        ),
        axis_positions=axis_positions,
    )
