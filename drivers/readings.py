"""Numbers that a source read -> rows of values: unit, scale, range, and the sign of an open sensor. No I/O."""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import AsyncGenerator, Iterable, Mapping
from contextlib import aclosing
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from config.schema.source_drivers import SourceEntry
from config.schema.sources import Measured, SourceSensorConfig
from models.quality import Quality, Reason
from models.records import CodeArray, FloatArray, TemperatureCycle, Trace

NAMED_FAULTS = 8
"""A row names so many inputs that have no value before it counts the rest."""
LATEST = 12
"""So many readings of a sensor are looked at for another device that answers or publishes in its place."""
MOST_TURNS, FEW_TURNS = 3, 1
"""More of them go there and back again: they are no one sensor's until few do. A wrong one is left to cleansing."""
TURN_K = 1.1
"""There and back is more than this [K], and more than a step of a sensor that counts in whole degrees."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoReading:
    """Why a sensor has no number in this cycle."""

    reason: Reason
    why: str
    """What was found and what to do."""


Readings = Mapping[int | str, float | NoReading]
"""By the input's key; one that is not named has not been received."""
NOT_RECEIVED = NoReading(reason=Reason.NOT_RECEIVED, why="nothing was received in this cycle")


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One reading of all that a source measures, in the order of its section."""

    number: int
    values: FloatArray
    """[degC] of sensors, [um] of channels; NaN with a reason."""
    reason: CodeArray
    faults: tuple[str, ...]
    trace: Trace


class RowSource(ABC):
    """What every source does (`drivers.contract.TemperatureSource`), to be used once."""

    name: str

    @abstractmethod
    def rows(self) -> AsyncGenerator[Row]:
        """Open the source and yield each row as it completes; raises LinkError when the source is lost."""

    @abstractmethod
    async def close(self) -> None:
        """Release everything. May be called in any state, more than once; never raises."""

    async def cycles(self) -> AsyncGenerator[TemperatureCycle]:
        """Open the source and yield each row as a cycle of temperatures; raises LinkError when the source is lost."""
        async with aclosing(self.rows()) as rows:
            async for row in rows:
                yield cycle_of(row, self.name)


def cycle_of(row: Row, line: str) -> TemperatureCycle:
    return TemperatureCycle(
        line=line,
        number=row.number,
        degc=row.values,
        quality=np.where(row.reason == Reason.NONE, Quality.GOOD, Quality.MISSING).astype(np.uint8),
        reason=row.reason,
        complete=bool((row.reason != Reason.NOT_RECEIVED).all()),
        faults=row.faults,
        trace=row.trace,
    )


class RowMaker:
    def __init__(self, source: SourceEntry) -> None:
        self._source = source
        self._inputs = source.inputs
        self._number = 0
        self._sensors = {each.key: each for each in self._inputs if isinstance(each, SourceSensorConfig)}
        self._latest: dict[int | str, deque[float]] = {key: deque(maxlen=LATEST) for key in self._sensors}
        self._contradicted: set[int | str] = set()

    def of_one_device(self, key: int | str, reading: float | NoReading) -> float | NoReading:
        """Return a reading, or why it is none: it goes back and forth with those before it, as no temperature does."""
        if key not in self._sensors or isinstance(degc := judged(self._sensors[key], reading), NoReading):
            return reading
        latest = self._latest[key]
        latest.append(degc)
        lowest, highest = min(latest), max(latest)
        most = FEW_TURNS if key in self._contradicted else MOST_TURNS
        if highest - lowest <= TURN_K or turns(latest) <= most:
            self._contradicted.discard(key)
            return reading
        self._contradicted.add(key)
        why = (
            f"goes back and forth between {lowest:.1f} and {highest:.1f} degC: end what else answers or publishes "
            "in its place (a box with the same `unit_id`, a device with the same `topic`), or mend its wires"
        )
        return NoReading(reason=Reason.DUPLICATE_ID, why=why)

    def row(self, readings: Readings, trace: Trace, problems: tuple[str, ...] = ()) -> Row:
        """Return the next row; what is no plausible value is NaN, with the reason. `problems` come first."""
        self._number += 1
        values = np.full(len(self._inputs), np.nan)
        reason = np.zeros(len(self._inputs), dtype=np.uint8)
        faults: list[str] = []
        for place, each in enumerate(self._inputs):
            found = judged(each, readings.get(each.key, NOT_RECEIVED))
            if isinstance(found, NoReading):
                reason[place] = found.reason
                faults.append(f"source {self._source.name}: {each.in_words}: {found.why}")
            else:
                values[place] = found
        more = len(faults) - NAMED_FAULTS
        if more > 0:
            faults[NAMED_FAULTS:] = [f"source {self._source.name}: {more} more have no value"]
        return Row(number=self._number, values=values, reason=reason, faults=(*problems, *faults), trace=trace)


def turns(degc: Iterable[float]) -> int:
    """Return how often successive temperatures [degC] change by more than `TURN_K` and then back by more."""
    changes = [after - before for before, after in pairwise(degc) if abs(after - before) > TURN_K]
    return sum(there * back < 0 for there, back in pairwise(changes))


def judged(measured: Measured, reading: float | NoReading) -> float | NoReading:
    """Return the value of a number as read, in its unit, or why it is none."""
    if isinstance(reading, NoReading):
        return reading
    if not math.isfinite(reading):
        return NoReading(
            reason=Reason.UNREADABLE, why=f"sends {reading}, which is no number: check the sensor and `type`"
        )
    if measured.is_open(reading):
        why = f"reads {reading:g}, which stands for an open or absent sensor (`open`): check the sensor and its wires"
        return NoReading(reason=Reason.DEVICE_ERROR, why=why)
    value, unit = measured.value(reading), measured.unit_words
    lowest, highest = measured.span
    if not (math.isfinite(value) and lowest <= value <= highest):
        why = (
            f"reads {reading:g}, that is {value:g} {unit}, outside {lowest:g} to {highest:g} {unit}: "
            "check the sensor, and what says how its number is read (scale, offset, unit, type)"
        )
        return NoReading(reason=Reason.OUT_OF_RANGE, why=why)
    return value
