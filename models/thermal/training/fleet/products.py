"""What recordings of machines of a type are reduced to: few directions of features, and cross products in them.

Whatever is fitted, chosen and compared afterwards needs no row again, so a fleet of a thousand machines is a few
numbers per machine, which workers send.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from models.model_file import Numbers, Packed
from models.recordings.dataset import DatasetError
from models.records import FloatArray
from models.thermal.features import BoolArray, Design, IntArray, Layout, design_columns
from models.thermal.training.inputs import Inputs
from models.thermal.training.lags import columns_of

DESIGN = Design(departures=True)
"""Temperatures minus their lags: what a machine's lags have in common with its sisters' is told apart best."""
MOST_ROWS = 1200
"""So many rows of all machines tell the directions in which rows differ most."""
MOST_DIRECTIONS = 120
"""So many directions, in which the temperatures of a type differ most, tell 96 % of what 302 sensors do."""
POINTS = 24
"""So many rows of a recording are kept for bands."""
SAMPLED_ROWS = 40
"""So many rows of a recording tell the directions."""
MOST_AT_ONCE = 256


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Space:
    """The features of a type of machine, and the directions in which they are looked at."""

    layout: Layout
    speed_scale_rpm: float
    """Speed that stands for 1 in the features [1/min]."""
    period_min: float
    """Time between rows [min]."""
    gain: Numbers
    """1 / deviation within runs of each column of the design, shape (layout.columns,); 0 where it does not move."""
    directions: Packed
    """Orthonormal, in scaled columns, shape (layout.columns, k)."""

    def reduced(self, features: FloatArray) -> FloatArray:
        """Return features, shape (n, layout.columns), in the directions, shape (n, k)."""
        found = np.empty((len(features), self.directions.shape[1]))
        for at in range(0, len(features), MOST_AT_ONCE):
            columns = design_columns(features[at : at + MOST_AT_ONCE], self.layout, DESIGN)
            found[at : at + MOST_AT_ONCE] = (columns * self.gain) @ self.directions
        return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Products:
    """Cross products of some rows: about the mean of each run, for fits, and since its first row, for errors."""

    rows: int
    xx: FloatArray
    """About the means, shape (k, k)."""
    xy: FloatArray
    """Of displacements without jumps [um], shape (k, n_channels)."""
    yy: FloatArray
    """Shape (n_channels,) [um^2]."""
    since_xx: FloatArray
    since_xy: FloatArray
    """Of displacements as measured [um]."""
    since_yy: FloatArray

    def __add__(self, other: "Products") -> "Products":
        """Return the products of the rows of both."""
        return Products(
            rows=self.rows + other.rows,
            xx=self.xx + other.xx,
            xy=self.xy + other.xy,
            yy=self.yy + other.yy,
            since_xx=self.since_xx + other.since_xx,
            since_xy=self.since_xy + other.since_xy,
            since_yy=self.since_yy + other.since_yy,
        )

    def times(self, weight: float) -> "Products":
        """Return the products of rows that count so many times as much."""
        if weight == 1.0:
            return self
        return Products(
            rows=self.rows,
            xx=weight * self.xx,
            xy=weight * self.xy,
            yy=weight * self.yy,
            since_xx=weight * self.since_xx,
            since_xy=weight * self.since_xy,
            since_yy=weight * self.since_yy,
        )

    def left_um2(self, weights: FloatArray) -> FloatArray:
        """Return the sum of squares that weights, shape (k, n_channels), leave of the error since the first rows."""
        explained = 2.0 * (weights * self.since_xy).sum(axis=0)
        squares = np.einsum("dc,de,ec->c", weights, self.since_xx, weights)
        return np.asarray(np.maximum(self.since_yy - explained + squares, 0.0))

    def rmse_um(self, weights: FloatArray | None = None) -> FloatArray:
        """Return what weights leave of the error since the first rows, root mean square [um]; None: all of it."""
        squares = self.since_yy if weights is None else self.left_um2(weights)
        return np.asarray(np.sqrt(squares / max(self.rows, 1)))


def summed(products: Iterable[Products]) -> Products:
    """Return the products of all rows together; at least one is needed."""
    return reduce(Products.__add__, products)


def products_of(inputs: Inputs, reduced: FloatArray, rows: BoolArray) -> Products:
    """Return the cross products of some rows.

    `reduced`, shape (n, k): their features in the directions of the space. `rows`, shape (n,): which of them; every one
    is complete.
    """
    channels, size = len(inputs.channels), reduced.shape[1]
    found = Products(
        rows=0,
        xx=np.zeros((size, size)),
        xy=np.zeros((size, channels)),
        yy=np.zeros(channels),
        since_xx=np.zeros((size, size)),
        since_xy=np.zeros((size, channels)),
        since_yy=np.zeros(channels),
    )
    for run in np.unique(inputs.run[rows]):
        of_run = np.flatnonzero(rows & (inputs.run == run))
        x = reduced[of_run] - reduced[of_run[0]]
        y = inputs.cleansed_um[of_run] - inputs.cleansed_um[of_run].mean(axis=0)
        since_um = inputs.measured_um[of_run] - inputs.measured_um[of_run[0]]
        about, mean = x - x.mean(axis=0), x.sum(axis=0)
        since_xx = x.T @ x
        found += Products(
            rows=len(of_run),
            xx=since_xx - np.outer(mean, mean) / len(of_run),
            xy=about.T @ y,
            yy=np.square(y).sum(axis=0),
            since_xx=since_xx,
            since_xy=x.T @ since_um,
            since_yy=np.square(since_um).sum(axis=0),
        )
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """What a machine tells of the space before it is known: how its columns move."""

    layout: Layout
    channels: tuple[str, ...]
    speed_scale_rpm: float
    period_min: float
    longest_min: float
    """Its longest run [min]."""
    count: int
    squares: FloatArray
    """Sum over all rows of the squared departure of each column from the mean of its run, shape (layout.columns,)."""
    rows: FloatArray
    """Some rows, minus that mean."""


def sample_of(inputs: Inputs) -> Sample:
    """Return how the columns of a machine's recordings, which are in the places of the type, move."""
    rows = inputs.trainable()
    if not rows.any():
        raise DatasetError(f"{', '.join(inputs.recording_names)}: no row is complete; name complete columns in the map")
    squares, some, longest_min = np.zeros(inputs.layout.columns), [], 0.0
    for run in np.unique(inputs.run[rows]):
        of_run = np.flatnonzero(rows & (inputs.run == run))
        longest_min = max(longest_min, float(np.ptp(inputs.time_min[of_run])))
        columns = design_columns(inputs.features[of_run], inputs.layout, DESIGN)
        columns = columns - columns.mean(axis=0)
        squares += np.square(columns).sum(axis=0)
        some.append(columns[:: max(1, len(of_run) // SAMPLED_ROWS)].astype(np.float32))
    return Sample(
        layout=inputs.layout,
        channels=inputs.channels,
        speed_scale_rpm=inputs.speed_scale_rpm,
        period_min=inputs.period_min,
        longest_min=longest_min,
        count=int(rows.sum()),
        squares=squares,
        rows=np.vstack(some),
    )


def space_of(samples: Sequence[Sample]) -> Space:
    """Return the space of a type: lags that its runs can teach, scales, and the directions in which rows differ most.

    `samples`: of some of its machines.
    """
    first = samples[0]
    longest_min = max(sample.longest_min for sample in samples)
    speed = all(sample.layout.speed_lags_min for sample in samples)
    layout = Layout(
        sensors=first.layout.sensors,
        lags_min=tuple(lag for lag in first.layout.lags_min if lag <= longest_min),
        speed_lags_min=tuple(lag for lag in first.layout.speed_lags_min if speed and lag <= longest_min),
    )
    scale_rpm = max(sample.speed_scale_rpm for sample in samples)
    squares, tables = np.zeros(layout.columns), []
    each = max(1, MOST_ROWS // len(samples))
    for sample in samples:
        places = columns_of(layout, sample.layout)
        factor = speed_factors(layout, sample.speed_scale_rpm / scale_rpm)
        squares += sample.squares[places] * np.square(factor)
        rows = sample.rows[:: 1 + (len(sample.rows) - 1) // each]
        tables.append(rows[:, places] * factor)
    spread = np.sqrt(squares / sum(sample.count for sample in samples))
    moves = spread > 1e-9
    gain = np.where(moves, 1.0 / np.where(moves, spread, 1.0), 0.0)
    table = np.vstack(tables) * gain
    values, vectors = np.linalg.eigh(table @ table.T)
    kept = np.argsort(values)[::-1][:MOST_DIRECTIONS]
    kept = kept[values[kept] > 1e-10 * max(float(values[-1]), 1e-300)]
    return Space(
        layout=layout,
        speed_scale_rpm=scale_rpm,
        period_min=float(np.median([sample.period_min for sample in samples])),
        gain=gain,
        directions=np.ascontiguousarray(table.T @ vectors[:, kept] / np.sqrt(values[kept])),
    )


def speed_factors(layout: Layout, ratio: float) -> FloatArray:
    """Return what each column is multiplied by when the speed that stands for 1 becomes 1 / ratio times as much."""
    found = np.ones(layout.columns)
    found[layout.temperature_columns :: 2] = ratio
    found[layout.temperature_columns + 1 :: 2] = ratio**2
    return found


def points_of(inputs: Inputs, reduced: FloatArray, rows: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return some rows since the first of their run: reduced, shape (n, k), and as measured [um]."""
    x, y = [np.empty((0, reduced.shape[1]))], [np.empty((0, len(inputs.channels)))]
    for run in np.unique(inputs.run[rows]):
        of_run: IntArray = np.flatnonzero(rows & (inputs.run == run))
        some = of_run[:: max(1, len(of_run) // POINTS)]
        x.append(reduced[some] - reduced[of_run[0]])
        y.append(inputs.measured_um[some] - inputs.measured_um[of_run[0]])
    return np.vstack(x), np.vstack(y)
