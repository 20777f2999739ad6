"""Numbers that a source read -> a cycle of temperatures: unit, scale, range, and the sign of an open sensor. No I/O."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from config.schema.source_drivers import SourceConfig
from config.schema.sources import SourceSensorConfig
from models.quality import Quality, Reason
from models.records import TemperatureCycle, Trace

NAMED_FAULTS = 8
"""A cycle names so many sensors that have no temperature before it counts the rest."""
ABSOLUTE_ZERO_DEGC = -273.15
HOTTEST_DEGC = 2000.0
"""No sensor of a machine tool is hotter; cleansing has limits of its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoReading:
    """Why a sensor has no number in this cycle."""

    reason: Reason
    why: str
    """What was found and what to do."""


Readings = Mapping[int, float | NoReading]
"""By sensor ID; a sensor that is not named has not been received."""
NOT_RECEIVED = NoReading(reason=Reason.NOT_RECEIVED, why="nothing was received in this cycle")


class CycleMaker:
    """Makes the cycles of one source."""

    def __init__(self, source: SourceConfig) -> None:
        self._source = source
        self._sensors = source.sensors
        self._number = 0

    def cycle(self, readings: Readings, trace: Trace, problems: tuple[str, ...] = ()) -> TemperatureCycle:
        """Return the next cycle; what is no plausible temperature is NaN, with the reason. `problems` come first."""
        self._number += 1
        degc = np.full(len(self._sensors), np.nan)
        reason = np.zeros(len(self._sensors), dtype=np.uint8)
        faults: list[str] = []
        for place, sensor in enumerate(self._sensors):
            found = judged(sensor, readings.get(sensor.id, NOT_RECEIVED))
            if isinstance(found, NoReading):
                reason[place] = found.reason
                faults.append(f"source {self._source.name}: sensor {in_words(sensor)}: {found.why}")
            else:
                degc[place] = found
        more = len(faults) - NAMED_FAULTS
        if more > 0:
            faults[NAMED_FAULTS:] = [f"source {self._source.name}: {more} more sensors have no temperature"]
        return TemperatureCycle(
            line=self._source.name,
            number=self._number,
            degc=degc,
            quality=np.where(reason == Reason.NONE, Quality.GOOD, Quality.MISSING).astype(np.uint8),
            reason=reason,
            complete=bool((reason != Reason.NOT_RECEIVED).all()),
            faults=(*problems, *faults),
            trace=trace,
        )


def judged(sensor: SourceSensorConfig, reading: float | NoReading) -> float | NoReading:
    """Return the temperature of a number as read [degC], or why it is none."""
    if isinstance(reading, NoReading):
        return reading
    if not math.isfinite(reading):
        return NoReading(
            reason=Reason.UNREADABLE, why=f"sends {reading}, which is no number: check the sensor and `type`"
        )
    if sensor.is_open(reading):
        why = f"reads {reading:g}, which stands for an open or absent sensor (`open`): check the sensor and its wires"
        return NoReading(reason=Reason.DEVICE_ERROR, why=why)
    degc = sensor.degc(reading)
    lowest = ABSOLUTE_ZERO_DEGC if sensor.min_degc is None else sensor.min_degc
    highest = HOTTEST_DEGC if sensor.max_degc is None else sensor.max_degc
    if not lowest <= degc <= highest:
        why = (
            f"reads {reading:g}, that is {degc:g} degC, outside {lowest:g} to {highest:g} degC: "
            "check the sensor, and what says how its number is read (scale, offset, unit, type)"
        )
        return NoReading(reason=Reason.OUT_OF_RANGE, why=why)
    return degc


def in_words(sensor: SourceSensorConfig) -> str:
    """Return a sensor with where it sits."""
    place = sensor.component if sensor.part == "-" else f"{sensor.component}, {sensor.part}"
    return f"{sensor.id} ({place})"
