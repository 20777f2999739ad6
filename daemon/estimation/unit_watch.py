"""Keeps which sources say another unit than is configured, and what their sensors said before."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from config.schema.temperatures import TemperaturesConfig
from daemon.state_store.documents import InOtherUnit
from models.cleanse import IndexArray
from models.records import FloatArray

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

    Parameters
    ----------
    before_degc : shape (n_sensors,)
        What counted last of each sensor [degC], NaN where nothing did.
    read : shape (n_sensors,)
        Its latest number [degC if the input says what is configured], NaN where there is none.
    configured
        What is taken for its unit: 'degC', 'degF' or 'K'.
    said
        What was returned before: it stays so until the numbers are nearer in the configured unit, however far the
        machine has warmed or cooled meanwhile.

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
        self._places, self._sensor_ids = places, temperatures.sensor_ids
        self._counted_degc = np.full(len(self._sensor_ids), np.nan)
        self.found = InOtherUnit(units={}, degc={}, configured=self._configured)
        self._as_before: frozenset[str] = frozenset()

    def recall(self, kept: InOtherUnit) -> None:
        """Go on with the sources that said another unit when the previous run ended."""
        units = {name: unit for name, unit in kept.units.items() if name in self._configured}
        found = replace(kept, units=units, configured=self._configured)
        self.found = kept if kept == found else found
        self._as_before = frozenset(n for n, unit in self._configured.items() if kept.configured.get(n) == unit)
        for name in self.found.units:
            places = self._places[name]
            self._counted_degc[places] = [kept.degc.get(self._sensor_ids[place], np.nan) for place in places]

    def recall_past(self, degc: FloatArray) -> None:
        """Hold sources whose configured unit is that of the previous run against what counted last then [degC]."""
        for name in self._as_before:
            places = self._places[name]
            unknown = places[np.isnan(self._counted_degc[places])]
            self._counted_degc[unknown] = degc[unknown]

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
