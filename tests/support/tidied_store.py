"""A store whose hours are packed and whose old rows are gone, without a daemon or without its packing process."""

from collections.abc import AsyncGenerator, Iterator
from contextlib import closing
from itertools import chain
from pathlib import Path

from config.schema.service import HistoryConfig
from daemon.history.columns.packed_hour import PackedHour, packing_cutoff_ms
from daemon.history.columns.packing import missing_extremes, pack_hours
from daemon.history.database import connect_reader, connect_writer
from daemon.history.retention import HousekeepingReport, store_hour, tidy


def hours_of(path: Path, config: HistoryConfig, now_utc_s: float) -> Iterator[PackedHour]:
    with closing(connect_reader(path)) as reading:
        yield from chain(
            pack_hours(reading, packing_cutoff_ms(now_utc_s, config.pack_after_s)), missing_extremes(reading)
        )


async def packed_here(path: Path, config: HistoryConfig, now_utc_s: float) -> AsyncGenerator[PackedHour, None]:
    """Pack for a daemon's housekeeping in this process: a test of retention starts dozens of its own otherwise."""
    for hour in hours_of(path, config, now_utc_s):
        yield hour


def housekeeping(path: Path, config: HistoryConfig, now_utc_s: float) -> HousekeepingReport:
    """Pack and prune a store that no daemon writes, as a daemon does with its own."""
    report = HousekeepingReport()
    with closing(connect_writer(path)) as connection:
        for hour in hours_of(path, config, now_utc_s):
            if store_hour(connection, hour):
                report.packed_hours += 1
        while tidy(connection, config, now_utc_s, report):
            pass
    return report
