"""Temperatures of the whole machine from the cycles of its lines: cleansed, and their means over a window."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from config.schema import Configuration
from drivers.clock import Clock
from models.align import RollingMean
from models.cleanse import CleansingRules, CleansingState, IndexArray, age_s, cleanse_cycle, initial_state
from models.quality import Quality, Reason
from models.records import FloatArray, MachineTemperatures, TemperatureCycle
from models.sensor_levels import BelievedValues, first_levels, renewed_levels, trusted_anew, with_past


class Cleansing:
    """What is known of every sensor; owned by the thermal task."""

    def __init__(self, configuration: Configuration, clock: Clock) -> None:
        temperatures = configuration.temperatures
        self._clock = clock
        position = {sensor_id: index for index, sensor_id in enumerate(temperatures.sensor_ids)}
        self._lines = {
            each.name: (np.array([position[i] for i in each.sensor_ids]), each.cycle_period_s)
            for each in temperatures.inputs
        }
        self._rules = CleansingRules(**temperatures.cleansing.model_dump())
        self._state: CleansingState = initial_state(len(position))
        self._mean = RollingMean(configuration.compensation.reference.mean_s)
        self.least = configuration.compensation.output.min_confidence
        """With less confidence the output holds."""
        names = sorted(set(temperatures.components))
        self._group = np.array([names.index(each) for each in temperatures.components], dtype=np.intp)
        self._usable_at_s = np.full(len(position), -np.inf)
        self._silent = np.ones(len(position), dtype=np.bool_)
        self.levels = first_levels(len(position))
        """What every sensor's level counts as; the means hold it, the latest temperatures do not."""
        self._measured = np.full(len(position), np.nan)
        self._quality = np.full(len(position), Quality.MISSING, dtype=np.uint8)
        self._reason = np.full(len(position), Reason.NOT_RECEIVED, dtype=np.uint8)
        self.latest: MachineTemperatures | None = None
        """After the latest cycle of any line."""

    @property
    def stale_after_s(self) -> float:
        """A sensor without a value for longer has none [s]."""
        return self._rules.stale_after_s

    @property
    def window_s(self) -> float:
        """Time over which means are taken [s]."""
        return self._mean.window_s

    def mean_degc(self) -> FloatArray:
        """Return the mean of each sensor over the window [degC], in the machine's order, NaN where there is none."""
        return self._mean.mean()

    def recall(self, degc: FloatArray, at_s: FloatArray) -> None:
        """Hold the first temperatures against what was accepted last [degC], at which times [s]; NaN where nothing."""
        self._state = initial_state(len(degc), degc, at_s)
        self.levels = with_past(self.levels, degc, at_s)

    def trust_anew(self) -> None:
        """Take every sensor's level as it is: a new reference counts from it."""
        self.levels = trusted_anew(self.levels)

    def on_cycle(self, cycle: TemperatureCycle) -> MachineTemperatures:
        """Take a cycle of one line; return the temperatures of the machine after it."""
        indices, period_s = self._lines[cycle.line]
        now_s = cycle.trace.first_byte.monotonic_s
        result = cleanse_cycle(
            self._rules, self._state, indices, cycle.degc, cycle.quality, cycle.reason, now_s, period_s
        )
        before_degc, self._state = self._state.accepted_degc[indices], result.state
        self._measured[indices] = cycle.degc
        degc = self.latest.degc.copy() if self.latest is not None else np.full(len(self._measured), np.nan)
        degc[indices] = result.degc
        self._quality[indices] = result.quality
        self._reason[indices] = result.reason
        ages_s = age_s(self._state, now_s)
        stale = ages_s > self._rules.stale_after_s
        degc[stale] = np.nan
        unsaid = stale & (self._quality != Quality.MISSING)
        self._quality[unsaid], self._reason[unsaid] = Quality.MISSING, Reason.STALE
        usable = (cycle.quality == Quality.GOOD) & np.isfinite(cycle.degc)
        returned = result.returned & self._after_silence(indices, usable, now_s)
        jumped = result.new_level & ~returned & np.isfinite(before_degc)
        self._silent[indices[result.quality == Quality.GOOD]] = False
        seen = BelievedValues(
            now_s=now_s,
            indices=indices,
            degc=np.where(result.quality == Quality.GOOD, result.degc, np.nan),
            returned=returned,
            new_level=result.new_level | ~np.isfinite(before_degc),
            jump_k=np.where(jumped, result.degc - before_degc, 0.0),
            stale=stale,
            at_s=self._state.accepted_at_s,
        )
        self.levels = renewed_levels(self.levels, self._group, seen)
        self._mean.add(now_s, degc - self.levels.shift_k)
        self.latest = MachineTemperatures(
            line=cycle.line,
            measured_degc=self._measured.copy(),
            degc=degc,
            quality=self._quality.copy(),
            reason=self._reason.copy(),
            age_s=ages_s,
            trace=replace(cycle.trace, cleansed=self._clock.now()),
        )
        return self.latest

    def _after_silence(self, indices: IndexArray, usable: npt.NDArray[np.bool_], now_s: float) -> npt.NDArray[np.bool_]:
        """Return which sensors of a line have had no value for too long since one last counted."""
        self._silent[indices] |= usable & (now_s - self._usable_at_s[indices] > self._rules.stale_after_s)
        self._usable_at_s[indices[usable]] = now_s
        return self._silent[indices].copy()
