"""Residuals of the dissertation's models by number of training sets and of sensors (section 3.4).

Data sets are added one after the other by updating a triangular factor, sensors by bordering it
(`NestedFits`), so that all sets and sensors cost about as much as a few fits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.training.increments import Factor, combine
from models.thermal.training.published import MODELS, OUTPUTS, PublishedSet

Progress = Callable[[int, int], None]
Key = tuple[str, str]
"""Name of the model and of the group of test sets."""


DEPENDENT = 64.0
"""A column that the ones before it leave less of than this many roundings is dependent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NestedFits:
    """Coefficients of equation 3-1 on the first 1 .. n_sensors sensors of an order."""

    order: npt.NDArray[np.intp]
    """Indices of the sensors, shape (n_sensors,)."""
    inverse: FloatArray
    """W over the leading columns before the first dependent one [1/K], shape (r, r), upper triangular."""
    projected: FloatArray
    """z [um], shape (r, n_outputs)."""
    shortest: dict[int, FloatArray]
    """Coefficients by number of sensors where more than r are used [um/K], shape (n, n_outputs)."""
    mean_change_k: FloatArray
    """Mean increment of each sensor of the order [K/min], shape (n_sensors,); zeros without b_0."""
    mean_output_um: FloatArray
    """Mean increment of each output [um/min], shape (n_outputs,); zeros without b_0."""

    def coefficients(self, sensors: int) -> tuple[FloatArray, FloatArray]:
        """Return the model on the first sensors of the order.

        Result: b [um/K], shape (sensors, n_outputs), and b_0 [um/min], shape (n_outputs,).

        `sensors`: how many, from 1.
        """
        solution = self.shortest.get(sensors)
        if solution is None:
            solution = self.inverse[:sensors, :sensors] @ self.projected[:sensors]
        return solution, self.mean_output_um - self.mean_change_k[:sensors] @ solution

    def estimates_um(self, change_k: FloatArray, elapsed_min: FloatArray, output: int) -> FloatArray:
        """Return the thermal error since the reference for every number of sensors (equation 3-5, telescoped).

        Result of shape (n, n_sensors): column k - 1 is of the first k sensors of the order [um].

        `change_k`, shape (n, n_sensors): temperatures since the reference, in the order of the recording [K].
        `elapsed_min`, shape (n,): time since the reference [min]. `output`: which output.
        """
        centred = change_k[:, self.order] - np.multiply.outer(elapsed_min, self.mean_change_k)
        independent = len(self.inverse)
        found = np.empty_like(centred)
        contributions = (centred[:, :independent] @ self.inverse) * self.projected[:, output]
        np.cumsum(contributions, axis=1, out=found[:, :independent])
        for sensors, solution in self.shortest.items():
            found[:, sensors - 1] = centred[:, :sensors] @ solution[:, output]
        found += (elapsed_min * self.mean_output_um[output])[:, None]
        return found


def nested_fits(factor: Factor, order: Sequence[int] | npt.NDArray[np.intp], *, intercept: bool) -> NestedFits:
    """Return least squares on the first 1, 2 .. of an order of sensors (equations 3-2, 3-3).

    The normal equations are solved by their triangular factor, which is never multiplied out.

    Result: for every number of sensors from 1 to the length of the order.

    `factor`: of all increments, see `models.thermal.training.increments.factorise` and `combine`. `order`: indices of
    the sensors to use, each at most once. `intercept`: whether b_0 is fitted.
    """
    places = np.asarray(order, dtype=np.intp)
    first = 1 if intercept else 0
    columns = factor.upper[first:, 1 + places]
    outputs = factor.upper[first:, 1 + factor.sensors :]
    moving = np.flatnonzero(np.linalg.norm(columns, axis=0) > 0.0)
    orthogonal, upper = np.linalg.qr(columns[:, moving])
    leading = _independent(columns[:, moving], upper, factor.rows)
    independent = int(moving[leading]) if leading < len(moving) else len(places)
    inverse = np.zeros((independent, independent))
    inverse[np.ix_(moving[:leading], moving[:leading])] = np.linalg.inv(upper[:leading, :leading])
    projected = np.zeros((independent, outputs.shape[1]))
    projected[moving[:leading]] = orthogonal[:, :leading].T @ outputs
    mean_change_k, mean_output_um = np.zeros(len(places)), np.zeros(outputs.shape[1])
    if intercept:
        mean_change_k = factor.upper[0, 1 + places] / factor.upper[0, 0]
        mean_output_um = factor.upper[0, 1 + factor.sensors :] / factor.upper[0, 0]
    return NestedFits(
        order=places,
        inverse=inverse,
        projected=projected,
        shortest={
            sensors: np.asarray(np.linalg.lstsq(columns[:, :sensors], outputs, rcond=None)[0], dtype=np.float64)
            for sensors in range(independent + 1, len(places) + 1)
        },
        mean_change_k=mean_change_k,
        mean_output_um=mean_output_um,
    )


def _independent(columns: FloatArray, upper: FloatArray, rows: int) -> int:
    """Return how many leading columns, none of them zero, are independent of those before them."""
    square = min(columns.shape)
    norms = np.linalg.norm(columns, axis=0)[:square]
    left = np.abs(np.diagonal(upper))[:square]
    limit = DEPENDENT * max(rows, columns.shape[1]) * np.finfo(np.float64).eps
    dependent = np.flatnonzero(left <= limit * norms)
    return int(dependent[0]) if len(dependent) else square


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualMap:
    """Residuals while the spindle turns, of all test sets of a group together.

    Row k - 1 is of the first k training sets, column n - 1 of the first n sensors.
    """

    mean_um: FloatArray
    """Mean of the absolute residual [um], shape (n_sets, n_sensors)."""
    max_um: FloatArray
    """Largest absolute residual [um]."""
    rmse_um: FloatArray
    """Root mean square of the residual [um]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignFits:
    """The models after some number of training sets."""

    main: NestedFits
    """Of the outputs Y2, Z2, Z1."""
    length: NestedFits
    """Of TL; always all of its inputs are used."""

    def estimates_um(self, test: PublishedSet, model: str) -> FloatArray:
        """Return a model's estimate of a test set for every number of sensors.

        Result of shape (rows, n_sensors): thermal error of Y2 or Z2 since the reference [um].

        `test`: the set; the reference is its first row. `model`: one of `MODELS`.
        """
        output = "Z1" if model == "Z1+TL" else model
        found = self.main.estimates_um(test.change_k, test.elapsed_min, OUTPUTS.index(output))
        if model == "Z1+TL":
            change = test.length_inputs - test.length_inputs[0]
            found -= self.length.estimates_um(change, test.elapsed_min, 0)[:, -1:]
        return found


def measured_channel(model: str) -> str:
    """Return the displacement that a model is tested on: Y2, or Z2 for both other models."""
    return "Y2" if model == "Y2" else "Z2"


def progressive_fits(
    training: Sequence[PublishedSet], sensor_order: npt.NDArray[np.intp], *, intercept: bool
) -> list[CampaignFits]:
    """Return the models after the first, the first two .. training sets, in the order given.

    Result: one for each number of training sets.

    `training`: at least one data set. `sensor_order`: indices of the temperatures in the order in which they are added,
    shape (n_sensors,). `intercept`: whether b_0 is fitted.
    """
    found: list[CampaignFits] = []
    main: Factor | None = None
    length: Factor | None = None
    for each in training:
        main = each.factor if main is None else combine([main, each.factor])
        length = each.length_factor if length is None else combine([length, each.length_factor])
        found.append(
            CampaignFits(
                main=nested_fits(main, sensor_order, intercept=intercept),
                length=nested_fits(length, np.arange(length.sensors), intercept=intercept),
            )
        )
    return found


def residual_maps(
    training: Sequence[PublishedSet],
    tests: Mapping[str, Sequence[PublishedSet]],
    sensor_order: npt.NDArray[np.intp],
    *,
    intercept: bool,
) -> dict[Key, ResidualMap]:
    """Return the residuals of every model on every group of test sets (Figs. 3-15 to 3-18, 3-20 to 3-22).

    Result: a map by (model, group).

    `training`: in the order in which they are added. `tests`: test sets by the name of their group; their displacements
    are raw. `sensor_order`, `intercept`: see `progressive_fits`.
    """
    shape = (len(training), len(sensor_order))
    keys = [(model, group) for model in MODELS for group in tests]
    figures = {key: np.empty((3, *shape)) for key in keys}
    for place, fits in enumerate(progressive_fits(training, sensor_order, intercept=intercept)):
        for model, group in keys:
            residual_um = np.abs(np.vstack([_rotating_residual(fits, test, model) for test in tests[group]]))
            target = figures[model, group][:, place]
            target[0] = residual_um.mean(axis=0)
            target[1] = residual_um.max(axis=0)
            target[2] = np.sqrt(np.square(residual_um).mean(axis=0))
    return {key: ResidualMap(mean_um=each[0], max_um=each[1], rmse_um=each[2]) for key, each in figures.items()}


def _rotating_residual(fits: CampaignFits, test: PublishedSet, model: str) -> FloatArray:
    estimate_um = fits.estimates_um(test, model)
    measured_um = test.error_um(measured_channel(model))
    residual: FloatArray = (measured_um[:, None] - estimate_um)[test.rotating]
    return residual


def random_sensor_order(sensors: int, seed: int) -> npt.NDArray[np.intp]:
    """Return an order in which sensors are added at random; taken backwards, they are removed at random.

    Which sensors a model of n uses is all that matters: among themselves they keep their order.
    """
    return np.random.default_rng(seed).permutation(sensors).astype(np.intp)


def by_increasing_speed(training: Sequence[PublishedSet]) -> list[PublishedSet]:
    """Return the training sets from the lowest spindle speed to the highest, else by number (Fig. 3-18)."""
    return sorted(training, key=lambda each: (each.speed_rpm, each.number))
