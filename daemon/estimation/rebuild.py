"""Reads means per period from the store, from which a model's states are rebuilt."""

from collections.abc import Iterator

import numpy as np
import structlog

from config.schema import Configuration
from daemon.estimation.inputs import NoPositions
from daemon.history import HistoryError, HistoryReader
from daemon.telemetry.metrics import give_memory_back
from drivers.clock import Clock
from models.quality import Quality
from models.records import FloatArray

log = structlog.get_logger(__name__)
WINDOW_S = 600.0
"""So much is read at once; an hour of all sensors would leave the daemon 20 MiB larger."""
RECALL_S = 600.0
"""What was accepted last is looked for in windows of this length, back from now [s]."""
LEAD_S = 120.0
"""Read a little earlier, so that a value that is held at the window's begin is known [s]."""


class HistoryBackfill:
    """Reads one machine's store; times are the monotonic clock's."""

    def __init__(self, configuration: Configuration, clock: Clock, positions: NoPositions) -> None:
        """`positions`: those of the axes follow the temperatures of `means` [mm]."""
        self._store = configuration.history.path
        self._sensor_ids = configuration.temperatures.sensor_ids
        self._longest_s = configuration.compensation.reference.max_outage_s
        self._clock = clock
        self._positions = positions

    def means(self, from_s: float, to_s: float, period_s: float) -> Iterator[tuple[float, FloatArray, float]]:
        """Yield time, temperatures [degC] and spindle speed [1/min] as means that end at each period's end."""
        now = self._clock.now()
        to_utc_s = now.utc_s - now.monotonic_s
        if not self._store.is_file():
            return
        try:
            with HistoryReader(self._store, also_on_full_disk=True) as reader:
                window_s = max(round(WINDOW_S / period_s), 1) * period_s
                begin_s = from_s
                while begin_s < to_s - 1e-6:
                    end_s = min(begin_s + window_s, to_s)
                    yield from self._window(reader, begin_s, end_s, period_s, to_utc_s)
                    begin_s = end_s
        except HistoryError as error:
            log.error("history.unreadable", problem=str(error))
        give_memory_back()

    def last_accepted(self) -> tuple[FloatArray, FloatArray]:
        """Return the latest accepted value of each sensor [degC] and when it was [s]; NaN and -inf where none is.

        It reaches as far back as an outage may last after which a reference is taken up.
        """
        degc, at_s = np.full(len(self._sensor_ids), np.nan), np.full(len(self._sensor_ids), -np.inf)
        now = self._clock.now()
        if not self._store.is_file():
            return degc, at_s
        try:
            with HistoryReader(self._store, also_on_full_disk=True) as reader:
                until_s = now.utc_s
                while not np.isfinite(degc).any() and now.utc_s - until_s < self._longest_s:
                    found = reader.temperatures(self._sensor_ids, until_s - RECALL_S, until_s)
                    good = found.quality == Quality.GOOD
                    for column in np.flatnonzero(good.any(axis=0)):
                        row = np.flatnonzero(good[:, column])[-1]
                        degc[column] = found.degc[row, column]
                        at_s[column] = found.time_s[row] - now.utc_s + now.monotonic_s
                    until_s -= RECALL_S
        except HistoryError as error:
            log.error("history.unreadable", problem=str(error))
        return degc, at_s

    def _window(
        self, reader: HistoryReader, begin_s: float, end_s: float, period_s: float, to_utc_s: float
    ) -> Iterator[tuple[float, FloatArray, float]]:
        found = reader.temperatures(self._sensor_ids, begin_s + to_utc_s - LEAD_S, end_s + to_utc_s)
        cnc = reader.cnc(begin_s + to_utc_s, end_s + to_utc_s)
        degc, at_s, cnc_s = found.cleansed(), found.time_s - to_utc_s, cnc.time_s - to_utc_s
        none, names = np.full(len(cnc_s), np.nan), self._positions.names
        told = [self._positions.believed(name, cnc_s, cnc.positions_mm.get(name, none)) for name in names]
        positions = np.array(told).reshape(len(names), len(cnc_s)).T
        for last_s in np.arange(begin_s + period_s, end_s + 1e-6, period_s):
            inside = (at_s > last_s - period_s) & (at_s <= last_s)
            speeds = cnc.spindle_speed_rpm[(cnc_s > last_s - period_s) & (cnc_s <= last_s)]
            means = _mean_of_known(degc[inside])
            if names:
                polled = (cnc_s > last_s - period_s) & (cnc_s <= last_s)
                means = np.concatenate([means, _mean_of_known(positions[polled])])
            yield float(last_s), means, float(_mean_of_known(speeds[:, None])[0])


def _mean_of_known(values: FloatArray) -> FloatArray:
    """Return the mean of each column over its finite values, NaN where there is none."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    mean: FloatArray = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean
