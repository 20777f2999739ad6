"""Which few sensors are worth having, and what each one removed would cost: judged on left-out folds alone.

Three orders: forward selection (the sensor that helps most, given those chosen), the path of the
LASSO (the order in which sensors enter), and clusters of sensors that move together, each
represented by its most central one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray
from models.thermal.training.families import Fit, fold_numbers, relative_rmse, ridge_fit
from models.thermal.training.inputs import Inputs
from models.thermal.training.ridge import RidgeProblem
from models.thermal.training.ridge_member import DEPARTURES

Method = Literal["forward", "lasso", "clusters"]
PENALTY = 1e-2
"""Relative penalty of the ridges while sensors are compared; it is chosen anew for the model itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """An order of sensors, and how good a model of the first so many of them is."""

    method: str
    sensors: tuple[str, ...]
    """Names, the most useful first."""
    relative_rmse: tuple[float, ...]
    """RMSE with / without a model of the first 1, 2 .. of them on left-out folds, mean over the channels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Price:
    """What removing one sensor costs."""

    sensor: str
    relative_rmse: float
    """RMSE with / without a model of all other sensors on left-out folds."""
    rise: float
    """Its difference from that of a model of all sensors; negative when the sensor does harm."""


class SensorComparison:
    """Scores sets of sensors on left-out folds, without refitting: the others are left out by block elimination.

    `inputs`, `rows` and `fold`: training rows and their folds; nothing else is looked at.
    """

    def __init__(self, inputs: Inputs, rows: BoolArray, fold: IntArray) -> None:
        self._inputs, self._rows, self._fold = inputs, rows, fold
        problem = RidgeProblem(inputs, rows, fold, DEPARTURES)
        self._solutions = {number: problem.solve(frozenset({number}), [PENALTY]) for number in fold_numbers(rows, fold)}

    def score(self, sensors: Sequence[int]) -> float:
        """Return the RMSE with / without a model of these sensors (indices) on left-out folds."""
        out = tuple(index for index in range(self._inputs.layout.sensors) if index not in set(sensors))
        fits: dict[int, Fit] = {number: ridge_fit(solutions, out) for number, solutions in self._solutions.items()}
        return relative_rmse(self._inputs, self._rows, self._fold, fits)

    def prices(self) -> tuple[Price, ...]:
        """Return what removing each sensor alone costs, the dearest first."""
        everything = range(self._inputs.layout.sensors)
        whole = self.score(everything)
        found = []
        for index, name in enumerate(self._inputs.sensor_names):
            without = self.score([other for other in everything if other != index])
            found.append(Price(sensor=name, relative_rmse=without, rise=without - whole))
        return tuple(sorted(found, key=lambda price: -price.rise))

    def select(self, method: Method, most: int) -> Selection:
        """Return an order of at most so many sensors, and the score of each beginning of it."""
        most = min(most, self._inputs.layout.sensors)
        if method == "clusters":
            beginnings = [self._clusters(count) for count in range(1, most + 1)]
        else:
            order = self._forward(most) if method == "forward" else self._lasso(most)
            beginnings = [order[: count + 1] for count in range(len(order))]
        return Selection(
            method=method,
            sensors=tuple(self._inputs.sensor_names[index] for index in beginnings[-1]),
            relative_rmse=tuple(self.score(chosen) for chosen in beginnings),
        )

    def _forward(self, most: int) -> list[int]:
        chosen: list[int] = []
        while len(chosen) < most:
            rest = [index for index in range(self._inputs.layout.sensors) if index not in chosen]
            chosen.append(min(rest, key=lambda index: self.score([*chosen, index])))
        return chosen

    def _centred(self) -> tuple[FloatArray, FloatArray]:
        degc, um = self._inputs.degc[self._rows].copy(), self._inputs.cleansed_um[self._rows].copy()
        run = self._inputs.run[self._rows]
        for number in np.unique(run):
            degc[run == number] -= degc[run == number].mean(axis=0)
            um[run == number] -= um[run == number].mean(axis=0)
        return degc / np.maximum(degc.std(axis=0), 1e-9), um / np.maximum(um.std(axis=0), 1e-9)

    def _lasso(self, most: int) -> list[int]:
        """Return sensors by the largest penalty at which any channel uses them."""
        from sklearn.linear_model import lars_path_gram  # noqa: PLC0415 - never loaded by the resident daemon

        x, y = self._centred()
        enters = np.zeros(x.shape[1])
        for target in y.T:
            alphas, _, path = lars_path_gram(
                Xy=x.T @ target, Gram=x.T @ x, n_samples=len(x), method="lasso", max_iter=8 * x.shape[1]
            )
            first = np.where(path != 0.0, alphas[None, :], 0.0).max(axis=1)
            enters = np.maximum(enters, first / max(float(alphas[0]), 1e-12))
        order: list[int] = np.argsort(-enters, kind="stable").tolist()
        return order[:most]

    def _clusters(self, count: int) -> list[int]:
        """Return the most central sensor of each cluster of sensors that move together (Ward's criterion)."""
        from sklearn.cluster import AgglomerativeClustering  # noqa: PLC0415 - never loaded by the resident daemon

        x, _ = self._centred()
        profiles: FloatArray = np.atleast_2d(np.corrcoef(x.T))
        if count >= x.shape[1]:
            return list(range(x.shape[1]))
        labels = (
            np.zeros(x.shape[1], dtype=np.intp)
            if count == 1
            else AgglomerativeClustering(n_clusters=count).fit(np.nan_to_num(profiles)).labels_
        )
        central = []
        for label in range(count):
            members = np.flatnonzero(labels == label)
            within = np.abs(profiles[np.ix_(members, members)]).sum(axis=1)
            central.append(int(members[np.argmax(within)]))
        return central
