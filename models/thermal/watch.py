"""Watches temperature sensors: each is predicted from all others, and the one that departs is excluded.

Three signs, each with limits from training (`models.thermal.sensor_watch`): a slew no healthy sensor showed
(spike, step, open circuit), a value that does not change any more (stuck), and a departure from what the
other sensors say (step, drift, scale).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.features import BRIDGE_MIN, lag_step, speed_inputs
from models.thermal.sensor_watch import (
    FAST_MIN,
    FLAT_MIN,
    SAME_K,
    SLOW_MIN,
    SensorWatch,
    departure_maps,
    without_columns,
)
from models.thermal.start import LEAST_UNKNOWN

MOVED = 0.5
"""A sensor that stands still has moved when the others say so by more than this share of its limit, by more than they
were ever wrong about it in training, and by more than the step in which it counts."""
COARSE_K = 0.05
"""The mean over a minute of a sensor that counts in steps of so much is often twice the same [K]."""
USUAL_STEPS_K = np.array([1.0, 0.5, 0.25, 0.1, 0.0625, COARSE_K])
"""Steps in which sensors and what reads them count [K], from the largest."""
SIZES_K = np.stack([USUAL_STEPS_K, USUAL_STEPS_K / 1.8])[..., None]
"""The same in degC and in degF [K], shape (2, 6, 1)."""
WIDE_K = 0.25
"""Where no step is known, limits are wider for a sensor that began on a multiple of so much or more ..."""
ON_STEPS_MIN = 60.0
"""... and has stood on such ones since, over so long [min], ..."""
ON_STEPS_SHARE = 0.6
"""... for so much of the time: the others are means over a change from one to the next."""
ON_STEP = 1e-3
"""A value is a multiple of a step when it is so near to one, in steps; it may have come in single precision."""
STEPS_OF_LIMIT = 1.5
"""A sensor that counts in steps departs by so many of them from what others say, which are between two steps."""
CONFIRM_MIN = 10.0
"""A departure must last so long [min] before it is a fault."""
MOST_MAP_VALUES = 500_000
"""Predictions without excluded sensors are kept at hand up to about so many numbers."""
DEPARTURE = "departure"
"""Sign of a sensor that the others do not explain."""
MISSING = "missing"
"""Sign of a missing sensor: no fault of its values, so it counts again when it has a value."""
EXPLAINED = 0.75
"""An exclusion explains an alarm when the others then depart by no more than this share of their limits ..."""
EXPLAINED_SHARE = 0.3
"""... or of the departure before it."""
MOST_DEPARTURES = 2
"""When so many sensors are out because they departed, it is rather the machine that runs as it never did in training:
another one must depart ..."""
STRONG = 3.0
"""... by so many times its limit, and the others by hardly anything."""
MOST_SUSPECTS = 12
"""So many sensors, those that depart most, are tried as the one to exclude."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFault:
    """A sensor that was excluded, and why."""

    sensor: int
    """Index, from 0."""
    time_min: float
    sign: str
    """`slew`, `flat`, `departure` or `missing`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WatchState:
    """State of the watch from one sample to the next."""

    time_min: float
    degc: FloatArray
    """The latest value of each sensor [degC], the one before where it was missing."""
    known_min: FloatArray
    """When each sensor was last known [min]."""
    flat_since_min: FloatArray
    """Since when each sensor has had its value [min]."""
    speed: FloatArray
    """Inputs from spindle speed, shape (2,)."""
    lagged: FloatArray
    """Lags of temperatures, shape (n_lags, n_sensors)."""
    speed_lagged: FloatArray
    """Lags of the inputs from speed, shape (n_speed_lags, 2)."""
    fast: FloatArray
    """Scaled columns, smoothed, shape (d,)."""
    slow: FloatArray
    """The same over the long time."""
    over_min: FloatArray
    """For how long each sensor has departed [min], shape (n_sensors,)."""
    departed: FloatArray
    """How far each sensor departs from what the others say, over its limit, with sign, shape (n_sensors,)."""
    flat_from: FloatArray
    """The same when each sensor took the value that it has."""
    moved_since_min: FloatArray
    """Since when the others say that each sensor has left that value [min]; now where they do not."""
    heard: npt.NDArray[np.bool_]
    """Which sensors have ever had a value; before, one stands at its mean of training."""
    steps: "Steps"
    """In which steps the sensors count."""
    unknown: float
    """Share of the longest lag that nobody recorded, 0..1."""
    faults: tuple[SensorFault, ...] = field(default=())

    @property
    def excluded(self) -> tuple[int, ...]:
        """Indices of the excluded sensors, sorted."""
        return tuple(sorted({fault.sensor for fault in self.faults}))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Steps:
    """In which steps sensors count, as far as that is known, or as their values tell; training may have seen finer."""

    known_k: FloatArray
    """Step that is known of each sensor [K], shape (n_sensors,), else 0."""
    coarse: npt.NDArray[np.bool_]
    """Which sensors count in coarse steps: that is known, or a value that stood still has told."""
    share: FloatArray
    """Of the time for which each has stood on multiples of each usual step since it began there, shape (2, 6,
    n_sensors); 0 for good where that became too little."""
    limit_k: FloatArray
    """By which its limits are wider [K], shape (n_sensors,): the known one, or the largest that its values tell."""

    @classmethod
    def begun(cls, known_k: FloatArray, degc: FloatArray) -> "Steps":
        """Return what the first values tell."""
        share = _on_steps(degc).astype(np.float64)
        return cls(known_k=known_k, coarse=known_k >= COARSE_K, share=share, limit_k=known_k)._told(share)

    def after(self, degc: FloatArray, elapsed_min: float, told_k: FloatArray) -> "Steps":
        """Return what is known after a row, in which values that stood still told steps [K]."""
        on_steps = _on_steps(degc).astype(np.float64)
        share = on_steps + math.exp(-elapsed_min / ON_STEPS_MIN) * (self.share - on_steps)
        stands = (self.share > 0.0) & (share >= ON_STEPS_SHARE)
        told = self._told(np.asarray(np.where(stands, share, 0.0), dtype=np.float64))
        return replace(told, coarse=self.coarse | (told_k >= COARSE_K))

    def anew(self, degc: FloatArray, sensors: Sequence[int]) -> "Steps":
        """Return what is known where some sensors begin anew."""
        share = self.share.copy()
        share[..., sensors] = _on_steps(degc[sensors])
        return self._told(share)

    def _told(self, share: FloatArray) -> "Steps":
        told_k = np.max(SIZES_K * (share > 0.0) * (USUAL_STEPS_K >= WIDE_K)[:, None], axis=(0, 1))
        return replace(self, share=share, limit_k=np.where(self.known_k > 0.0, self.known_k, told_k))


def usual_step_k(degc: FloatArray) -> FloatArray:
    """Return the largest usual step of which each temperature is a multiple, in degC or degF [K]; else 0.

    `degc`, shape (n,): temperatures [degC].
    """
    return np.asarray(np.max(SIZES_K * _on_steps(degc), axis=(0, 1)))


def _on_steps(degc: FloatArray) -> npt.NDArray[np.bool_]:
    """Return of which usual steps each temperature is a multiple, in degC and in degF, shape (2, 6, n)."""
    steps = np.stack([degc, 1.8 * degc + 32.0])[:, None] / USUAL_STEPS_K[:, None]
    return np.asarray(np.abs(steps - np.round(steps)) <= ON_STEP)


def _expected(of_out: FloatArray, scaled: FloatArray, out: npt.NDArray[np.intp]) -> FloatArray:
    """Return what the other scaled columns let be expected of some columns, shape (len(out),); `of_out`: their rows."""
    others = scaled.copy()
    others[out] = 0.0
    return np.asarray(-np.linalg.solve(of_out[:, out], of_out @ others))


class Watcher:
    """Steps the state of a watch; keeps only what follows from the watch itself.

    `watch`: limits and predictions from training. `steps_k`: step in which each sensor counts [K], 0 where none is
    known, so that values tell it; empty: of none. Training may have seen finer values.
    """

    def __init__(self, watch: SensorWatch, steps_k: Sequence[float] = ()) -> None:
        self.watch = watch
        self._steps_k = np.array(steps_k) if len(steps_k) else np.zeros(watch.layout.sensors)
        self._maps: dict[tuple[bool, tuple[int, ...]], tuple[FloatArray, FloatArray]] = {}
        self._longest_min = max((*watch.layout.lags_min, *watch.layout.speed_lags_min))
        self._most_maps = max(2, MOST_MAP_VALUES // (watch.layout.sensors * watch.layout.columns))
        _, self._usual = self._map(())

    def reinitialised(self, state: WatchState, sensors: Sequence[int]) -> WatchState:
        """Return the state in which some sensors that were missing are watched anew, from what is expected of them.

        Their memory holds what they said before their silence, perhaps in another frame; from now on only what
        they do counts. That they were missing is held against them no longer; any other sign is.

        `state`: after the first sample that holds them again. `sensors`: their indices, from 0.
        """
        faults = tuple(b for b in state.faults if b.sensor not in sensors or b.sign != MISSING)
        still = {b.sensor for b in faults}
        anew = [sensor for sensor in sensors if sensor not in still]
        if not anew or len(anew) + len(still) == self.watch.layout.sensors:
            return replace(state, faults=faults)  # nobody is left to expect anything from: their own past goes on
        watch, out = self.watch, self.watch.layout.of_sensors(anew)
        of_out = without_columns(watch.precision, watch.layout.of_sensors(sorted(still)).tolist())(out)
        lagged = self._lags_as_expected(state, of_out, anew)
        columns = self._columns(state.degc, lagged, state.speed_lagged)
        fast, slow, over_min, flat_since = (
            np.array(values) for values in (state.fast, state.slow, state.over_min, state.flat_since_min)
        )
        fast[out] = columns[out] + _expected(of_out, fast - columns, out)
        slow[out] = fast[out] - _expected(of_out, fast - slow, out)
        over_min[anew], flat_since[anew] = 0.0, state.time_min
        state = replace(state, steps=state.steps.anew(state.degc, anew), faults=faults)
        return replace(state, lagged=lagged, fast=fast, slow=slow, over_min=over_min, flat_since_min=flat_since)

    def _lags_as_expected(self, state: WatchState, of_out: FloatArray, sensors: Sequence[int]) -> FloatArray:
        """Return the lags, those of some sensors as far behind them as all others let it be expected [degC]."""
        count, gain, centre = self.watch.layout.sensors, self.watch.gain, self.watch.centre
        out = self.watch.layout.of_sensors(sensors)
        scaled = self._columns(state.degc, state.lagged, state.speed_lagged)
        scaled[out] = _expected(of_out, scaled, out)
        expected = centre + np.divide(scaled, gain, out=np.zeros_like(scaled), where=gain > 0.0)
        lagged = state.lagged.copy()
        for index in range(len(lagged)):
            behind_k = expected[:count] - expected[count * (index + 1) : count * (index + 2)]
            lagged[index, sensors] = (state.degc - behind_k)[sensors]
        return lagged

    def _map(self, excluded: tuple[int, ...], lags: bool = True) -> tuple[FloatArray, FloatArray]:
        if (lags, excluded) not in self._maps:
            if len(self._maps) >= self._most_maps:
                self._maps.clear()
            layout, precision, gain = self.watch.layout, self.watch.precision, self.watch.gain
            self._maps[lags, excluded] = departure_maps(layout, precision, gain, excluded, lags=lags)
        return self._maps[lags, excluded]

    def begin(self, time_min: float, degc: FloatArray, speed_rpm: float, unknown: float = 0.0) -> WatchState:
        """Return the state at a first sample, a share of its lags unknown; without a value at training's mean."""
        watch, count = self.watch, self.watch.layout.sensors
        filled = np.where(np.isfinite(degc), degc, watch.centre[:count])
        speed = speed_inputs(np.array([np.nan_to_num(speed_rpm)]), watch.speed_scale_rpm)[0]
        lagged = np.tile(filled, (len(watch.layout.lags_min), 1))
        speed_lagged = np.tile(speed, (len(watch.layout.speed_lags_min), 1))
        columns = self._columns(filled, lagged, speed_lagged)
        return WatchState(
            time_min=time_min,
            degc=filled,
            known_min=np.full(count, time_min),
            flat_since_min=np.full(count, time_min),
            speed=speed,
            lagged=lagged,
            speed_lagged=speed_lagged,
            fast=columns,
            slow=columns.copy(),
            over_min=np.zeros(count),
            departed=np.zeros(count),
            flat_from=np.zeros(count),
            moved_since_min=np.full(count, time_min),
            heard=np.isfinite(degc),
            steps=Steps.begun(self._steps_k, filled),
            unknown=unknown,
        )

    def _columns(self, degc: FloatArray, lagged: FloatArray, speed_lagged: FloatArray) -> FloatArray:
        columns = np.concatenate([degc, lagged.ravel(), speed_lagged.ravel()])
        return np.asarray((columns - self.watch.centre) * self.watch.gain)

    def step(
        self, state: WatchState, time_min: float, degc: FloatArray, speed_rpm: float, *, find_faults: bool = True
    ) -> WatchState:
        """Return the state after a sample.

        Result: with what was found so far; an excluded sensor stays excluded. While no sensor has a value the watch
        waits, and then goes straight through the gap.

        `time_min`: its time [min], on the clock of the state. `degc`, shape (n_sensors,): temperatures [degC], NaN
        where missing. `speed_rpm`: spindle speed [1/min]; NaN repeats the last one. `find_faults`: whether sensors may
        be excluded; False while the watch only fills its memory.
        """
        elapsed_min = time_min - state.time_min
        if elapsed_min <= 0.0 or not np.isfinite(degc).any():
            return state
        if not state.heard.any():
            return self.begin(time_min, degc, speed_rpm, state.unknown)
        advanced = self._advance(state, time_min, elapsed_min, degc, speed_rpm)
        if len(first := np.flatnonzero(advanced.heard & ~state.heard)):
            advanced = self.reinitialised(advanced, first.tolist())
        if not find_faults:
            departed = self._departed(advanced, advanced.excluded)
            return replace(advanced, over_min=np.zeros_like(advanced.over_min), departed=departed, faults=state.faults)
        at_once = self._faults_at_once(state, advanced, degc)
        advanced = replace(advanced, faults=(*advanced.faults, *at_once))
        return self._find_departures(advanced, elapsed_min)

    def _advance(
        self, state: WatchState, time_min: float, elapsed_min: float, degc: FloatArray, speed_rpm: float
    ) -> WatchState:
        watch, known = self.watch, np.isfinite(degc)
        filled = np.where(known, degc, state.degc)
        speed = state.speed
        if np.isfinite(speed_rpm):
            speed = speed_inputs(np.array([speed_rpm]), watch.speed_scale_rpm)[0]
        lagged, speed_lagged = np.empty_like(state.lagged), np.empty_like(state.speed_lagged)
        for index, constant_min in enumerate(watch.layout.lags_min):
            lagged[index] = lag_step(state.lagged[index], state.degc, filled, elapsed_min, constant_min)
        for index, constant_min in enumerate(watch.layout.speed_lags_min):
            speed_lagged[index] = lag_step(state.speed_lagged[index], state.speed, speed, elapsed_min, constant_min)
        columns = self._columns(filled, lagged, speed_lagged)
        fast = columns + np.exp(-elapsed_min / FAST_MIN) * (state.fast - columns)
        moved = state.departed - state.flat_from
        same = (np.abs(filled - state.degc) <= SAME_K) & (elapsed_min <= BRIDGE_MIN)
        step_k, told = self._steps_k.copy(), same & (self._steps_k <= 0.0)
        step_k[told] = usual_step_k(filled[told])
        least = np.maximum(MOVED, step_k / self._limit_k(state))
        return WatchState(
            time_min=time_min,
            degc=filled,
            known_min=np.where(known, time_min, state.known_min),
            flat_since_min=np.where(same, state.flat_since_min, time_min),
            speed=speed,
            lagged=lagged,
            speed_lagged=speed_lagged,
            fast=fast,
            slow=fast + np.exp(-elapsed_min / SLOW_MIN) * (state.slow - fast),
            over_min=state.over_min,
            departed=state.departed,
            flat_from=np.where(same, state.flat_from, state.departed),
            moved_since_min=np.where(same & (np.abs(moved) > least), state.moved_since_min, time_min),
            heard=state.heard | known,
            steps=state.steps.after(filled, elapsed_min, step_k),
            unknown=state.unknown * math.exp(-elapsed_min / self._longest_min),
            faults=state.faults,
        )

    def _faults_at_once(self, before: WatchState, now: WatchState, degc: FloatArray) -> list[SensorFault]:
        watch, excluded = self.watch, set(now.excluded)
        slew = (np.abs(now.degc - before.degc) - before.steps.limit_k) / np.maximum(
            now.time_min - before.known_min, 1e-9
        )
        signs = {
            MISSING: now.time_min - now.known_min > max(BRIDGE_MIN, 2.5 * (now.time_min - before.time_min)),
            "slew": np.isfinite(degc) & before.heard & (slew > watch.slew_k_per_min),
            "flat": np.isfinite(degc) & self._stands(now),
        }
        found = []
        for sign, applies in signs.items():
            for sensor in np.flatnonzero(applies):
                if int(sensor) not in excluded:
                    excluded.add(int(sensor))
                    found.append(SensorFault(sensor=int(sensor), time_min=now.time_min, sign=sign))
        return found

    def _stands(self, state: WatchState) -> npt.NDArray[np.bool_]:
        """Return which sensors stand still for too long: they never did, or the others say that they have moved.

        A sensor that counts in steps keeps its value for as long as the machine hardly warms.
        """
        flat_min = np.where(state.steps.coarse, np.maximum(self.watch.flat_min, FLAT_MIN), self.watch.flat_min)
        must_move = (flat_min < FLAT_MIN) | (state.time_min - state.moved_since_min >= FLAT_MIN)
        return np.asarray((state.time_min - state.flat_since_min >= flat_min) & must_move)

    def relative_departures(self, state: WatchState, excluded: tuple[int, ...]) -> FloatArray:
        """Return each sensor's departure over its threshold, without some sensors, shape (n_sensors,)."""
        return np.abs(self._departed(state, excluded))

    def _departed(self, state: WatchState, excluded: tuple[int, ...], lags: bool = True) -> FloatArray:
        maps, expected = self._map(excluded, lags)
        widening = np.divide(expected, self._usual, out=np.ones_like(expected), where=self._usual > 0.0)
        limit_k = self._limit_k(state) * np.maximum(widening, 1.0)
        return np.asarray(maps @ (state.fast - state.slow) / limit_k)

    def _limit_k(self, state: WatchState) -> FloatArray:
        return np.maximum(self.watch.threshold_k, STEPS_OF_LIMIT * state.steps.limit_k)

    def _find_departures(self, state: WatchState, elapsed_min: float) -> WatchState:
        excluded = state.excluded
        state = replace(state, departed=self._departed(state, excluded))
        departures = np.abs(state.departed)
        over = departures > 1.0
        if over.any():  # what began far from its surroundings, and is by now as training knows it, is no fault
            whole = replace(state, slow=np.zeros_like(state.slow))  # by temperatures alone, where their past is unknown
            over &= np.abs(self._departed(whole, excluded, lags=state.unknown <= LEAST_UNKNOWN)) > 1.0
        over_min = np.where(over, state.over_min + min(elapsed_min, 0.5 * CONFIRM_MIN), 0.0)
        if not (over_min >= CONFIRM_MIN).any():
            return replace(state, over_min=over_min)
        culprits = self._culprits(state, excluded, departures)
        departed = sum(fault.sign == DEPARTURE for fault in state.faults)
        if departed + len(culprits) > MOST_DEPARTURES and not self._strong(state, excluded, departures, culprits):
            culprits = ()
        if not culprits:
            return replace(state, over_min=over_min)
        found = tuple(SensorFault(sensor=sensor, time_min=state.time_min, sign=DEPARTURE) for sensor in culprits)
        return replace(state, over_min=np.zeros_like(over_min), faults=(*state.faults, *found))

    def _culprits(self, state: WatchState, excluded: tuple[int, ...], departures: FloatArray) -> tuple[int, ...]:
        """Return the one or two sensors without which the others agree; none where the machine itself is unusual."""
        first, rest = self._best_without(state, excluded, departures)
        least = max(EXPLAINED, EXPLAINED_SHARE * float(departures.max()))
        if rest <= least:
            return (first,)
        without_first = tuple(sorted({*excluded, first}))
        remaining = self.relative_departures(state, without_first)
        if not (remaining > 0.0).any():
            return (first,)
        second, rest = self._best_without(state, without_first, remaining)
        return (first, second) if rest <= least else ()

    def _strong(
        self, state: WatchState, excluded: tuple[int, ...], departures: FloatArray, culprits: tuple[int, ...]
    ) -> bool:
        """Whether some sensors depart so far, and the others so little without them, that no machine does that."""
        rest = self.relative_departures(state, tuple(sorted({*excluded, *culprits}))).max() if culprits else np.inf
        largest = float(departures.max())
        return largest >= STRONG and bool(rest <= EXPLAINED_SHARE * largest)

    def _best_without(self, state: WatchState, excluded: tuple[int, ...], departures: FloatArray) -> tuple[int, float]:
        """Return the sensor whose exclusion leaves the smallest rest, and that rest over its threshold."""
        suspects = [int(s) for s in np.argsort(departures)[::-1][:MOST_SUSPECTS] if departures[s] > 0.0]
        rests = [float(self.relative_departures(state, tuple(sorted({*excluded, s}))).max()) for s in suspects]
        best = int(np.argmin(rests))
        return suspects[best], rests[best]
