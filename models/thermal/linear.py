"""The family of models that are linear in temperatures, their lags and lagged speed: default, increments, ridge ..

The states of a model in use live from sample to sample and need no storage of their own: a rebuild over four times
the longest lag gives the same states as if nothing had been interrupted. Only which sensors the watch has excluded,
and what sensors that returned count from, does not follow from the temperatures; the caller keeps that with the
reference, and brings it back with it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from models.model_file import file_text, record_of
from models.records import FloatArray
from models.thermal.estimation import Estimation, Machine, OnlineReference, Samples
from models.thermal.estimator import (
    LinearEstimator,
    excluded_sensors,
    fault_signs,
    readmitted,
    with_faults,
    worth_um,
)
from models.thermal.features import feature_table
from models.thermal.known_history import ModelState
from models.thermal.model import LinearParameters
from models.thermal.rebase import StateReference, estimate_since, rebased, resumed, returning, state_reference
from models.thermal.watch import MISSING

FAMILY = "linear"
AGREES_MIN, AGREES_K, AGREES_UM = 30.0, 0.5, 0.5
"""For so long a sensor that slewed must be as the others expect it, and be worth so little, to count again."""

BACK_SHARE = 0.5
"""A jump to so much of the distance from where the others expect a sensor, or less, has brought it back."""


class LinearOnline:
    """Advances the states once per mean of its inputs; estimates whenever it is asked.

    `model`: the model. `machine`: components of its sensors, which a model without ridges takes for each other, and
    the steps in which they count. `estimator`: what runs it.
    """

    def __init__(
        self, model: LinearParameters, machine: Machine, estimator: type[LinearEstimator] = LinearEstimator
    ) -> None:
        self.model = model
        components = tuple(machine.components.get(sensor_id, "") for sensor_id in model.sensor_ids)
        steps_k = tuple(machine.steps_k.get(sensor_id, 0.0) for sensor_id in model.sensor_ids)
        self._estimator = estimator(model, components, steps_k)
        self._state: ModelState | None = None
        self._reference: StateReference | None = None
        self._reference_min = 0.0
        self._anew: set[int] = set()
        self._left_out: dict[int, str] = {}
        self._wrong: set[int] = set()
        self._agrees_min: dict[int, float] = {}
        self._speed_rpm = float("nan")
        self._latest: ModelState | None = None

    @property
    def history_min(self) -> float:
        """So much history the states need [min]."""
        return self._estimator.history_min

    @property
    def memory_min(self) -> float:
        """So much of the past the states, or the watch alone, remember [min]."""
        return self._estimator.memory_min

    @property
    def filled(self) -> float:
        """How far the states are known, 0..1: what a reference now would be worth."""
        if self.history_min <= 0.0:
            return 1.0
        return 0.0 if self._state is None else self._estimator.settled(self._state)

    def rebuild(self, history: Samples, wrong: Mapping[int, str] = MappingProxyType({})) -> None:
        """Fill the states and the watch from the history; a model without lags and watch has nothing to fill."""
        if self.memory_min > 0.0:
            self._state, self._left_out = self._estimator.rebuild(history, bridged=True), dict(wrong)

    def on_sample(self, time_min: float, degc: FloatArray, speed_rpm: float) -> None:
        """Advance the states when another whole mean is due; temperatures [degC], speed [1/min]."""
        self._speed_rpm = speed_rpm
        now = self._counted(degc)
        if self._state is None:
            if np.isfinite(now).any():
                self._state = self._estimator.begin(time_min, now, speed_rpm)
        elif time_min - self._state.time_min >= (self.model.period_s or 60.0 * self.model.period_min) / 60.0:
            self._state = self._agreeing(self._estimator.advance(self._state, time_min, now, speed_rpm, bridged=True))

    def _agreeing(self, state: ModelState) -> ModelState:
        """Return the state in which sensors count again that slewed, but say for long what the others expect of them.

        The air at a door falls faster than it ever did in training, and is itself again when the door is shut.
        """
        faults = () if self._reference is None or state.watch is None else state.watch.faults
        slewed, now_min = [fault.sensor for fault in faults if fault.sign == "slew"], state.time_min
        self._agrees_min = {i: self._agrees_min.get(i, now_min) for i in slewed if self._agrees(state, i)}
        again = [i for i, since_min in self._agrees_min.items() if now_min - since_min >= AGREES_MIN]
        return self._estimator.reinitialised(readmitted(state, again), again) if again else state

    def _agrees(self, state: ModelState, sensor: int) -> bool:
        """Tell whether a sensor that does not count says now, with its lags, what it is taken for."""
        assert self._reference is not None
        then, left_out = self._reference.state, self._estimator.left_out
        without = excluded_sensors(state, then)
        change = self._estimator.features(state) - self._estimator.features(then)
        if state.missing[sensor] or abs((change - left_out.imputed(change, without))[sensor]) > AGREES_K:
            return False
        counted = excluded_sensors(readmitted(state, [sensor]), then)
        moved_um = change @ (left_out.coefficients(counted) - left_out.coefficients(without))
        return bool(np.abs(moved_um).max() <= AGREES_UM)

    def jumped(self, jump_k: FloatArray) -> None:
        """Take that inputs count at other levels from now on [K]: their lags are where they would always have been."""
        if (state := self._state) is not None:
            lagged, known = state.lagged + jump_k, state.known_lagged + jump_k
            self._state = replace(state, degc=state.degc + jump_k, lagged=lagged, known_lagged=known)

    def set_reference(self, reference: OnlineReference) -> tuple[int, ...]:
        """Keep the states at the reference; those of one that lies back come from its history."""
        if self._left_out and reference.excluded is None:
            self._state = self._now(reference.now_min, reference.degc)
        before, left = self._state, self._reference
        readmitted_ids = self._readmit(reference) if reference.excluded is None else ()
        self._left_out = dict(reference.excluded or {}) if self.model.watch is None else {}
        if self.history_min <= 0.0:
            state: ModelState | None = self._estimator.begin(reference.time_min, reference.degc)
        elif reference.history is not None:
            state = _as_held(self._estimator.rebuild(reference.history, bridged=True), reference)
        else:
            state = self._now(reference.now_min, reference.degc)
        counted = left if reference.excluded is None else None
        self._reference = None if state is None else state_reference(self._estimator, state, counted)
        self._reference_min, self._anew = reference.time_min, set()
        if (
            reference.excluded is None
            and before is not None
            and self._state is not None
            and self._reference is not None
        ):
            shift_degc = self._reference.shift_degc + self._state.lagged - before.lagged
            self._anew = {i for i in map(self.model.sensor_ids.index, readmitted_ids) if not before.missing[i]}
            self._anew |= set(np.flatnonzero(shift_degc.any(axis=0)).tolist())
            self._reference = replace(self._reference, shift_degc=shift_degc)
        if reference.excluded is not None and self._state is not None:
            self._state = with_faults(self.model, self._state, reference.excluded)
        if reference.kept is not None:
            self._restore(reference.kept, told=left is None)
        self._wrong = set(_found_wrong(self._state))
        return readmitted_ids

    @property
    def reference_degc(self) -> FloatArray | None:
        """What the temperatures at the reference count as [degC]; None for a model with lags, see `kept`."""
        if self._reference is None or self.history_min > 0.0:
            return None
        then = self._reference.state
        return np.where(then.missing, np.nan, then.degc)

    @property
    def excluded(self) -> dict[int, str]:
        """Sensors whose values were found wrong; a missing one counts again when it has values again."""
        signs = {} if self._state is None else fault_signs(self.model, self._state)
        return self._left_out | {sensor_id: sign for sensor_id, sign in signs.items() if sign != MISSING}

    @property
    def kept(self) -> dict[str, Any] | None:
        """What the sensors that returned since the reference count from, and how far that may be off; None: none."""
        if self._reference is None:
            return None
        if self.history_min <= 0.0:  # the reference holds the temperatures that they count from
            rest_um, unsure_um = self._reference.rest_um, self._reference.imputed_um
            own = {"model_id": self.model.model_id, "rest_um": rest_um.tolist(), "imputed_um": unsure_um}
            return own if unsure_um > 0.0 or rest_um.any() else None
        if not self._anew:
            return None
        then = self._reference.state
        return {
            "model_id": self.model.model_id,
            "reference_degc": {
                str(self.model.sensor_ids[i]): [float(then.degc[i]), *then.lagged[:, i].tolist()]
                for i in sorted(self._anew)
            },
            "shift_degc": self._reference.shift_degc.tolist(),
            "rest_um": self._reference.rest_um.tolist(),
            "imputed_um": self._reference.imputed_um,
            "rest_after_min": self._reference.rest_since_min - self._reference_min,
        }

    def estimate(
        self, time_min: float, degc: FloatArray, absent: npt.NDArray[np.bool_]
    ) -> tuple[Estimation | None, tuple[int, ...]]:
        """Return the thermal error between the states now and at the reference, and the sensors set anew for it."""
        state = self._now(time_min, self._counted(degc))
        if state is None or self._reference is None:
            return None, ()
        known = ~self._reference.state.missing
        here = returning(self._estimator, state, self._reference, np.flatnonzero(absent & known).tolist())
        back = tuple(i for i in here if not known[i])
        if own := [i for i in here if known[i]]:
            self._state = state = self._estimator.reinitialised(state, own)
        found = rebased(self._estimator, state, self._reference, back) if back else None
        anew: tuple[int, ...] = ()
        if found is not None:
            self._state, self._reference = found
            state = found[0]
            self._anew |= set(back)
            anew = tuple(self.model.sensor_ids[i] for i in back)
        self._latest = state
        estimation = estimate_since(self._estimator, state, self._reference)
        wrong = set(_found_wrong(state))
        if estimation is not None and (found_now := wrong - self._wrong):
            was_um = worth_um(self._estimator, state, self._reference.state, found_now)
            estimation = replace(estimation, found_wrong_um=was_um)
        self._wrong = wrong
        return estimation, anew

    def level_um(self, uncertainty_k: FloatArray) -> float:
        """Return by how much the thermal error may be wrong if sensors' levels are wrong by so much [K]."""
        if self._latest is None or self._reference is None:
            return self._estimator.left_out.level_um(uncertainty_k, ())
        return self._estimator.level_um(self._latest, self._reference.state, uncertainty_k)

    def contributions_um(self) -> Callable[[], FloatArray] | None:
        """Return what works out what each sensor adds to the latest estimate [um], shape (n_sensors, n_channels)."""
        if self._latest is None or self._reference is None:
            return None
        return partial(contributions_um, self._estimator, self._latest, self._reference.state)

    def _counted(self, degc: FloatArray) -> FloatArray:
        """Return the temperatures without those of sensors that another model found wrong [degC]."""
        if self._reference is None or not self._left_out:
            return degc
        return np.where(np.isin(self.model.sensor_ids, list(self._left_out)), np.nan, degc)

    def _now(self, time_min: float, degc: FloatArray) -> ModelState | None:
        if self._state is None:
            return None
        return self._estimator.advance(self._state, time_min, degc, self._speed_rpm, find_faults=False, bridged=True)

    def _restore(self, kept: Mapping[str, Any], *, told: bool) -> None:
        """Let sensors that had returned count from where they did; `told`: the lags of now are as the history tells."""
        own = kept["model_id"] == self.model.model_id
        if self._reference is not None and "reference_degc" not in kept:
            rest_um = np.array(kept["rest_um"]) if own else self._reference.rest_um
            self._reference = replace(self._reference, rest_um=rest_um, imputed_um=float(kept["imputed_um"]))
        if self._reference is None or self._state is None or not own or "reference_degc" not in kept:
            return
        columns = {self.model.sensor_ids.index(int(i)): values for i, values in kept["reference_degc"].items()}
        counted = replace(
            self._reference,
            rest_um=np.array(kept["rest_um"]),
            shift_degc=np.reshape(kept["shift_degc"], self._reference.shift_degc.shape),
            rest_since_min=self._reference_min + kept["rest_after_min"],
            imputed_um=float(kept.get("imputed_um", 0.0)),
        )
        self._anew = set(columns)
        self._state, self._reference = resumed(self._estimator, self._state, counted, columns, told=told)

    def _readmit(self, reference: OnlineReference) -> tuple[int, ...]:
        """Let sensors that were found faulty count again from a new reference on; return their IDs.

        What the watch remembers begins where the others expect it, and so do lags of a sensor that is as they expect
        it again: its past was wrong. One that is not keeps its own, and with them the distance from training, beyond
        which the others expect and blame wrongly. Blamed or not, a sensor whose jumps have brought it to where they
        expect it had drifted: at its level of now, what it said before is as wrong as that.
        """
        if self._state is None:
            return ()
        watched = () if self._state.watch is None else self._state.watch.excluded
        out = sorted({*watched, *np.flatnonzero(np.isin(self.model.sensor_ids, [*self._left_out])).tolist()})
        state, sensors = readmitted(self._state, out), self.model.layout.sensors
        jumped_k = np.zeros(sensors) if reference.jumped_k is None else reference.jumped_k
        if here := [i for i in {*out, *np.flatnonzero(jumped_k).tolist()} if not state.missing[i]]:
            departed_k, begun = _beside_others(self._estimator, state, here, reference.shift_k)
            as_expected = np.abs(departed_k) <= np.where(np.isin(np.arange(sensors), out), AGREES_K, -1.0)
            as_expected |= (jumped_k != 0.0) & (np.abs(departed_k) <= BACK_SHARE * np.abs(departed_k - jumped_k))
            lagged = np.where(as_expected, begun, state.lagged)
            again = [i for i in here if i in out or as_expected[i]]
            state = self._estimator.reinitialised(replace(state, lagged=lagged), again)
        self._state = state
        return tuple(self.model.sensor_ids[i] for i in out)


def _found_wrong(state: ModelState | None) -> list[int]:
    """Return the indices of the sensors that the watch has found wrong; one that is only missing is not."""
    faults = () if state is None or state.watch is None else state.watch.faults
    return [fault.sensor for fault in faults if fault.sign != MISSING]


def _beside_others(
    estimator: LinearEstimator, state: ModelState, sensors: Sequence[int], shift_k: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return how far sensors are from where all others let them be expected [K], and lags begun from there [degC].

    Result of shapes (n_sensors,) and (n_lags, n_sensors). Whoever came back at another level may only have warmed by
    what is taken off for it, or be right again: all is looked at with that and without, and the nearer counts.
    """
    without = sorted({*sensors, *np.flatnonzero(state.missing).tolist()})
    departed_k, lagged = np.full(len(state.degc), np.inf), state.lagged
    for off_k in (0.0, shift_k) if np.any(shift_k) else (0.0,):
        at = replace(state, degc=state.degc + off_k, lagged=state.lagged + off_k)
        from_centre = estimator.features(at) - estimator.model.centre
        found_k = (from_centre - estimator.left_out.imputed(from_centre, without))[: len(state.degc)]
        nearer = np.abs(found_k) < np.abs(departed_k)
        lagged = np.where(nearer, estimator.begun(at, sensors).lagged - off_k, lagged)
        departed_k = np.where(nearer, found_k, departed_k)
    return departed_k, lagged


def _as_held(state: ModelState | None, reference: OnlineReference) -> ModelState | None:
    """Return the states at a reference that lies back with the temperatures that the reference holds.

    The last sample of its history may lack a sensor that its mean holds: set anew when it counts next, that would count
    from a level which may be doubted then. One that the history does not know at all has no lags, and stays missing.
    """
    if state is None:
        return None
    held = np.isfinite(reference.degc) & np.isfinite(state.known_min)
    return replace(
        state,
        degc=np.where(held, reference.degc, state.degc),
        missing=~held,
        known_min=np.where(held, reference.time_min, state.known_min),
    )


def contributions_um(estimator: LinearEstimator, state: ModelState, reference: ModelState) -> FloatArray:
    """Return how much of the thermal error since the reference comes with each sensor and its lags [um].

    Result of shape (n_sensors, n_channels); what speed and drift add is in none of them.
    """
    change, layout = estimator.features(state) - estimator.features(reference), estimator.model.layout
    parts = change[:, None] * estimator.left_out.coefficients(excluded_sensors(state, reference))
    of_temperatures = parts[: layout.temperature_columns]
    return np.asarray(of_temperatures.reshape(-1, layout.sensors, of_temperatures.shape[1]).sum(axis=0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearModel(LinearParameters):
    """A linear model as the daemon loads it."""

    def runtime(self, machine: Machine) -> LinearOnline:
        """Return the model in use on a machine."""
        return LinearOnline(self, machine)

    def recorded_um(
        self, time_min: FloatArray, degc: FloatArray, speed_rpm: FloatArray | None, first: int
    ) -> FloatArray:
        """Return what it estimates over a recording since one of its rows, without watching its sensors.

        Result of shape (n - first, n_channels): thermal error since the reference [um].

        `time_min`, shape (n,): increasing times [min]; lags begin as if the first row had lasted for ever. `degc`,
        shape (n, n_sensors): temperatures in the model's order [degC], finite. `speed_rpm`, shape (n,): spindle speed
        [1/min]; NaN repeats the value before. None where it is not known at all. `first`: the row that is the
        reference.
        """
        speed = np.zeros(len(degc)) if speed_rpm is None else speed_rpm
        known = np.maximum.accumulate(np.where(np.isfinite(speed), np.arange(len(speed)), -1))
        held = np.where(known >= 0, speed[np.maximum(known, 0)], 0.0)
        features = feature_table(self.layout, time_min, degc, held, self.speed_scale_rpm)
        return self.error_since_um(features[first:], features[first], time_min[first:] - time_min[first])

    def to_json(self) -> str:
        """Return the text of its file; numbers are exact, large matrices in single precision."""
        return file_text(FAMILY, self)


def linear_model(content: bytes) -> LinearModel:
    """Return the model that the content of a file holds; raises ModelError."""
    return record_of(content, LinearModel)
