"""The dissertation's family: increments of displacement as a linear function of those of temperatures (3-1 to 3-5)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray
from models.thermal.model import HyperParameters
from models.thermal.training.families import Fit, Problem, chosen, fold_numbers, require_enough
from models.thermal.training.increments import (
    Factor,
    LinearFit,
    combine,
    factorise,
    fit_each,
    increments,
    mean_square_k2,
)
from models.thermal.training.inputs import Inputs

SPEED_CHANGE_RPM = 100.0
"""A stretch of constant spindle speed ends where its first value is left by more than this [1/min]."""
RELATIVE_PENALTIES: tuple[float, ...] = tuple(10.0 ** (half / 2.0) for half in range(-10, 5))
"""Ridge penalties that are tried, per mean summed square of the increments."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IncrementChoices:
    """What a person decides before training."""

    interval_min: float | None = None
    """Interval of the increments [min]; None: the time between rows."""
    intercept: bool = False
    """Fit b_0; it integrates into a linear drift."""
    ridge_k2: float | Literal["auto"] | None = None
    """Ridge penalty [K^2]; `auto` chooses it on what is left out, None is ordinary least squares."""
    split_at_speed_changes: bool | None = None
    """Take no difference across a change of spindle speed; None: where the speed is known."""


class IncrementProblem:
    """Increments on some rows of recordings, of which folds can be left out; see `Prepare` for the parameters."""

    def __init__(
        self,
        choices: IncrementChoices,
        inputs: Inputs,
        rows: BoolArray,
        fold: IntArray,
        probe_min: float | None,
    ) -> None:
        if choices.ridge_k2 is None:
            require_enough(inputs, rows)
        _require_one_period(inputs)
        self._choices = choices
        self._interval_min = inputs.period_min if choices.interval_min is None else choices.interval_min
        possible = _factor(inputs, np.ones(inputs.rows, dtype=np.bool_), choices, self._interval_min).rows
        self._whole = _factor(inputs, rows, choices, self._interval_min)
        if not self._whole.rows:
            raise DatasetError(
                f"no temperature increment over {self._interval_min:g} min is left (every run is shorter than that, "
                "or had a missing value); take incomplete columns out of the map, or choose another interval"
            )
        self._left_out = possible - self._whole.rows
        numbers = fold_numbers(rows, fold)
        factors = {n: _factor(inputs, rows & (fold == n), choices, self._interval_min) for n in numbers}
        self._of_fold = {number: factor for number, factor in factors.items() if factor.rows}
        self._ridge_k2 = self._penalty(inputs, rows, fold, probe_min)
        self.hyper_parameters: HyperParameters = {
            "interval_min": self._interval_min,
            "intercept": choices.intercept,
            "ridge_k2": self._ridge_k2,
        }

    def _penalty(self, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None) -> float:
        """Return the ridge penalty [K^2]: what a person said, or what predicts left-out folds best."""
        if not isinstance(self._choices.ridge_k2, str):
            return self._choices.ridge_k2 or 0.0
        if len(self._of_fold) < 2:
            raise DatasetError("a ridge penalty can only be chosen with two stretches to leave out; record longer")
        penalties = [relative * mean_square_k2(self._whole) for relative in RELATIVE_PENALTIES]

        def candidates(number: int) -> list[Fit]:
            """Return one fit per penalty without the fold."""
            return self._fits(frozenset({number}), (), penalties)

        return penalties[chosen(inputs, rows, fold, probe_min, candidates)]

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""
        return self._fits(left_out, (), [self._ridge_k2])[0]

    def _fits(self, left_out: frozenset[int], without: tuple[int, ...], penalties: Sequence[float]) -> list[Fit]:
        used = [factor for number, factor in self._of_fold.items() if number not in left_out]
        if left_out and not used:
            raise DatasetError("no increment is left to fit on; record longer")
        factor = combine(used) if left_out else self._whole
        kept = [sensor for sensor in range(factor.sensors) if sensor not in without]
        columns = [0, *(1 + sensor for sensor in kept), *range(1 + factor.sensors, factor.upper.shape[1])]
        part = Factor(upper=factor.upper[:, columns], sensors=len(kept), rows=factor.rows)
        found = fit_each(part, intercept=self._choices.intercept, penalties=penalties)
        return [self._fit(one, factor.sensors, kept, left_out, without) for one in found]

    def _fit(
        self, fitted: LinearFit, sensors: int, kept: list[int], left_out: frozenset[int], without: tuple[int, ...]
    ) -> Fit:
        coefficients = np.zeros((sensors, len(fitted.intercept_um)))
        coefficients[kept] = fitted.coefficients_um_per_k.T
        return Fit(
            coefficients=coefficients,
            drift_um_per_min=fitted.intercept_um / self._interval_min,
            refit=lambda more: self._fits(left_out, tuple(sorted({*without, *more})), [self._ridge_k2])[0],
            counts={"used": fitted.rows, "left_out": self._left_out, "rank": fitted.rank},
        )


def _require_one_period(inputs: Inputs) -> None:
    """Raise DatasetError unless all recordings have the same time between rows."""
    periods_s = []
    for number in range(len(inputs.recording_names)):
        steps = np.diff(inputs.time_min[inputs.recording == number])
        periods_s.append(60.0 * float(np.median(steps)) if len(steps) else 60.0 * inputs.period_min)
    if max(periods_s) - min(periods_s) > 1e-3 * min(periods_s):
        slowest = inputs.recording_names[int(np.argmax(periods_s))]
        raise DatasetError(
            f"{slowest}: has a row every {max(periods_s):g} s, another recording every {min(periods_s):g} s; "
            "raise sample_s so that all are averaged to the same time"
        )


def _factor(inputs: Inputs, rows: BoolArray, choices: IncrementChoices, interval_min: float) -> Factor:
    """Return the factor of the increments of some rows."""
    stretches = [(inputs.degc[part], inputs.cleansed_um[part]) for part in _stretches(inputs, rows, choices)]
    return factorise(increments(stretches, interval_min, 60.0 * inputs.period_min))


def _stretches(inputs: Inputs, rows: BoolArray, choices: IncrementChoices) -> Iterator[IntArray]:
    """Yield rows that follow each other in a run without a gap, and at a constant speed where that is asked for."""
    used = np.flatnonzero(rows)
    breaks = (np.diff(inputs.run[used]) != 0) | (np.diff(inputs.time_min[used]) > 1.5 * inputs.period_min)
    if choices.split_at_speed_changes and inputs.speed_rpm is None:
        raise DatasetError(
            f"{inputs.recording_names[0]}: to split at changes of speed, the recording needs a speed column"
        )
    if choices.split_at_speed_changes is not False and inputs.speed_rpm is not None:
        breaks |= np.diff(_speed_stretches(inputs.speed_rpm[used])) != 0
    yield from np.split(used, np.flatnonzero(breaks) + 1)


def _speed_stretches(speed_rpm: FloatArray) -> IntArray:
    """Return the number of the stretch of constant speed of each row."""
    number, level_rpm = 0, speed_rpm[0] if len(speed_rpm) else 0.0
    found = np.empty(len(speed_rpm), dtype=np.intp)
    for row, speed in enumerate(speed_rpm):
        if abs(speed - level_rpm) > SPEED_CHANGE_RPM:
            number, level_rpm = number + 1, speed
        found[row] = number
    return found


def increments_without_drift(inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None) -> Problem:
    """Return the dissertation's model without b_0, on increments from row to row."""
    return IncrementProblem(IncrementChoices(), inputs, rows, fold, probe_min)


def increments_with_drift(inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None) -> Problem:
    """Return the dissertation's model with b_0, on increments from row to row."""
    return IncrementProblem(IncrementChoices(intercept=True), inputs, rows, fold, probe_min)
