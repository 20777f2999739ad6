"""Which lags the data can teach: from two minutes up, none shorter than the sampling, none longer than a run.

Members of a model work on a part of the lags each. A part is cut out of the inputs (`part_of`), and what was
fitted on it is put back into the columns of the whole (`widened`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray, Layout
from models.thermal.solution import Solution
from models.thermal.training.inputs import Inputs

FAST_MIN = (2.0, 5.0, 10.0, 30.0, 60.0)
"""Time constants for spindles and motors that answer within minutes [min]."""
SLOW_MIN = (10.0, 30.0, 90.0, 240.0)
"""Time constants for columns, beds and the hall [min]."""
FAST_SPEED_MIN = (2.0, 5.0, 10.0, 30.0, 60.0)
"""Time constants of lagged speed beside the fast lags [min]."""
SLOW_SPEED_MIN = (2.0, 10.0, 30.0, 90.0, 240.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lags:
    """Time constants that some rows can teach."""

    fast_min: tuple[float, ...]
    slow_min: tuple[float, ...]
    fast_speed_min: tuple[float, ...]
    slow_speed_min: tuple[float, ...]

    @property
    def all_min(self) -> tuple[float, ...]:
        """Return the time constants of temperatures of both [min], increasing."""
        return tuple(sorted({*self.fast_min, *self.slow_min}))

    @property
    def all_speed_min(self) -> tuple[float, ...]:
        """Return the time constants of lagged speed of both [min], increasing."""
        return tuple(sorted({*self.fast_speed_min, *self.slow_speed_min}))

    def parts(self, *, speed: bool) -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
        """Return the lags of temperatures and of speed of each part by name; one part where the slow adds nothing."""
        found = {"fast": (self.fast_min, self.fast_speed_min if speed else ())}
        if not set(self.slow_min) <= set(self.fast_min):
            found["slow"] = (self.slow_min, self.slow_speed_min if speed else ())
        return found


def offered_lags(inputs: Inputs, rows: BoolArray) -> Lags:
    """Return the lags that training rows can teach.

    A lag longer than the longest run is still nearly where it began when the run ends, so nothing tells it from a
    drift; one shorter than the time between rows follows its temperature at once.

    `inputs` and `rows`: the recordings and the training rows.
    """
    spans = [float(np.ptp(inputs.time_min[rows & (inputs.run == run)])) for run in np.unique(inputs.run[rows])]
    longest_min = max(spans, default=0.0)
    shortest_min = min(inputs.period_min, longest_min) if np.isfinite(inputs.period_min) else 0.0

    def offered(constants_min: Sequence[float]) -> tuple[float, ...]:
        """Return those that lie between sampling and run."""
        return tuple(each for each in constants_min if shortest_min <= each <= longest_min)

    return Lags(
        fast_min=offered(FAST_MIN),
        slow_min=offered(SLOW_MIN),
        fast_speed_min=offered(FAST_SPEED_MIN),
        slow_speed_min=offered(SLOW_SPEED_MIN),
    )


def columns_of(part: Layout, whole: Layout) -> IntArray:
    """Return where the columns of a part stand in a whole that has all of its lags, shape (part.columns,)."""
    sensors = np.arange(whole.sensors)
    blocks = [sensors]
    blocks += [whole.sensors * (1 + whole.lags_min.index(lag)) + sensors for lag in part.lags_min]
    first = whole.temperature_columns
    blocks += [first + 2 * whole.speed_lags_min.index(lag) + np.arange(2) for lag in part.speed_lags_min]
    return np.concatenate(blocks).astype(np.intp)


def part_of(inputs: Inputs, lags_min: tuple[float, ...], speed_lags_min: tuple[float, ...]) -> Inputs:
    """Return the inputs with some of their lags only."""
    layout = Layout(sensors=inputs.layout.sensors, lags_min=lags_min, speed_lags_min=speed_lags_min)
    if layout == inputs.layout:
        return inputs
    return replace(inputs, layout=layout, features=inputs.features[:, columns_of(layout, inputs.layout)])


def widened(solution: Solution, whole: Layout) -> Solution:
    """Return a solution in the columns of a layout that has all of its lags; the others count nothing in it."""
    if solution.layout == whole:
        return solution
    places = columns_of(solution.layout, whole)

    def wide(rows: FloatArray) -> FloatArray:
        """Return rows in their places among zeros."""
        found = np.zeros((whole.columns, *rows.shape[1:]), dtype=rows.dtype)
        found[places] = rows
        return found

    return replace(
        solution,
        layout=whole,
        gain=wide(solution.gain),
        weights=wide(solution.weights),
        directions=None if solution.directions is None else wide(np.asarray(solution.directions)),
    )


def weighed(solution: Solution, factor: FloatArray | float) -> Solution:
    """Return a solution that counts so many times as much in a mean, with or without sensors left out.

    `factor`: of all channels, or of each, shape (n_channels,).
    """
    return replace(solution, weights=factor * solution.weights)
