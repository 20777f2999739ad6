"""A store whose hours are packed and whose old rows are gone, without a daemon."""

from contextlib import closing
from itertools import chain
from pathlib import Path

from config.schema.service import HistoryConfig
from daemon.history.columns.packing import missing_extremes, pack_hours, packing_cutoff_ms
from daemon.history.database import connect_reader, connect_writer
from daemon.history.retention import HousekeepingReport, store_hour, tidy


def housekeeping(path: Path, config: HistoryConfig, now_utc_s: float) -> HousekeepingReport:
    """Pack and prune a store that no daemon writes, as a daemon does with its own."""
    report = HousekeepingReport()
    with closing(connect_writer(path)) as connection, closing(connect_reader(path)) as reading:
        packed = pack_hours(reading, packing_cutoff_ms(now_utc_s, config.pack_after_s))
        for hour in chain(packed, missing_extremes(reading)):
            if store_hour(connection, hour):
                report.packed_hours += 1
        while tidy(connection, config, now_utc_s, report):
            pass
    return report
