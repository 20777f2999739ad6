"""Tries a fitted model on rows it has not seen, as the machine would: one reference, watch, faults, probes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from models.records import FloatArray
from models.thermal.bias import BiasFilter
from models.thermal.features import BoolArray, IntArray, lag_table
from models.thermal.sensor_watch import SensorWatch
from models.thermal.solution import band_factor
from models.thermal.start import StartDeviation
from models.thermal.training.domain import farthest_leverage, leverage_positions
from models.thermal.training.families import Fit
from models.thermal.training.inputs import Inputs
from models.thermal.training.making import fit_start
from models.thermal.training.probing import probed_residual_um
from models.thermal.watch import SensorFault, Watcher, WatchState

OPEN_CIRCUIT_DEGC = 850.0
"""What a resistance thermometer's input reads when its wire breaks: the top of the scale of a Pt100."""
HISTORY_MIN = 960.0
"""So much of what came before the test fills the watch's memory [min]: four times its longest time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A sensor that fails during a test."""

    kind: Literal["stuck", "step", "open", "drift"]
    sensor: str
    at_hours: float
    """When, on the recording's clock [h]."""
    amount: float = 0.0
    """Step [K] or drift [K/h]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultOutcome:
    """What a fault did."""

    sensor: str
    kind: str
    found_after_min: float | None
    """From the fault to the exclusion of this sensor [min]; None: it was not found."""
    max_ratio: float | None
    """Largest residual over all channels against fault-free; None where that is zero."""
    excluded_instead: tuple[str, ...]
    """Healthy sensors that were excluded."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial:
    """One stretch of a recording that is tested as one run with one reference at its start."""

    name: str
    rows: IntArray
    """Rows of the inputs, in order, of one recording."""
    measured_um: FloatArray
    """Displacements since the first row of the stretch that has them [um], shape (n, n_channels), NaN where missing."""
    residual_um: FloatArray
    """Measured minus estimated, after probes [um]."""
    band_factor: FloatArray
    """By how much the band is widened beyond the domain of training, shape (n,); ones with probes."""
    faults: tuple[SensorFault, ...]


def trial_rows(inputs: Inputs, rows: BoolArray) -> list[IntArray]:
    """Return the rows to test, one stretch per recording."""
    found = [np.flatnonzero(rows & (inputs.recording == index)) for index in range(len(inputs.recording_names))]
    return [part for part in found if len(part)]


class Tester:
    """Tries one fitted model.

    Parameters
    ----------
    inputs
        The recordings with the features of the model.
    fit
        The model.
    watch
        The watch of its sensors, None to watch nothing.
    probe_min
        Time between probes [min] that correct the offset, None for none.
    bias_filter
        How a probe corrects it; None resets it fully.
    trained : shape (n,)
        Rows that the model was fitted on, which tell how far its domain reaches; None: the band is never widened.

    """

    def __init__(
        self,
        inputs: Inputs,
        fit: Fit,
        watch: SensorWatch | None,
        probe_min: float | None = None,
        bias_filter: BiasFilter | None = None,
        trained: BoolArray | None = None,
    ) -> None:
        self._inputs, self._probe_min, self._bias_filter = inputs, probe_min, bias_filter
        self._watcher = None if watch is None else Watcher(watch)
        self._start: StartDeviation | None = None
        if trained is not None and not inputs.axis_positions:  # where axes have dwelt shows in no temperature
            self._start = fit_start(inputs, trained, fit.coefficients)
        self._fits: dict[tuple[int, ...], Fit] = {(): fit}
        self._states: dict[int, list[WatchState]] = {}
        self._points = np.zeros((inputs.rows, 0))
        if trained is not None and probe_min is None and fit.solutions:
            limit = farthest_leverage(inputs, trained, fit.solutions)
            self._points = leverage_positions(fit.solutions, inputs.features) / np.sqrt(limit)

    def run(self, name: str, rows: IntArray) -> Trial:
        """Return the fault-free trial of some rows."""
        states = self._follow(rows, self._inputs.degc, self._begin(rows), 1) if self._watcher is not None else []
        self._states[int(rows[0])] = states
        return self._trial(name, rows, self._inputs.features, states)

    def with_fault(self, trial: Trial, fault: Fault) -> FaultOutcome:
        """Return what a fault does in a stretch that `run` has seen."""
        inputs, rows = self._inputs, trial.rows
        sensor = inputs.sensor_names.index(fault.sensor)
        begins = int(rows[np.argmax(inputs.time_min[rows] >= 60.0 * fault.at_hours - 1e-9)])
        degc = faulty_degc(inputs, sensor, begins, fault, int(rows[-1]) + 1)
        features = self._features_with(sensor, degc)
        first = begins - int(rows[0])
        states: list[WatchState] = []
        if self._watcher is not None:
            healthy = self._states[int(rows[0])]
            first = max(first, 1)
            states = [*healthy[:first], *self._follow(rows, degc, healthy[first - 1], first)[1:]]
        spoilt = self._trial(trial.name, rows, features, states)
        usual, largest = _largest(trial.residual_um), _largest(spoilt.residual_um)
        began_min = float(inputs.time_min[begins])
        of_sensor = [each.time_min - began_min for each in spoilt.faults if each.sensor == sensor]
        found = [minutes for minutes in of_sensor if minutes >= 0.0]
        others = {each.sensor for each in spoilt.faults} - {each.sensor for each in trial.faults} - {sensor}
        return FaultOutcome(
            sensor=fault.sensor,
            kind=fault.kind,
            found_after_min=min(found) if found else None,
            max_ratio=largest / usual if usual > 0.0 else None,
            excluded_instead=tuple(inputs.sensor_names[index] for index in sorted(others)),
        )

    def _features_with(self, sensor: int, degc: FloatArray) -> FloatArray:
        inputs, features = self._inputs, self._inputs.features.copy()
        columns = inputs.layout.of_sensors([sensor])
        for run in np.unique(inputs.run):
            rows = inputs.run == run
            column = degc[rows, sensor][:, None]
            lagged = lag_table(inputs.time_min[rows], column, inputs.layout.lags_min)
            features[np.ix_(rows, columns)] = np.hstack([column, *lagged])
        return features

    def _measured_degc(self, degc: FloatArray, row: int) -> FloatArray:
        """Return what the watch sees of a row: temperatures, without the axis positions that come after them."""
        watched = len(self._inputs.sensor_names) - len(self._inputs.axis_positions)
        return np.where(self._inputs.missing[row, :watched], np.nan, degc[row, :watched])

    def _speed(self, row: int) -> float:
        return float("nan") if self._inputs.speed_rpm is None else float(self._inputs.speed_rpm[row])

    def _begin(self, rows: IntArray) -> WatchState:
        """Return the state at the first row of a stretch, with the memory of what came before."""
        assert self._watcher is not None
        inputs, first = self._inputs, int(rows[0])
        before = np.flatnonzero(
            (inputs.run[: first + 1] == inputs.run[first])
            & (inputs.time_min[: first + 1] >= inputs.time_min[first] - HISTORY_MIN)
        )
        began = int(before[0])
        degc = self._measured_degc(inputs.degc, began)  # all of them temperatures, where a start is known
        unknown = 0.0 if self._start is None else self._start.unknown_at_start(degc)
        state = self._watcher.begin(float(inputs.time_min[began]), degc, self._speed(began), unknown)
        for row in before[1:]:
            degc = self._measured_degc(inputs.degc, int(row))
            state = self._watcher.step(
                state, float(inputs.time_min[row]), degc, self._speed(int(row)), find_faults=False
            )
        absent = np.flatnonzero(inputs.long_missing[first, : self._watcher.watch.layout.sensors])
        faults = tuple(
            SensorFault(sensor=int(index), time_min=float(inputs.time_min[first]), sign="missing") for index in absent
        )
        return replace(state, faults=faults)

    def _follow(self, rows: IntArray, degc: FloatArray, state: WatchState, first: int) -> list[WatchState]:
        """Return the state before row `first` of a stretch and after each row from there on."""
        assert self._watcher is not None
        states = [state]
        for row in rows[first:]:
            time_min = float(self._inputs.time_min[row])
            state = self._watcher.step(state, time_min, self._measured_degc(degc, int(row)), self._speed(int(row)))
            states.append(state)
        return states

    def _trial(self, name: str, rows: IntArray, features: FloatArray, states: Sequence[WatchState]) -> Trial:
        inputs = self._inputs
        excluded = [state.excluded for state in states] or [()] * len(rows)
        estimated_um = np.empty((len(rows), len(inputs.channels)))
        for out in set(excluded):
            if out not in self._fits:
                self._fits[out] = self._fits[()].refit(out)
            chosen = np.array([left_out == out for left_out in excluded])
            elapsed_min = inputs.time_min[rows[chosen]] - inputs.time_min[rows[0]]
            estimated_um[chosen] = self._fits[out].estimate_um(features[rows[chosen]], features[rows[0]], elapsed_min)
        measured_um = since_first_known(inputs.measured_um[rows])
        residual_um = since_first_known(inputs.measured_um[rows] - estimated_um)
        if self._probe_min is not None:
            residual_um = probed_residual_um(inputs.time_min[rows], residual_um, self._probe_min, self._bias_filter)
        return Trial(
            name=name,
            rows=rows,
            measured_um=measured_um,
            residual_um=residual_um,
            band_factor=band_factor(np.linalg.norm(self._points[rows] - self._points[rows[0]], axis=1)),
            faults=states[-1].faults if states else (),
        )


def faulty_degc(inputs: Inputs, sensor: int, begins: int, fault: Fault, stop: int) -> FloatArray:
    """Return the temperatures with a fault from one row on to another (exclusive), shape (n, n_sensors)."""
    degc = inputs.degc.copy()
    part = slice(begins, stop)
    if fault.kind == "stuck":
        degc[part, sensor] = degc[begins, sensor]
    elif fault.kind == "open":
        degc[part, sensor] = OPEN_CIRCUIT_DEGC
    elif fault.kind == "step":
        degc[part, sensor] += fault.amount
    else:
        degc[part, sensor] += fault.amount * (inputs.time_min[part] - inputs.time_min[begins]) / 60.0
    return degc


def since_first_known(values: FloatArray) -> FloatArray:
    """Return each column minus its first known value, shape (n, n_columns); NaN stays."""
    known = np.isfinite(values)
    first = np.argmax(known, axis=0)
    return np.asarray(values - values[first, np.arange(values.shape[1])])


def _largest(residual_um: FloatArray) -> float:
    return float(np.nanmax(np.abs(residual_um), initial=0.0))
