"""Runs a model with lags sample by sample: what it remembers is an explicit record that can be stored.

`LaggedEstimator.rebuild` makes a `LagState` of a history, `advance` takes every further sample into
it, the state at the instant of a reference is kept as the reference, and `estimate` gives the
thermal error from the state now and the state at the reference.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.domain import band_factor, leverage
from models.thermal.estimate import DOMAIN_MARGIN_K, DOMAIN_WIDENING, Estimation
from models.thermal.lag_imputation import imputed_features, started_lags
from models.thermal.lagged_model import LaggedModel
from models.thermal.lags import lag_step, speed_inputs
from models.thermal.layout import BRIDGE_MIN
from models.thermal.watch import Watcher, WatchState

SETTLED_LAGS = 4.0
"""So many times the longest lag of history fill the states."""
SPEED_MARGIN = 1.05
"""Spindle speed may exceed that of training by this factor."""
FADED_DISTANCE = 2.0
"""At this many times the largest distance of training (the root of leverage), confidence is zero."""
MOST_EXCLUSIONS_KEPT = 64
"""So many sets of excluded sensors keep their coefficients at hand."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LagState:
    """What a model with lags remembers from one sample to the next."""

    time_min: float
    """Time of the latest sample [min], on the caller's clock."""
    degc: FloatArray
    """Latest known temperatures [degC], shape (n_sensors,)."""
    missing: npt.NDArray[np.bool_]
    """Which of them the latest sample did not hold."""
    known_min: FloatArray
    """When each sensor was last known [min], shape (n_sensors,)."""
    since_min: FloatArray
    """Since when each sensor has been known without a longer gap [min], shape (n_sensors,)."""
    filled_min: FloatArray
    """Since when the lags of each sensor have been filled, by itself or from the others [min], shape (n_sensors,)."""
    speed_rpm: float
    """Latest known spindle speed [1/min]."""
    speed_known_min: float
    speed_since_min: float
    """Since when spindle speed has been known without a longer gap [min]."""
    lagged: FloatArray
    """Lags of temperatures [degC], shape (n_lags, n_sensors)."""
    speed_lagged: FloatArray
    """Lags of the inputs from speed, shape (n_speed_lags, 2)."""
    watch: WatchState | None
    """Memory of the watch of the sensors; None when the model carries none."""


class LaggedEstimator:
    """A model with lags, prepared once; every method is pure in the state.

    Parameters
    ----------
    model
        The model.

    """

    def __init__(self, model: LaggedModel) -> None:
        self.model = model
        self._watcher = None if model.watch is None else Watcher(model.watch)
        self._coefficients: dict[tuple[int, ...], FloatArray] = {}
        widening_k = np.maximum(DOMAIN_WIDENING * (model.highest_degc - model.lowest_degc), DOMAIN_MARGIN_K)
        self._lowest_degc = model.lowest_degc - widening_k
        self._highest_degc = model.highest_degc + widening_k
        self._bridge_min = max(BRIDGE_MIN, 2.5 * model.period_min)
        constants = (*model.layout.lags_min, *model.layout.speed_lags_min)
        self.history_min = SETTLED_LAGS * max(constants, default=0.0)
        """So much history the states need [min]."""

    def begin(self, time_min: float, degc: FloatArray, speed_rpm: float = float("nan")) -> LagState:
        """Return the state at a first sample, as if it had lasted for ever; nothing is settled yet.

        Parameters
        ----------
        time_min
            Its time [min].
        degc : shape (n_sensors,)
            Temperatures in the model's sensor order [degC], filtered as in training (means over
            `model.period_min`), NaN where missing.
        speed_rpm
            Spindle speed [1/min], NaN where unknown.

        Raises
        ------
        ValueError
            When the shape does not fit the model or the time is not finite.

        """
        self._require(time_min, degc)
        model = self.model
        known = np.isfinite(degc)
        filled = np.where(known, degc, model.centre[: model.layout.sensors])
        speed = speed_rpm if np.isfinite(speed_rpm) else 0.0
        inputs = speed_inputs(np.array([speed]), model.speed_scale_rpm)[0]
        return LagState(
            time_min=time_min,
            degc=filled,
            missing=~known,
            known_min=np.where(known, time_min, -np.inf),
            since_min=np.full(len(degc), time_min),
            filled_min=np.full(len(degc), time_min),
            speed_rpm=speed,
            speed_known_min=time_min if np.isfinite(speed_rpm) else -np.inf,
            speed_since_min=time_min,
            lagged=np.tile(filled, (len(model.layout.lags_min), 1)),
            speed_lagged=np.tile(inputs, (len(model.layout.speed_lags_min), 1)),
            watch=None if self._watcher is None else self._watcher.begin(time_min, degc, speed_rpm),
        )

    def _require(self, time_min: float, degc: FloatArray) -> None:
        if degc.shape != (self.model.layout.sensors,):
            raise ValueError(
                f"model {self.model.model_id} needs {self.model.layout.sensors} temperatures, got {degc.shape}"
            )
        if not np.isfinite(time_min):
            raise ValueError(f"time_min must be finite, got {time_min}")

    def advance(
        self, state: LagState, time_min: float, degc: FloatArray, speed_rpm: float = float("nan"), *, blame: bool = True
    ) -> LagState:
        """Return the state after a sample.

        Gaps up to `BRIDGE_MIN` are bridged by a straight line. After a longer one the lags of a sensor begin where
        the other sensors let them be expected; those of spindle speed, and those of sensors that were silent all
        together, are settled again only after `history_min`.

        Parameters
        ----------
        state
            Before it.
        time_min, degc, speed_rpm
            See `begin`. A time that does not lie after the state's changes nothing.
        blame
            Whether the watch may exclude sensors; False while history is replayed.

        """
        self._require(time_min, degc)
        elapsed_min = time_min - state.time_min
        if elapsed_min <= 0.0:
            return state
        known = np.isfinite(degc)
        filled = np.where(known, degc, state.degc)
        returned = known & (time_min - state.known_min > self._bridge_min)
        speed_known = bool(np.isfinite(speed_rpm))
        speed = float(speed_rpm) if speed_known else state.speed_rpm
        anew = speed_known and time_min - state.speed_known_min > self._bridge_min
        lagged, speed_lagged = self._lags(state, elapsed_min, filled, speed)
        advanced = LagState(
            time_min=time_min,
            degc=filled,
            missing=~known,
            known_min=np.where(known, time_min, state.known_min),
            since_min=np.where(returned, time_min, state.since_min),
            filled_min=state.filled_min,
            speed_rpm=speed,
            speed_known_min=time_min if speed_known else state.speed_known_min,
            speed_since_min=time_min if anew else state.speed_since_min,
            lagged=lagged,
            speed_lagged=speed_lagged,
            watch=self._watched(state.watch, time_min, degc, speed_rpm, blame),
        )
        return self.begun(advanced, np.flatnonzero(returned).tolist()) if returned.any() else advanced

    def begun(self, state: LagState, sensors: Sequence[int]) -> LagState:
        """Return the state in which the lags of sensors (indices) that speak again begin where the others expect them.

        They are filled from then on as those of the others are.
        """
        returned = np.zeros(self.model.layout.sensors, dtype=np.bool_)
        returned[list(sensors)] = True
        without = state.missing | returned
        if state.watch is not None:
            without[list(state.watch.excluded)] = True
        alone = bool(without.all())
        filled_min = state.time_min if alone else float(np.max(state.filled_min[~without]))
        return replace(
            state,
            lagged=started_lags(self.model, self.features(state), returned, np.flatnonzero(without).tolist()),
            filled_min=np.where(returned, filled_min, state.filled_min),
        )

    def _lags(
        self, state: LagState, elapsed_min: float, degc: FloatArray, speed_rpm: float
    ) -> tuple[FloatArray, FloatArray]:
        layout, scale_rpm = self.model.layout, self.model.speed_scale_rpm
        before, now = speed_inputs(np.array([state.speed_rpm, speed_rpm]), scale_rpm)
        lagged = [
            lag_step(state.lagged[index], state.degc, degc, elapsed_min, constant_min)
            for index, constant_min in enumerate(layout.lags_min)
        ]
        speed_lagged = [
            lag_step(state.speed_lagged[index], before, now, elapsed_min, constant_min)
            for index, constant_min in enumerate(layout.speed_lags_min)
        ]
        return (
            np.array(lagged).reshape(len(layout.lags_min), layout.sensors),
            np.array(speed_lagged).reshape(len(layout.speed_lags_min), 2),
        )

    def _watched(
        self, watch: WatchState | None, time_min: float, degc: FloatArray, speed_rpm: float, blame: bool
    ) -> WatchState | None:
        """Return the watch's state: it looks as often as in training, because its limits on slew are from there."""
        if self._watcher is None or watch is None or time_min - watch.time_min < 0.999 * self.model.period_min:
            return watch
        return self._watcher.step(watch, time_min, degc, speed_rpm, blame=blame)

    def rebuild(self, samples: Iterable[tuple[float, FloatArray, float]]) -> LagState | None:
        """Return the state after a history of (time [min], temperatures [degC], speed [1/min]); None when empty."""
        state = None
        for time_min, degc, speed_rpm in samples:
            if state is None:
                state = self.begin(time_min, degc, speed_rpm)
            else:
                state = self.advance(state, time_min, degc, speed_rpm, blame=False)
        return state

    def settled(self, state: LagState) -> float:
        """Return how far the states are filled, 0..1; below 1 the estimate must not be enabled."""
        if self.history_min <= 0.0:
            return 1.0
        since = state.filled_min[np.isfinite(state.known_min)]
        oldest_min = float(np.max(since)) if len(since) else state.time_min
        if self.model.layout.speed_lags_min:
            if state.time_min - state.speed_known_min > self._bridge_min:
                return 0.0
            oldest_min = max(oldest_min, state.speed_since_min)
        return float(np.clip((state.time_min - oldest_min) / self.history_min, 0.0, 1.0))

    def excluded(self, state: LagState, reference: LagState) -> tuple[int, ...]:
        """Return the indices of the sensors that must not count.

        Blamed by the watch, missing now or at the reference, or lost for longer than is bridged since the
        reference, unless it was set anew in `reference` when it returned.
        """
        out = state.missing | reference.missing | (state.since_min > reference.known_min)
        if state.watch is not None:
            out[list(state.watch.excluded)] = True
        return tuple(int(index) for index in np.flatnonzero(out))

    def features(self, state: LagState) -> FloatArray:
        """Return temperatures, their lags and lagged speed of a state, shape (layout.columns,)."""
        return np.concatenate([state.degc, state.lagged.ravel(), state.speed_lagged.ravel()])

    def estimate(self, state: LagState, reference: LagState) -> Estimation | None:
        """Return the thermal error since the reference.

        Sensors that must not count are left out of the model over the whole interval since the
        reference, by block elimination, so that nothing of their wrong values stays behind.

        Returns
        -------
        Estimation or None
            `confidence` is the product of how far the states are filled, of the share of usable
            sensors and of the distance from training; None without any usable sensor.

        """
        excluded = self.excluded(state, reference)
        sensors = self.model.layout.sensors
        if len(excluded) == sensors:
            return None
        now = self.features(state)
        error_um = (now - self.features(reference)) @ self._without(excluded)
        counted = np.ones(sensors, dtype=np.bool_)
        counted[list(excluded)] = False
        increment_k = state.degc - reference.degc
        outside = counted & ((state.degc < self._lowest_degc) | (state.degc > self._highest_degc))
        distance = self._distance(now - self.features(reference), excluded)
        slow_enough = state.speed_rpm <= SPEED_MARGIN * self.model.highest_speed_rpm or not self.model.highest_speed_rpm
        near = float(np.clip((FADED_DISTANCE - distance) / (FADED_DISTANCE - 1.0), 0.0, 1.0))
        settled = min(self.settled(state), self.settled(reference))
        return Estimation(
            thermal_error_um=error_um,
            confidence=settled * near * (1.0 - len(excluded) / sensors),
            in_domain=not outside.any() and distance <= 1.0 and slow_enough,
            imputed=self._ids(np.flatnonzero(~counted)),
            outside=self._ids(np.flatnonzero(outside)),
            increment_k=np.where(counted, increment_k, increment_k[counted].mean()),
            band_factor=float(band_factor(distance)),
        )

    def _ids(self, indices: npt.NDArray[np.intp]) -> tuple[int, ...]:
        return tuple(self.model.sensor_ids[index] for index in indices)

    def _without(self, excluded: tuple[int, ...]) -> FloatArray:
        if excluded not in self._coefficients:
            if len(self._coefficients) >= MOST_EXCLUSIONS_KEPT:
                self._coefficients.clear()
            self._coefficients[excluded] = self.model.coefficients(excluded)
        return self._coefficients[excluded]

    def _distance(self, change: FloatArray, excluded: tuple[int, ...]) -> float:
        """Return how far the features have gone since the reference, 1 at the farthest that training went."""
        known = imputed_features(self.model, change, excluded)
        return float(np.sqrt(leverage(self.model.ridges, known[None])[0] / self.model.leverage_limit))

    def reinitialised(self, state: LagState, sensors: Sequence[int]) -> LagState:
        """Return the state in which sensors (indices) that were silent are watched anew, and blamed for it no longer.

        See `Watcher.welcomed`; a model without a watch blames nobody.
        """
        if self._watcher is None or state.watch is None:
            return state
        return replace(state, watch=self._watcher.reinitialised(state.watch, sensors))

    def readmit(self, state: LagState, sensors: tuple[int, ...]) -> LagState:
        """Return the state in which some sensors (indices) are not blamed any more; then set a new reference."""
        if state.watch is None:
            return state
        kept = tuple(blame for blame in state.watch.blamed if blame.sensor not in sensors)
        return replace(state, watch=replace(state.watch, blamed=kept))
