"""Residuals of the dissertation's models by number of training sets and of sensors (section 3.4).

Data sets are added one after the other by updating a triangular factor, sensors by bordering it
(`models.thermal.training.nested`), so that all sets and sensors cost about as much as a few fits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.training.increments import Factor, combine
from models.thermal.training.nested import NestedFits, nested_fits
from models.thermal.training.published import MODELS, OUTPUTS, PublishedSet

Progress = Callable[[int, int], None]
Key = tuple[str, str]
"""Name of the model and of the group of test sets."""


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
