"""Modes of the tool point by regression on temperatures, fitted on impact tests during warm-up.

A direct relative of the regression of bearing properties (5-1): the same variables, 1, T, dT and dT^2, explain the
logarithms of frequency, damping ratio and gain of each mode. Nothing needs to be known of the spindle's inside.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.stability.response import ModalResponse, Mode

AXES = ("x", "y")
INTERVAL_S = 600.0
"""Interval of the difference terms, as published for most properties [s]."""
MEAN_S = 60.0
"""Signals are means over the last minute [s]."""
RIDGE = 1e-3
"""Penalty of a standardised coefficient, against the number of impact tests."""
BEYOND_SPREADS = 4.0
"""A variable counts as far as this many standard deviations of the fit from its mean, and no further."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModalSample:
    """One impact test: what the signals read, and the modes fitted to the responses."""

    degc: FloatArray
    """Signals [degC], shape (m,)."""
    difference_k: FloatArray
    """Their change over `INTERVAL_S` [K], shape (m,)."""
    modes: Mapping[str, tuple[Mode, ...]]
    """Axis -> modes in ascending frequency, as many in each test."""


class ModalRegression:
    """Modes as functions of temperatures.

    Raises StabilityError with too few tests, other modes from test to test, or a mode without a positive gain.

    `samples`: impact tests, more than there are variables (1 + 3 m).
    """

    def __init__(self, samples: Sequence[ModalSample]) -> None:
        first = samples[0] if samples else None
        if first is None or len(samples) <= 1 + 3 * len(first.degc):
            raise StabilityError(
                f"{len(samples)} impact tests do not determine a regression; take more than one for each of its "
                "variables, 1 and three per temperature"
            )
        self._counts = {axis: len(modes) for axis, modes in first.modes.items()}
        variables = np.array([_variables(sample.degc, sample.difference_k) for sample in samples])
        self._mean, self._spread = variables.mean(axis=0), np.maximum(variables.std(axis=0), 1e-6)
        scaled = (variables - self._mean) / self._spread
        targets = np.array([self._logarithms(sample) for sample in samples])
        self._level = targets.mean(axis=0)
        penalty = RIDGE * len(samples) * np.eye(scaled.shape[1])
        self._slopes: FloatArray = np.linalg.solve(scaled.T @ scaled + penalty, scaled.T @ (targets - self._level))

    def _logarithms(self, sample: ModalSample) -> list[float]:
        if {axis: len(modes) for axis, modes in sample.modes.items()} != self._counts:
            raise StabilityError("an impact test shows another number of modes than the first; leave it out")
        modes = [mode for axis in self._counts for mode in sample.modes[axis]]
        values = [
            value for each in modes for value in (each.frequency_hz, each.damping_ratio, each.displacement_gain_per_kg)
        ]
        if min(values) <= 0.0:
            raise StabilityError("a mode of an impact test has no positive gain; measure at the driving point")
        return [math.log(value) for value in values]

    def modes(self, degc: FloatArray, difference_k: FloatArray) -> dict[str, tuple[Mode, ...]]:
        """Return the modes per axis at temperatures [degC] and their changes [K], both of shape (m,)."""
        scaled = np.clip((_variables(degc, difference_k) - self._mean) / self._spread, -BEYOND_SPREADS, BEYOND_SPREADS)
        values = iter(np.exp(self._level + scaled @ self._slopes).tolist())
        return {
            axis: tuple(
                Mode(frequency_hz=next(values), damping_ratio=next(values), displacement_gain_per_kg=next(values))
                for _ in range(count)
            )
            for axis, count in self._counts.items()
        }


def _variables(degc: FloatArray, difference_k: FloatArray) -> FloatArray:
    return np.concatenate((degc, difference_k, difference_k**2))


class SignalHistory:
    """Means of labelled sensors over the last minute, and their change over the interval.

    `labels`: signal -> indices into the machine's sensor order, whose mean it is.
    """

    def __init__(self, labels: Mapping[str, Sequence[int]]) -> None:
        self._indices = [np.array(each, dtype=np.intp) for each in labels.values()]
        self._rows: deque[tuple[float, FloatArray]] = deque()

    def add(self, time_s: float, degc: FloatArray) -> None:
        """Take a reading of all sensors [degC], NaN where there is none."""
        signals = np.array([degc[each].mean() for each in self._indices])
        if np.isfinite(signals).all():
            self._rows.append((time_s, signals))
        while self._rows and self._rows[0][0] < time_s - INTERVAL_S - MEAN_S:
            self._rows.popleft()

    def now(self, time_s: float) -> tuple[FloatArray, FloatArray] | None:
        """Return means [degC] and changes [K], shape (m,); None while either is not known."""
        means = [self._mean(time_s - ago_s) for ago_s in (0.0, INTERVAL_S)]
        latest, before = means
        return None if latest is None or before is None else (latest, latest - before)

    def _mean(self, time_s: float) -> FloatArray | None:
        rows = [signals for at_s, signals in self._rows if time_s - MEAN_S <= at_s <= time_s]
        return np.mean(rows, axis=0) if rows else None


class ModalEstimator:
    """Tool point from temperatures, reading by reading (`ToolPointEstimator`).

    `regression`: fitted on the machine's own impact tests. `labels`: signal -> indices into the machine's sensor order,
    in the order of the regression.
    """

    def __init__(self, regression: ModalRegression, labels: Mapping[str, Sequence[int]]) -> None:
        self._regression = regression
        self._history = SignalHistory(labels)

    def renew(self, time_s: float, degc: FloatArray) -> EstimatedToolPoint | None:
        """Return the dynamics at a reading of all sensors [degC], shape (n,); None without eleven minutes of them."""
        self._history.add(time_s, degc)
        signals = self._history.now(time_s)
        if signals is None:
            return None
        modes = self._regression.modes(*signals)
        return EstimatedToolPoint(
            response=ModalResponse(xx=modes.get("x", ()), yy=modes.get("y", ())),
            resonance_hz={axis: _strongest(each) for axis, each in modes.items() if each},
        )


def _strongest(modes: Sequence[Mode]) -> float:
    """Return the damped frequency of the mode that responds most [Hz]."""
    mode = max(modes, key=lambda each: each.displacement_gain_per_kg / (each.damping_ratio * each.frequency_hz**2))
    return float(mode.frequency_hz * np.sqrt(max(1.0 - 2.0 * mode.damping_ratio**2, 0.0)))
