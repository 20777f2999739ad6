"""Least squares on the first 1, 2 .. of an order of sensors, all from one triangular factor.

With the columns in that order, the solution on the first n of them needs the leading n by n part of R
only: b_n = W[:n, :n] z[:n] with W = R^-1, which is upper triangular, and z = Q^T y. An estimate
X[:, :n] b_n is therefore a running sum over the columns of (X W) z: bordering one more sensor costs one
more column. A sensor that never changes has the coefficient 0. Where columns depend on each other, the
shortest solution is found by singular values.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.training.increments import Factor

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
