"""Runs a linear model sample by sample: its state is an explicit record.

`LinearEstimator.rebuild` makes a `ModelState` of a history, `advance` takes every further sample into
it, the state at the instant of a reference is kept as the reference, and `estimate` gives the
thermal error from the state now and the state at the reference. A model without lags remembers no more
than which temperatures are known.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.estimation import Estimation
from models.thermal.features import BRIDGE_MIN, Layout, lag_step, speed_inputs
from models.thermal.known_history import KnownHistory, ModelState
from models.thermal.left_out import LeftOut
from models.thermal.model import Domain, LinearParameters
from models.thermal.sensor_watch import SLOW_MIN
from models.thermal.solution import band_factor, far_confidence, fast_confidence
from models.thermal.watch import SensorFault, Watcher, WatchState

SETTLED_LAGS = 4.0
"""So many times the longest lag of history fill the states."""
DOMAIN_MARGIN_K = 0.5
"""A temperature may change by more than training saw by the width of its range, by the median width of all, because
that one hardly moved may be luck, and by this [K]: eight steps of a TMP102, so that noise is no departure."""
SEASON_K = 20.0
"""Its level may leave the range by this [K], too: a hall in another season. Beyond, it is no sensor of this machine."""


class LinearEstimator:
    """A linear model, prepared once; every method is pure in the state.

    `components`: machine component of each sensor of the model, in its order; empty: all are on one. `steps_k`: step in
    which each of them counts [K], 0 where none is known; empty: of none.
    """

    def __init__(self, model: LinearParameters, components: Sequence[str] = (), steps_k: Sequence[float] = ()) -> None:
        if components and len(components) != len(model.sensor_ids):
            raise ValueError(f"{len(components)} components for {len(model.sensor_ids)} sensors of {model.model_id}")
        self.model = model
        names = sorted(set(components))
        beside = np.array([names.index(each) for each in components], dtype=np.intp) if components else None
        self.left_out = LeftOut(model, beside)
        self._watched_sensors = model.layout.sensors - len(model.axis_positions)
        steps_k = steps_k[: self._watched_sensors]
        self._watcher = None if model.watch is None else Watcher(model.watch, steps_k)
        self._lowest, self._highest, self._farthest = widened(model.domain, self._watched_sensors)
        self._bridge_min = max(BRIDGE_MIN, 2.5 * model.period_min)
        self._past = KnownHistory(model, self._bridge_min)
        self.history_min = SETTLED_LAGS * max((*model.layout.lags_min, *model.layout.speed_lags_min), default=0.0)
        """So much history the states need [min]."""
        self.memory_min = self.history_min if model.watch is None else max(self.history_min, SETTLED_LAGS * SLOW_MIN)
        """So much of the past the states, or the watch alone, remember [min]."""

    def begin(self, time_min: float, degc: FloatArray, speed_rpm: float = float("nan")) -> ModelState:
        """Return the state at a first sample, as if it had lasted for ever; how far that is so is not known.

        Raises ValueError when the shape does not fit the model or the time is not finite.

        `time_min`: its time [min]. `degc`, shape (n_sensors,): temperatures in the model's sensor order [degC],
        filtered as in training (means over `model.period_min`), NaN where missing. `speed_rpm`: spindle speed [1/min],
        NaN where unknown.
        """
        self._require(time_min, degc)
        model, temperatures = self.model, degc[: self._watched_sensors]
        known = np.isfinite(degc)
        filled = np.where(known, degc, model.centre[: model.layout.sensors])
        speed = speed_rpm if np.isfinite(speed_rpm) else 0.0
        inputs = speed_inputs(np.array([speed]), model.speed_scale_rpm)[0]
        lagged = np.tile(filled, (len(model.layout.lags_min), 1))
        unknown = 0.0 if model.start is None or model.axis_positions else model.start.unknown_at_start(degc)
        return ModelState(
            time_min=time_min,
            degc=filled,
            missing=~known,
            known_min=np.where(known, time_min, -np.inf),
            since_min=np.full(len(degc), time_min if self.history_min else -np.inf),
            unknown=self._past.at_first(degc, speed_rpm),
            unread=np.zeros(len(self._past.constants_min)),
            interval_min=self._bridge_min / 1.5,
            speed_rpm=speed,
            speed_known_min=time_min if np.isfinite(speed_rpm) else -np.inf,
            lagged=lagged,
            known_lagged=lagged,
            speed_lagged=np.tile(inputs, (len(model.layout.speed_lags_min), 1)),
            watch=None if self._watcher is None else self._watcher.begin(time_min, temperatures, speed_rpm, unknown),
        )

    def _require(self, time_min: float, degc: FloatArray) -> None:
        if degc.shape != (self.model.layout.sensors,):
            raise ValueError(
                f"model {self.model.model_id} needs {self.model.layout.sensors} temperatures, got {degc.shape}"
            )
        if not np.isfinite(time_min):
            raise ValueError(f"time_min must be finite, got {time_min}")

    def advance(
        self,
        state: ModelState,
        time_min: float,
        degc: FloatArray,
        speed_rpm: float = float("nan"),
        *,
        find_faults: bool = True,
        bridged: bool = False,
    ) -> ModelState:
        """Return the state after a sample.

        After a gap longer than `BRIDGE_MIN` the lags of a sensor begin where the other sensors let them be expected;
        of those of spindle speed, and of sensors that were silent all together, what they took in of the gap is
        unknown, and they begin anew where a machine at rest tells more. A model without lags has nothing to begin.

        `time_min`, `degc`, `speed_rpm`: see `begin`. A time that does not lie after the state's changes nothing.
        `find_faults`: whether the watch may exclude sensors; False while history is replayed. `bridged`: sensors return
        at a level that their own past explains: their lags go on as if the temperature had gone straight through the
        gap, however long it was.
        """
        self._require(time_min, degc)
        elapsed_min = time_min - state.time_min
        if elapsed_min <= 0.0:
            return state
        known = np.isfinite(degc)
        filled = np.where(known, degc, state.degc)
        returned = known & (time_min - state.known_min > self._bridge_min) & (self.history_min > 0.0)
        speed_known = bool(np.isfinite(speed_rpm))
        speed = float(speed_rpm) if speed_known else state.speed_rpm
        lagged, speed_lagged = self._lags(state, elapsed_min, filled, speed)
        own = known & (state.missing | returned) & np.isfinite(state.known_min) & bridged
        if own.any():
            lagged = _bridged(self.model.layout, state, time_min, filled, own, lagged)
        returned &= ~own
        unknown, unread, rests = self._past.after(state, time_min, degc, speed_known)
        if rests.any():
            count, now = len(lagged), speed_inputs(np.array([speed]), self.model.speed_scale_rpm)
            lagged = np.where(rests[:count, None] & known, filled, lagged)
            speed_lagged = np.where(rests[count:, None], now, speed_lagged)
        advanced = ModelState(
            time_min=time_min,
            degc=filled,
            missing=~known,
            known_min=np.where(known, time_min, state.known_min),
            since_min=np.where(returned, time_min, state.since_min),
            unknown=unknown,
            unread=unread,
            interval_min=elapsed_min,
            speed_rpm=speed,
            speed_known_min=time_min if speed_known else state.speed_known_min,
            lagged=lagged,
            known_lagged=np.where(known, lagged, state.known_lagged),
            speed_lagged=speed_lagged,
            watch=self._watched(state.watch, time_min, degc, speed_rpm, find_faults),
        )
        return self.begun(advanced, np.flatnonzero(returned).tolist()) if returned.any() else advanced

    def begun(self, state: ModelState, sensors: Sequence[int]) -> ModelState:
        """Return the state in which the lags of sensors (indices) that return begin where the others expect them."""
        returned = np.zeros(self.model.layout.sensors, dtype=np.bool_)
        returned[list(sensors)] = True
        without = state.missing | returned
        if state.watch is not None:
            without[list(state.watch.excluded)] = True
        lagged = self.left_out.started_lags(self.features(state), returned, np.flatnonzero(without).tolist())
        return replace(state, lagged=lagged, known_lagged=np.where(returned, lagged, state.known_lagged))

    def _lags(
        self, state: ModelState, elapsed_min: float, degc: FloatArray, speed_rpm: float
    ) -> tuple[FloatArray, FloatArray]:
        layout = self.model.layout
        before, now = speed_inputs(np.array([state.speed_rpm, speed_rpm]), self.model.speed_scale_rpm)
        lags_min, speed_lags_min = (np.array(each)[:, None] for each in (layout.lags_min, layout.speed_lags_min))
        lagged = lag_step(state.lagged, state.degc, degc, elapsed_min, lags_min)
        return lagged, lag_step(state.speed_lagged, before, now, elapsed_min, speed_lags_min)

    def _watched(
        self, watch: WatchState | None, time_min: float, degc: FloatArray, speed_rpm: float, find_faults: bool
    ) -> WatchState | None:
        """Return the watch's state: it looks as often as in training, because its limits on slew are from there."""
        if self._watcher is None or watch is None or time_min - watch.time_min < 0.999 * self.model.period_min:
            return watch
        return self._watcher.step(watch, time_min, degc[: self._watched_sensors], speed_rpm, find_faults=find_faults)

    def rebuild(
        self, samples: Iterable[tuple[float, FloatArray, float]], *, bridged: bool = False
    ) -> ModelState | None:
        """Return the state after a history of (time [min], temperatures [degC], speed [1/min]); None when empty."""
        state = None
        for time_min, degc, speed_rpm in samples:
            if state is None:
                state = self.begin(time_min, degc, speed_rpm)
                if bridged:  # what a history does not reach back to is unknown of the lags, and is no absence
                    state = replace(state, since_min=np.where(state.missing, state.since_min, -np.inf))
            else:
                state = self.advance(state, time_min, degc, speed_rpm, find_faults=False, bridged=bridged)
        return state

    def settled(self, state: ModelState) -> float:
        """Return how far the states are known, 0..1: what a reference now would be worth."""
        return self._past.worth(state)

    def features(self, state: ModelState) -> FloatArray:
        """Return temperatures, their lags and lagged speed of a state, shape (layout.columns,)."""
        return np.concatenate([state.degc, state.lagged.ravel(), state.speed_lagged.ravel()])

    def estimate(self, state: ModelState, reference: ModelState) -> Estimation | None:
        """Return the thermal error since the reference.

        Sensors that must not count are left out of the model over the whole interval since the
        reference, by block elimination, so that nothing of their wrong values stays behind.

        Result: `confidence` is the product of how far the states are known, of the share of usable sensors and of the
        distance from training; None without any usable sensor.
        """
        excluded = excluded_sensors(state, reference)
        sensors = self.model.layout.sensors
        if len(excluded) == sensors:
            return None
        change = self.features(state) - self.features(reference)
        elapsed_min = max(state.time_min - reference.time_min, 0.0)
        counted = np.ones(sensors, dtype=np.bool_)
        counted[list(excluded)] = False
        seen = change[:sensors] if self.model.domain.of_increments else state.degc
        outside = (seen < self._lowest) | (seen > self._highest) | (np.abs(change[:sensors]) > self._farthest)
        outside &= counted
        distance, unknown_share, imputed_um = self.left_out.distance(change, excluded)
        near = far_confidence(distance, unknown_share)
        near *= fast_confidence(state.speed_rpm, self.model.domain.highest_speed_rpm)
        known, past_factor, unread_um = self._past.since(state, reference)
        share = self.left_out.share(excluded)
        band_um = self.model.band_um
        relative = np.divide(imputed_um, band_um, out=np.zeros_like(imputed_um), where=band_um > 0.0)
        return Estimation(
            thermal_error_um=change @ self.left_out.coefficients(excluded) + elapsed_min * self.model.drift_um_per_min,
            confidence=known * near * share,
            share=share,
            in_domain=not outside.any() and near > 0.0,
            imputed=self._ids(np.flatnonzero(~counted)),
            outside=self._ids(np.flatnonzero(outside)),
            band_factor=np.sqrt(np.square(band_factor(distance)) + past_factor + np.square(relative)),
            imputed_um=float(imputed_um.max()),
            speed_unread_um=unread_um,
        )

    def level_um(self, state: ModelState, reference: ModelState, uncertainty_k: FloatArray) -> float:
        """Return by how much the thermal error may be wrong if levels are by so much [K], see `LeftOut.level_um`."""
        return self.left_out.level_um(uncertainty_k, excluded_sensors(state, reference))

    def _ids(self, indices: npt.NDArray[np.intp]) -> tuple[int, ...]:
        return tuple(self.model.sensor_ids[index] for index in indices)

    def reinitialised(self, state: ModelState, sensors: Sequence[int]) -> ModelState:
        """Return the state in which sensors (indices) that were missing are watched anew, where there is a watch."""
        if self._watcher is None or state.watch is None:
            return state
        watched = [sensor for sensor in sensors if sensor < self._watched_sensors]
        return replace(state, watch=self._watcher.reinitialised(state.watch, watched))


def widened(domain: Domain, temperatures: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return from where to where inputs may go [degC, mm], and how far since the reference the first, temperatures."""
    width = domain.highest - domain.lowest
    usual_k = 0.0 if domain.of_increments else float(np.median(width[: temperatures or None]))
    more = np.maximum(width, max(usual_k, DOMAIN_MARGIN_K))
    levels = (np.arange(len(width)) < temperatures) & (not domain.of_increments)
    beyond = np.where(levels, np.maximum(more, SEASON_K), more)
    return domain.lowest - beyond, domain.highest + beyond, np.where(levels, width + more, np.inf)


def excluded_sensors(state: ModelState, reference: ModelState) -> tuple[int, ...]:
    """Return the indices of the sensors that must not count.

    Blamed by the watch, missing now or at the reference, or lost for longer than is bridged since the
    reference, unless it was set anew in `reference` when it returned.
    """
    out = state.missing | reference.missing | (state.since_min > reference.known_min)
    if state.watch is not None:
        out[list(state.watch.excluded)] = True
    return tuple(int(index) for index in np.flatnonzero(out))


def fault_signs(model: LinearParameters, state: ModelState) -> dict[int, str]:
    """Return the sensors that the watch excludes, by ID, each with the sign by which it was found."""
    if state.watch is None:
        return {}
    return {model.sensor_ids[fault.sensor]: fault.sign for fault in reversed(state.watch.faults)}


def worth_um(estimator: LinearEstimator, state: ModelState, reference: ModelState, sensors: Iterable[int]) -> float:
    """Return what sensors (indices) that the watch has just found wrong were worth, of the worst channel [um].

    That is how far the estimate since the reference goes back without them or, where that is more because they were
    wrong at the reference already, what they made then of the distance from the middle of training.
    """
    counted, left_out = readmitted(state, tuple(sensors)), estimator.left_out
    before, after = estimator.estimate(counted, reference), estimator.estimate(state, reference)
    with_them = left_out.coefficients(excluded_sensors(counted, reference))
    without = left_out.coefficients(excluded_sensors(state, reference))
    then_um = (estimator.features(reference) - estimator.model.centre) @ (with_them - without)
    now_um = 0.0 if before is None or after is None else before.thermal_error_um - after.thermal_error_um
    return float(max(np.abs(then_um).max(), np.abs(now_um).max()))


def with_faults(model: LinearParameters, state: ModelState, signs: Mapping[int, str]) -> ModelState:
    """Return the state in which these sensors are excluded as well.

    `state`: as it was rebuilt from the history, which does not tell who was excluded. `signs`: IDs of sensors with the
    sign by which each was found, from `fault_signs`; IDs that the model does not have are passed over, and so are all
    of them for a model without a watch.
    """
    if state.watch is None:
        return state
    already = fault_signs(model, state)
    more = tuple(
        SensorFault(sensor=model.sensor_ids.index(sensor_id), time_min=state.time_min, sign=sign)
        for sensor_id, sign in signs.items()
        if sensor_id in model.sensor_ids and sensor_id not in already
    )
    return replace(state, watch=replace(state.watch, faults=(*state.watch.faults, *more)))


def readmitted(state: ModelState, sensors: Sequence[int]) -> ModelState:
    """Return the state in which some sensors (indices) are not faulty any more; then set a new reference."""
    if state.watch is None:
        return state
    kept = tuple(fault for fault in state.watch.faults if fault.sensor not in sensors)
    return replace(state, watch=replace(state.watch, faults=kept))


def _bridged(
    layout: Layout,
    state: ModelState,
    time_min: float,
    degc: FloatArray,
    own: npt.NDArray[np.bool_],
    lagged: FloatArray,
) -> FloatArray:
    """Return the lags, those of sensors that go on from their own past drawn through the gap."""
    bridged = lagged.copy()
    for sensor in np.flatnonzero(own):
        gap_min = time_min - float(state.known_min[sensor])
        for index, constant_min in enumerate(layout.lags_min):
            before, then, now = state.known_lagged[index, sensor], state.degc[sensor], degc[sensor]
            bridged[index, sensor] = lag_step(before, then, now, gap_min, constant_min)
    return bridged
