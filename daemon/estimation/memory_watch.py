"""Keeps which inputs answer from memory, and which say another unit than is configured, over a restart too."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from config.schema.temperatures import TemperaturesConfig
from daemon.state_store.documents import InOtherUnit, InputsRead
from drivers.clock import Clock
from models.cleanse import IndexArray
from models.records import FloatArray
from models.standing_input import StandingInput, renewed_input

LATEST = 8
"""So many positionings are known."""
KEPT_PERIOD_S = 600.0
"""How often what inputs say is kept for a restart, beside when one is found or goes on [s]."""


class MemoryWatch:
    """The inputs of one machine; owned by the thermal task."""

    def __init__(self, places: Mapping[str, IndexArray], clock: Clock) -> None:
        """`places`: of the sensors of each line and source, in the machine's order."""
        self._places = places
        self._clock = clock
        self._inputs = {name: StandingInput(degc=np.full(len(of), np.nan)) for name, of in places.items()}
        self._stood_since_s: dict[str, float] = {}
        """Since when inputs had stood that go on, until all their values count again [s]."""
        self.kept = InputsRead(inputs={})
        self._kept_s = -np.inf
        self._found: frozenset[str] = frozenset()
        self._positioned_s = -np.inf
        self._at_positionings: dict[float, tuple[str, ...]] = {}
        """What stood at the latest ones [s]: those after it may be refused, one after the other."""

    def positioned(self, at_s: float, *, anew: bool) -> None:
        """Know when the work was positioned [s]; not `anew`: what counted before a restart or a refusal does again."""
        at_reference = self.kept.at_reference
        before = {**self._at_positionings, self._positioned_s: at_reference}
        if anew:
            self._at_positionings, at_reference = dict([*before.items()][-LATEST:]), ()
        elif known := [of for then_s, of in before.items() if abs(at_s - then_s) < 1.0]:
            at_reference = known[-1]
        self._positioned_s = at_s
        if at_reference != self.kept.at_reference:
            self.kept = replace(self.kept, at_reference=at_reference)

    def recall(self, kept: InputsRead) -> None:
        """Go on with what the previous run knew."""
        self.kept, now_s = kept, self._clock.now().monotonic_s
        for name, each in kept.inputs.items():
            if name in self._inputs and len(each.degc) == len(self._places[name]):
                self._inputs[name] = replace(each, since_s=min(each.since_s - self._clock.now().utc_ahead_s, now_s))

    def take(self, name: str, degc: FloatArray, now_s: float) -> FloatArray:
        """Take the numbers of an input as they were read [degC]; return the latest ones of its sensors [degC]."""
        before = self._inputs[name]
        now = self._inputs[name] = renewed_input(before, degc, now_s)
        if before.stands_s(now_s) and now.since_s > before.since_s:
            self._stood_since_s.setdefault(name, before.since_s)
        stands = [each for each, of in self._inputs.items() if of.stands_s(now_s)]
        found = frozenset([*self._stood_since_s, *stands])
        if found != self._found or now_s - self._kept_s >= KEPT_PERIOD_S:
            ahead_s = self._clock.now().utc_ahead_s
            known = {each: replace(of, since_s=of.since_s + ahead_s) for each, of in self._inputs.items()}
            going_on = {each: of for each, of in self.kept.inputs.items() if each in self._stood_since_s}
            stood = [each for each in stands if self._inputs[each].since_s < self._positioned_s]
            stood += [each for each in self.kept.at_reference if each not in stood]
            self._found, self._kept_s = found, now_s
            self.kept = InputsRead(inputs=known | going_on, at_reference=tuple(stood))
        return now.degc

    def why(self, now_s: float) -> str:
        """Return which line or source seems to answer from memory, '' when none does."""
        for name, since_s in self._stood_since_s.items():
            return f"{name} goes on after it had sent the very same numbers for {(now_s - since_s) / 60.0:.0f} min"
        for name, each in self._inputs.items():
            if stood_s := each.stands_s(now_s):
                return (
                    f"{name} has sent the very same numbers for {stood_s / 60.0:.0f} min, though they changed all the "
                    "time before: it may answer from memory; check it and what its sensors hang on"
                )
        return ""

    def at_reference(self) -> str:
        """Return why what counts from the reference is not known, '' when no input stood as the work was positioned."""
        if not self.kept.at_reference:
            return ""
        named = ", ".join(self.kept.at_reference)
        return f"{named} sent the very same numbers for minutes while the work was positioned: position it again"

    def standing(self, now_s: float) -> list[int]:
        """Return the places of all sensors of inputs that seem to answer from memory."""
        return [place for name, each in self._inputs.items() if each.stands_s(now_s) for place in self._places[name]]

    def stood_since_s(self, name: str) -> float | None:
        """Return since when an input had stood that goes on, until all its values count again [s]."""
        return self._stood_since_s.get(name)

    def counts(self, name: str) -> None:
        """All values of an input that goes on count again."""
        del self._stood_since_s[name]


UNITS = {"degF": (1.8, 32.0), "K": (1.0, 273.15)}
"""Unit -> what it is per kelvin, and at 0 degC."""
LEAST_JUMP_K = 10.0
"""A number that goes by less is in no other unit [K]."""
NEAR_K = 5.0
"""So near to where it was at least half of the sensors are, taken in the other unit [K]."""
FEWEST, SHARE = 2, 0.75
"""So many sensors tell it, and such a share of all is nearer to where it was in the other unit than in its own."""


def other_unit(before_degc: FloatArray, read: FloatArray, configured: str, said: str) -> str:
    """Return in which unit an input now says its temperatures, '' in the one that is configured.

    `before_degc`: what counted last; `read`: what came, both [degC] if the input says what is configured, NaN where
    nothing. What was `said` before stays until the numbers are nearer in the configured unit.
    """
    jump_k = np.abs(read - before_degc)
    if not said and int((jump_k > LEAST_JUMP_K).sum()) < FEWEST:
        return ""
    known = np.isfinite(jump_k)
    if not known.any():
        return said
    gain, zero = UNITS.get(configured, (1.0, 0.0))
    for unit, (other_gain, other_zero) in {"degC": (1.0, 0.0), **UNITS}.items():
        if unit == configured:
            continue
        off_k = np.abs((read[known] * gain + zero - other_zero) / other_gain - before_degc[known])
        nearer = (off_k < jump_k[known]) & (said == unit or jump_k[known] > LEAST_JUMP_K)
        enough = nearer.sum() >= max(FEWEST, SHARE * known.sum())
        if enough and (said == unit or 2 * (off_k <= NEAR_K).sum() >= known.sum()):
            return unit
    return ""


class UnitWatch:
    """The units of the sources of one machine; lines have none that anybody could switch."""

    def __init__(self, temperatures: TemperaturesConfig, places: Mapping[str, IndexArray]) -> None:
        """`places`: of the sensors of each line and source, in the machine's order."""
        self._configured = {each.name: each.sensors[0].unit for each in temperatures.sources or ()}
        self._places = places
        self._sensor_ids = temperatures.sensor_ids
        self._counted_degc = np.full(len(self._sensor_ids), np.nan)
        self.found = InOtherUnit(units={}, degc={})

    def recall(self, kept: InOtherUnit) -> None:
        """Go on with the sources that said another unit when the previous run ended."""
        units = {name: unit for name, unit in kept.units.items() if name in self._configured}
        self.found = kept if units == kept.units else replace(kept, units=units)
        for name in units:
            places = self._places[name]
            self._counted_degc[places] = [kept.degc.get(self._sensor_ids[place], np.nan) for place in places]

    def recall_past(self, degc: FloatArray) -> None:
        """Hold what comes against what counted last in the previous run [degC]; NaN where another thing was read."""
        self._counted_degc = np.where(np.isnan(self._counted_degc), degc, self._counted_degc)

    def counted(self, places: IndexArray, degc: FloatArray) -> None:
        """Take what counts of some sensors [degC]."""
        self._counted_degc[places] = degc

    def says_other(self, name: str, latest_degc: FloatArray) -> bool:
        """Return whether a line or source says another unit, from its sensors' latest numbers."""
        if name not in self._configured:
            return False
        said = self.found.units.get(name, "")
        unit = other_unit(self._counted_degc[self._places[name]], latest_degc, self._configured[name], said)
        if unit != said:
            units = {each: of for each, of in self.found.units.items() if each != name} | ({name: unit} if unit else {})
            places = [place for each in units for place in self._places[each]]
            degc = {self._sensor_ids[place]: float(self._counted_degc[place]) for place in places}
            self.found = replace(self.found, units=units, degc=degc)
        return bool(unit)

    def why(self) -> str:
        """Return which source says another unit, '' when none does."""
        for name, unit in self.found.units.items():
            return (
                f"all temperatures of {name} went together to where {unit} puts them, and {self._configured[name]} "
                "is configured: nothing of it counts; set its unit back, or say it in its `unit` and restart the daemon"
            )
        return ""
