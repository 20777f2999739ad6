"""Temperatures of the whole machine from the cycles of its lines: cleansed, and their means over a window."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from config.schema import Configuration
from daemon.estimation.memory_watch import MemoryWatch, UnitWatch
from drivers.clock import Clock
from models.align import RollingMean
from models.cleanse import (
    HELD_PERIODS,
    CleansingResult,
    CleansingRules,
    CleansingState,
    IndexArray,
    age_s,
    cleanse_cycle,
    initial_state,
    rules_of_period,
    widened,
)
from models.quality import GOOD, Quality, Reason
from models.records import CodeArray, FloatArray, MachineTemperatures, Reference, TemperatureCycle
from models.sensor_levels import (
    MOMENT_S,
    UNKNOWN_K,
    BelievedValues,
    SensorLevels,
    counted_again,
    doubted,
    first_levels,
    gone_on,
    jumped_k,
    renewed_levels,
    trusted,
    trusted_anew,
    undone,
    with_gap,
    with_past,
)
from models.sensor_noise import SensorNoise

AtOnce = Callable[[FloatArray], npt.NDArray[np.bool_]]
NAMED = 3
"""So many sensors are named in one sentence."""
LATEST = 3
"""So many references before the newest may be asked for again: those between were refused."""


class FastInputs:
    """What sensors of inputs that are read more often than every ten seconds counted as a moment ago.

    From one cycle to the next they change by less than the noise, however fast they go: what one cycle in ten seconds
    would show as a jump is one.
    """

    def __init__(self) -> None:
        self._then: dict[str, tuple[float, FloatArray]] = {}

    def jumps(
        self,
        line: str,
        period_s: float,
        now_s: float,
        result: CleansingResult,
        before_degc: FloatArray,
        at_once: AtOnce,
    ) -> tuple[npt.NDArray[np.bool_], FloatArray]:
        """Return which values of a cycle have jumped, and from where [degC].

        `before_degc`: what counted last. `at_once`: which values lie too far from others for a jump to be none.
        """
        good = result.quality == GOOD
        far = good & ~result.straight & at_once(before_degc)
        if period_s >= MOMENT_S:
            return far, before_degc
        then_s, then_degc = self._then.get(line, (-np.inf, before_degc))
        if now_s - then_s > MOMENT_S + period_s:
            then_s, then_degc = -np.inf, before_degc
        fast = good & at_once(then_degc)
        far |= fast
        ends = now_s - then_s >= MOMENT_S - period_s / 2
        counts_degc = np.where(good, result.degc, np.nan)
        anew = far | ~np.isfinite(then_degc)
        self._then[line] = (now_s, counts_degc) if ends else (then_s, np.where(anew, counts_degc, then_degc))
        return far, np.where(fast, then_degc, before_degc)


class Cleansing:
    """What is known of every sensor; owned by the thermal task."""

    def __init__(self, configuration: Configuration, clock: Clock) -> None:
        temperatures, self._clock = configuration.temperatures, clock
        position = {sensor_id: index for index, sensor_id in enumerate(temperatures.sensor_ids)}
        self._lines = {
            each.name: (np.array([position[i] for i in each.sensor_ids]), each.cycle_period_s)
            for each in temperatures.inputs
        }
        of_inputs = {name: places for name, (places, _) in self._lines.items()}
        self.units, self.memory = UnitWatch(temperatures, of_inputs), MemoryWatch(of_inputs, clock)
        self._fast, self._sensor_ids = FastInputs(), temperatures.sensor_ids
        self._step_k = np.array([temperatures.steps_k[each] for each in self._sensor_ids])
        self._period_s = np.zeros(len(position))
        for indices, period_s in self._lines.values():
            self._period_s[indices] = period_s
        self._rules = CleansingRules(**temperatures.cleansing.model_dump())
        self._rules_of = {each.name: rules_of_period(self._rules, each.cycle_period_s) for each in temperatures.inputs}
        self._stale_s = np.maximum(self._rules.stale_after_s, HELD_PERIODS * self._period_s)
        self._state: CleansingState = initial_state(len(position))
        self._noise = SensorNoise(len(position))
        self._mean = RollingMean(configuration.compensation.reference.mean_s)
        self.due_s = max(self._mean.window_s, HELD_PERIODS * temperatures.shortest_period_s)
        self.least = configuration.compensation.output.min_confidence
        self.full = configuration.compensation.output.full_confidence
        """With less confidence the output holds."""
        _, self._group = np.unique(temperatures.components, return_inverse=True)
        self._usable_at_s = np.full(len(position), -np.inf)
        self._silent = np.ones(len(position), dtype=np.bool_)
        self.levels = first_levels(len(position))
        """What every sensor's level counts as; the means hold it, the latest temperatures do not."""
        self._lasting_k: dict[str, FloatArray] = {}
        """Of the levels at the latest references [K]."""
        self._jumped_at_s = np.full(len(position), -np.inf)
        self.jumped_k: FloatArray | None = None
        """By how much sensors have jumped with the latest cycle [K], None where none has."""
        self.gap_ended = False
        """With the latest cycle an input goes on that had stood, or a sensor is itself again: its past has a gap."""
        self._measured = np.full(len(position), np.nan)
        self._quality = np.full(len(position), Quality.MISSING, dtype=np.uint8)
        self._reason = np.full(len(position), Reason.NOT_RECEIVED, dtype=np.uint8)
        self.latest: MachineTemperatures | None = None
        """After the latest cycle of any line."""

    @property
    def stale_after_s(self) -> float:
        """A sensor without a value for longer has none [s], of the input that is read most rarely."""
        return float(self._stale_s.max())

    @property
    def window_s(self) -> float:
        """Time over which means are taken [s]."""
        return self._mean.window_s

    def mean_degc(self) -> FloatArray:
        """Return the mean of each sensor over the window [degC], in the machine's order, NaN where there is none."""
        return self._mean.mean()

    def counted_degc(self, absent: npt.NDArray[np.bool_], reference: Reference | None) -> FloatArray:
        """Return the means [degC] without sensors whose level is doubted or mixed and that the reference does not hold.

        They were `absent` until now; what they would count from, once set anew, would be that level, also when they
        leave it again.
        """
        if reference is None or not absent.any():
            return self.mean_degc()
        now_s = -np.inf if self.latest is None else self.latest.trace.first_byte.monotonic_s
        at_doubted = (self.levels.uncertainty_k != 0.0) & (self.levels.shift_k == 0.0)
        unsure = at_doubted | (now_s - self._jumped_at_s <= self.window_s)
        return np.where(absent & unsure & np.isnan(reference.degc), np.nan, self.mean_degc())

    def withheld(self, degc: FloatArray, share: float, wrong: Collection[int]) -> str:
        """Return why what is left without sensors that nobody believes is not followed, '' when it counts whole.

        `degc`: what `counted_degc` gave. `share`: what is left of the confidence in the estimate from it. `wrong`: IDs
        of sensors that the model found wrong: right again or not, they do not count until the work is positioned, and
        the estimate would count by halves until then.
        """
        if self.latest is not None and (why := self.stands(self.latest.trace.first_byte.monotonic_s)):
            return why
        if why := self.memory.at_reference():
            return why
        if share >= self.full:
            return ""
        doubtful = np.isnan(degc) & np.isfinite(self.mean_degc()) & (self.levels.uncertainty_k != 0.0)
        out = np.flatnonzero(doubtful | np.isin(self._sensor_ids, [*wrong]))
        named = ", ".join(f"sensor {self._sensor_ids[i]}" for i in out[:NAMED])
        if not len(out):
            return ""
        return f"too much rests on {named}, found wrong or back at a level that is doubted: position the work again"

    def stands(self, now_s: float) -> str:
        """Return which line or source seems to answer from memory or in another unit, '' when none does."""
        return self.units.why() or self.memory.why(now_s)

    def refusal(self, usable: int, now_s: float) -> str:
        """Return why the means of now are no reference, '' when they are; `usable`: how many sensors have one."""
        if why := self.stands(now_s):
            return why
        if usable == 0:
            return f"no temperature has arrived in the last {self.due_s:.0f} s"
        silent_s = np.where(np.isfinite(self.mean_degc()), now_s - self._usable_at_s, 0.0)
        silent_s[silent_s <= np.maximum(self.window_s / 2, HELD_PERIODS * self._period_s)] = 0.0
        if silent_s.any():
            longest = int(silent_s.argmax())
            return (
                f"sensor {self._sensor_ids[longest]} has been silent for {silent_s[longest]:.0f} s, and its mean holds "
                "what it had before: position again when it is back, or is left out, "
                f"{self._stale_s[longest]:.0f} s after its last value"
            )
        mixed = np.flatnonzero(now_s - self._jumped_at_s <= self.window_s)[:NAMED]
        if not len(mixed):
            return ""
        named = ", ".join(f"sensor {self._sensor_ids[i]}" for i in mixed)
        return f"the level of {named} has changed within the last {self.window_s:.0f} s: position again in a minute"

    def held_s(self, degc: FloatArray, now_s: float, imputed: Collection[int]) -> float:
        """Return the age of the oldest value that counts although its sensor has missed cycles [s]; 0 without one.

        `degc`: the means, NaN where a sensor has none. `imputed`: IDs of sensors that do not count.
        """
        ages_s = age_s(self._state, now_s)
        held = np.isfinite(degc) & (ages_s > HELD_PERIODS * self._period_s)
        if not held.any():
            return 0.0
        held &= ~np.isin(self._sensor_ids, [*imputed])
        return float(ages_s[held].max(initial=0.0))

    def believed(self, now: MachineTemperatures, wrong: Collection[int]) -> MachineTemperatures:
        """Return the temperatures with what is believed of them; `wrong`: IDs of sensors that were found wrong."""
        doubts = dict.fromkeys(np.flatnonzero(doubted(self.levels)).tolist(), "is at a level that is doubted")
        found = np.isin(self._sensor_ids, [*wrong]) | (np.abs(self.levels.lasting_k) > UNKNOWN_K / 2)
        doubts |= dict.fromkeys(np.flatnonzero(found).tolist(), "was found wrong")
        standing = self.memory.standing(now.trace.first_byte.monotonic_s)
        doubts |= dict.fromkeys(standing, "may be answered from memory")
        degc = np.where(now.age_s > HELD_PERIODS * self._period_s, np.nan, now.degc - self.levels.shift_k)
        degc[[*doubts]] = np.nan
        said = {place: f"sensor {self._sensor_ids[place]} {why}" for place, why in doubts.items()}
        return replace(now, believed_degc=degc, doubted=said)

    def recall(self, degc: FloatArray, at_s: FloatArray, read: Iterable[tuple[float, FloatArray]] = ()) -> None:
        """Hold the first temperatures against what was accepted last [degC], at which times [s]; NaN where nothing.

        `read`: times [s] and readings [degC] of the minutes until then, which tell how far sensors scatter.
        """
        for time_s, told_degc in read:
            self._noise.wider(np.arange(len(degc)), told_degc, time_s)
        self._state = initial_state(len(degc), degc, at_s)
        self.levels = with_past(self.levels, degc, at_s)
        self.units.recall_past(degc)

    def trust_anew(self, reference_id: str, wrong: Collection[int]) -> None:
        """Take every sensor's level as it is: a new reference counts from it; `wrong`: IDs of those found wrong."""
        self.memory.positioned(self._clock.now().monotonic_s, anew=True)
        self.levels = trusted_anew(self.levels, np.isin(self._sensor_ids, [*wrong]))
        self._lasting_k = dict([*self._lasting_k.items()][-LATEST:]) | {reference_id: self.levels.lasting_k}

    def count_again_from(self, reference_id: str, at_s: float) -> None:
        """Doubt what was doubted since a reference: those after it were refused, or the previous run had set it."""
        self.memory.positioned(at_s, anew=False)
        if (lasting_k := self._lasting_k.get(reference_id)) is not None:
            self.levels = counted_again(self.levels, lasting_k)
        self._lasting_k = {reference_id: self.levels.lasting_k}

    def trust_temperatures(self) -> None:
        """Take the temperatures as they are at the reference: a person says that they are right."""
        self._lasting_k = {each: before_k - self.levels.lasting_k for each, before_k in self._lasting_k.items()}
        self.levels = trusted(self.levels)

    def on_cycle(self, cycle: TemperatureCycle) -> MachineTemperatures:
        """Take a cycle of one line; return the temperatures of the machine after it."""
        indices, period_s = self._lines[cycle.line]
        now_s = cycle.trace.first_byte.monotonic_s
        read = np.where(cycle.quality == Quality.GOOD, cycle.degc, np.nan)
        latest_degc = self.memory.take(cycle.line, read, now_s)
        quality, reason = cycle.quality, cycle.reason
        if self.units.says_other(cycle.line, latest_degc):
            told = quality == Quality.GOOD
            quality = np.where(told, np.uint8(Quality.MISSING), quality)
            reason = np.where(told, np.uint8(Reason.OTHER_UNIT), reason)
        told_degc = np.where(quality == Quality.GOOD, cycle.degc, np.nan)
        rules = widened(self._rules_of[cycle.line], self._noise.wider(indices, told_degc, now_s))
        result = cleanse_cycle(rules, self._state, indices, cycle.degc, quality, reason, now_s, period_s)
        before_degc, self._state = self._state.accepted_degc[indices], result.state
        self._measured[indices] = cycle.degc
        degc = self.latest.degc.copy() if self.latest is not None else np.full(len(self._measured), np.nan)
        degc[indices] = result.degc
        self._quality[indices], self._reason[indices] = result.quality, result.reason
        ages_s = age_s(self._state, now_s)
        stale = ages_s > self._stale_s
        if stale.any():
            degc[stale] = np.nan
            unsaid = stale & (self._quality != Quality.MISSING)
            self._quality[unsaid], self._reason[unsaid] = Quality.MISSING, Reason.STALE
        usable = (quality == GOOD) & np.isfinite(cycle.degc)
        heard = now_s - self._usable_at_s[indices] <= HELD_PERIODS * period_s
        returned = result.returned & self._after_silence(indices, usable, now_s)
        good = result.quality == GOOD
        self.units.counted(indices[good], result.degc[good])
        most = {"degc": result.degc, "most_degc": rules.max_change_degc, "step_k": self._step_k[indices]}
        far, before_degc = self._fast.jumps(cycle.line, period_s, now_s, result, before_degc, partial(_at_once, **most))
        jumped = (result.new_level | (far & heard)) & ~returned & np.isfinite(before_degc)
        self._jumped_at_s[indices[far]] = now_s
        self._silent[indices[good]] = False
        seen = BelievedValues(
            now_s=now_s,
            indices=indices,
            degc=np.where(good, result.degc, np.nan),
            returned=returned,
            new_level=result.new_level | ~np.isfinite(before_degc),
            jump_k=np.where(jumped, result.degc - before_degc, 0.0),
            stale=stale,
            at_s=self._state.accepted_at_s,
        )
        were, self.levels = self.levels, renewed_levels(self.levels, self._group, seen)
        self.jumped_k = jumped_k(were, self.levels)
        if (again := undone(were, self.levels)) or self.jumped_k is not None:
            themselves = np.isin(np.arange(len(degc)), again)
            self._mean.leave_out(themselves if self.jumped_k is None else themselves | (self.jumped_k != 0.0))
        self._goes_on(cycle.line, were, result.quality, now_s)
        self.gap_ended |= bool(again)
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

    def _goes_on(self, line: str, were: SensorLevels, quality: CodeArray, now_s: float) -> None:
        """Know that of an input that goes on nothing is known since it stood; its jumps are what it has missed."""
        since_s = self.memory.stood_since_s(line)
        self.gap_ended = since_s is not None and not (quality == Quality.HELD).any()
        if since_s is None:
            return
        self.jumped_k, self.levels = None, gone_on(were, self.levels, since_s)
        if self.gap_ended:
            self.memory.counts(line)
            self.levels = with_gap(self.levels, since_s, now_s, self._lines[line][0])

    def _after_silence(self, indices: IndexArray, usable: npt.NDArray[np.bool_], now_s: float) -> npt.NDArray[np.bool_]:
        """Return which sensors of a line have had no value for too long since one last counted."""
        self._silent[indices] |= usable & (now_s - self._usable_at_s[indices] > self._stale_s[indices])
        self._usable_at_s[indices[usable]] = now_s
        return self._silent[indices].copy()


def _at_once(before_degc: FloatArray, degc: FloatArray, most_degc: float, step_k: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which temperatures have changed by so much at once, and by more than one step in which they count.

    `step_k`: 0 where it is not known; a temperature in whole degrees tells it.
    """
    change_degc = np.abs(degc - before_degc)
    if (far := change_degc >= most_degc).any():
        far &= change_degc > (1.0 + 1e-6) * np.where(step_k > 0.0, step_k, degc == np.round(degc))
    return far
