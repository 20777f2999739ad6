"""Reads means per period from the store, from which a model's states are rebuilt."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import structlog

from config.schema import Configuration
from daemon.estimation.inputs import NoPositions
from daemon.history.database import HistoryError
from daemon.history.restart_reader import RestartReader
from daemon.state_store.documents import CalendarOfBoot, ControlRead
from daemon.state_store.store import StateStore
from daemon.telemetry.metrics import give_memory_back
from drivers.clock import Clock
from models.cleanse import HELD_PERIODS
from models.quality import Quality
from models.records import FloatArray

log = structlog.get_logger(__name__)
WINDOW_S = 300.0
"""So much is read at once, which takes 2 MiB for 300 sensors; an hour would leave the daemon 20 MiB larger."""
RECALL_S = 600.0
"""What was accepted last is looked for in windows of this length, back from now [s]."""
LEAD_S = 120.0
"""Read a little earlier, so that a value that is held at the window's begin is known [s]."""
STEPPED_S = 2.0
"""The calendar was set where it differs by more from the monotonic clock than before [s]."""
MATTERS_S = 60.0
"""What was read of the past is read again when the calendar was set by more [s]."""
SOON_S = 900.0
"""A calendar that is set so soon after the computer's start was wrong at it, as without a clock of its own; when one is
set later, nobody knows which of the two was right."""
NOWHERE_S = -1e12
"""A calendar before all that a store holds."""


@dataclass(frozen=True, slots=True)
class _Span:
    """Of the monotonic clock, in which the calendar was not set."""

    from_s: float
    until_s: float
    to_utc_s: float
    """UTC minus the monotonic clock, for its rows in the store."""


class HistoryBackfill:
    """Reads one machine's store; times are the monotonic clock's."""

    def __init__(
        self, configuration: Configuration, clock: Clock, positions: NoPositions, documents: StateStore
    ) -> None:
        """`positions`: those of the axes follow the temperatures of `means` [mm]. `documents`: of the state."""
        self._store = configuration.history.path
        temperatures = configuration.temperatures
        self._sensor_ids = temperatures.sensor_ids
        held_s = HELD_PERIODS * max(each.cycle_period_s for each in temperatures.inputs)
        held_s = max(held_s, temperatures.cleansing.stale_after_s)
        self._longest_s = configuration.compensation.reference.max_outage_s + held_s
        self._clock = clock
        self._positions = positions
        self._documents = documents
        now = clock.now()
        kept = documents.get(CalendarOfBoot)
        at_s, to_utc_s = (np.inf, 0.0) if kept is None else kept.to_utc_s[-1]
        goes_on = at_s <= now.monotonic_s and abs(now.utc_ahead_s - to_utc_s) <= STEPPED_S
        self._calendar = [*kept.to_utc_s] if kept is not None and goes_on else []
        """Since this computer's start, from when on [s], and UTC minus the monotonic clock then [s]."""
        self._note_calendar()
        self._since_utc_s = self._note_control(configuration)

    def _note_control(self, configuration: Configuration) -> float:
        """Note what is read beside temperatures; return since when it is what it is from the control [s]."""
        reads = configuration.other_reads
        kept = self._documents.get(ControlRead) or ControlRead(reads=reads, since_utc_s={})
        changed = [name for name, read in reads.items() if kept.reads.get(name, read) != read]
        since_utc_s = dict(kept.since_utc_s) | (dict.fromkeys(changed, self._after_all_rows_s()) if changed else {})
        self._documents.put(ControlRead(reads={**kept.reads, **reads}, since_utc_s=since_utc_s))
        return max(since_utc_s.get(name, NOWHERE_S) for name in configuration.cnc.reads)

    def _after_all_rows_s(self) -> float:
        """Return UTC of now, or of the newest row: a computer without a clock of its own begins far behind it [s]."""
        now_s = self._clock.now().utc_s
        if not self._store.is_file():
            return now_s
        try:
            with RestartReader(self._store, also_on_full_disk=True) as reader:
                rows = (reader.extent(kind) for kind in ("cnc", "displacements"))
                return max([now_s, *(to_utc_s for _, to_utc_s in filter(None, rows))])
        except HistoryError as error:
            log.error("history.unreadable", problem=str(error))
            return now_s

    def _note_calendar(self) -> float:
        """Note how far the calendar is ahead of the monotonic clock; return by how much it was set [s]."""
        now = self._clock.now()
        to_utc_s = now.utc_ahead_s
        set_by_s = to_utc_s - self._calendar[-1][1] if self._calendar else np.inf
        if abs(set_by_s) <= STEPPED_S:
            return 0.0
        self._calendar.append((now.monotonic_s, to_utc_s))
        self._documents.put(CalendarOfBoot(to_utc_s=tuple(self._calendar)))
        return set_by_s

    def calendar_set(self, memory_s: float) -> bool:
        """Whether the calendar was set since this was asked last, so that what was read was read at wrong times.

        `memory_s`: how far back it is read; since the computer's start the order is known without the calendar.
        """
        since_s = self._clock.now().monotonic_s - self._calendar[0][0]
        return abs(self._note_calendar()) > MATTERS_S and since_s < memory_s

    def means(self, from_s: float, to_s: float, period_s: float) -> Iterator[tuple[float, FloatArray, float]]:
        """Yield time, temperatures [degC] and spindle speed [1/min] as means that end at each period's end."""
        if not self._store.is_file():
            return
        try:
            with RestartReader(self._store, also_on_full_disk=True) as reader:
                window_s = max(round(WINDOW_S / period_s), 1) * period_s
                begin_s = from_s
                while begin_s < to_s - 1e-6:
                    end_s = min(begin_s + window_s, to_s)
                    yield from self._window(reader, begin_s, end_s, period_s)
                    begin_s = end_s
        except HistoryError as error:
            log.error("history.unreadable", problem=str(error))
        give_memory_back()

    def last_accepted(self) -> tuple[FloatArray, FloatArray, list[tuple[float, FloatArray]]]:
        """Return the latest accepted value of each sensor [degC] and when it was [s]; NaN and -inf where none is.

        Result: also the times [s] and readings [degC] of the time in which these were, NaN where none came.

        It reaches as far back as an outage may last after which a reference is taken up, and a value is held before.
        """
        degc, at_s = np.full(len(self._sensor_ids), np.nan), np.full(len(self._sensor_ids), -np.inf)
        end_s = now_s = self._clock.now().monotonic_s
        read: list[tuple[float, FloatArray]] = []
        if not self._store.is_file():
            return degc, at_s, read
        try:
            with RestartReader(self._store, also_on_full_disk=True) as reader:
                while (unknown := np.isnan(degc)).any() and now_s - end_s < self._longest_s:
                    later, read = read, []
                    for span, from_utc_s, to_utc_s in self._within(end_s - RECALL_S, end_s):
                        found = reader.temperatures(self._sensor_ids, from_utc_s, to_utc_s)
                        own = self._of(span, found.time_s, found.monotonic_s)
                        good = (found.quality == Quality.GOOD) & own[:, None]
                        told = np.where(found.quality <= Quality.HELD, found.degc, np.nan)[own]
                        read += zip((found.time_s[own] - span.to_utc_s).tolist(), told, strict=True)
                        for column in np.flatnonzero(good.any(axis=0) & unknown):
                            row = np.flatnonzero(good[:, column])[-1]
                            degc[column] = found.degc[row, column]
                            at_s[column] = found.time_s[row] - span.to_utc_s
                    read += later
                    end_s -= RECALL_S
        except HistoryError as error:
            log.error("history.unreadable", problem=str(error))
        return degc, at_s, read

    def _window(
        self, reader: RestartReader, begin_s: float, end_s: float, period_s: float
    ) -> Iterator[tuple[float, FloatArray, float]]:
        rows = (self._rows(reader, *within) for within in self._within(begin_s, end_s))
        at_s, degc, cnc_s, speed_rpm, positions = (np.concatenate(part) for part in zip(*rows, strict=True))
        for last_s in np.arange(begin_s + period_s, end_s + 1e-6, period_s):
            inside = (at_s > last_s - period_s) & (at_s <= last_s)
            polled = (cnc_s > last_s - period_s) & (cnc_s <= last_s)
            means = np.concatenate([_mean_of_known(degc[inside]), _mean_of_known(positions[polled])])
            yield float(last_s), means, float(_mean_of_known(speed_rpm[polled, None])[0])

    def _spans(self) -> list[_Span]:
        """Return when the calendar was which: of before the computer's start what it was soon after, if sure."""
        calendar = list(self._calendar)
        until_s = [since_s for since_s, _ in calendar[1:]] + [np.inf]
        own = [_Span(since_s, until, to_utc_s) for (since_s, to_utc_s), until in zip(calendar, until_s, strict=True)]
        soon_s = [to_utc_s for at_s, to_utc_s in calendar if at_s <= calendar[0][0] + SOON_S][-1]
        sure = abs(soon_s - calendar[-1][1]) <= MATTERS_S
        before = _Span(-np.inf, own[0].from_s, soon_s if sure else NOWHERE_S)
        return [before, *own] if len(own) > 1 else [replace(own[0], from_s=-np.inf)]

    def _within(self, begin_s: float, end_s: float) -> Iterator[tuple[_Span, float, float]]:
        """Yield what of two times [s] lies in which span, by its calendar [s], oldest first."""
        for span in self._spans():
            if span.from_s < end_s and span.until_s > begin_s:
                yield span, max(begin_s, span.from_s) + span.to_utc_s, min(end_s, span.until_s) + span.to_utc_s

    def _rows(
        self, reader: RestartReader, span: _Span, from_utc_s: float, to_utc_s: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return times [s] and temperatures [degC], times [s], speeds [1/min] and axis positions [mm] of a span."""
        found = reader.temperatures(self._sensor_ids, from_utc_s - LEAD_S, to_utc_s)
        cnc = reader.cnc(max(from_utc_s, self._since_utc_s), to_utc_s)
        of, of_cnc = self._of(span, found.time_s, found.monotonic_s), self._of(span, cnc.time_s, cnc.monotonic_s)
        own = replace(found, time_s=found.time_s[of], degc=found.degc[of], quality=found.quality[of])
        cnc_s, none = cnc.time_s[of_cnc] - span.to_utc_s, np.full(len(cnc.time_s), np.nan)
        names = self._positions.names
        told = [self._positions.believed(name, cnc_s, cnc.positions_mm.get(name, none)[of_cnc]) for name in names]
        positions = np.array(told).reshape(len(names), len(cnc_s)).T
        return own.time_s - span.to_utc_s, own.cleansed(), cnc_s, cnc.spindle_speed_rpm[of_cnc], positions

    def _of(self, span: _Span, utc_s: FloatArray, monotonic_s: FloatArray) -> npt.NDArray[np.bool_]:
        """Tell which rows are of a span: those of another stand at the same calendar time where it was set back."""
        if len(self._calendar) == 1:
            return np.ones(len(utc_s), dtype=np.bool_)
        apart_s = utc_s - monotonic_s
        if np.isfinite(span.from_s):
            return np.asarray(np.abs(apart_s - span.to_utc_s) <= STEPPED_S)
        of_run = np.min([np.abs(apart_s - to_utc_s) for _, to_utc_s in self._calendar], axis=0) <= STEPPED_S
        return np.asarray(~(of_run & (monotonic_s >= self._calendar[0][0])))


def _mean_of_known(values: FloatArray) -> FloatArray:
    """Return the mean of each column over its finite values, NaN where there is none."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    mean: FloatArray = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean
