"""Keeps which sources say another unit than is configured, and what their sensors said before."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from config.schema.temperatures import TemperaturesConfig
from daemon.state_store.documents import InOtherUnit
from models.cleanse import IndexArray
from models.other_unit import other_unit
from models.records import FloatArray


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
