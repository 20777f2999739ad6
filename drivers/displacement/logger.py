"""What a source reads in the files of a logger, by what reads the A/D logger's."""

import math

from config.schema.displacements import DisplacementChannelConfig
from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import CsvFiles
from config.schema.sources import DEGF_AT_0_DEGC, DEGF_PER_K, Measured
from drivers.clock import Clock
from drivers.displacement.rows import LoggedNumbers, unit_of_scale
from drivers.displacement.source import DisplacementCsvSource
from drivers.pushing import PushedSource
from drivers.readings import NOT_RECEIVED, NoReading
from models.quality import Reason
from models.records import DisplacementSample, Instant

NEWEST_PERIODS = 3.0
"""A row whose time stamp is more cycle periods old is of the past, and not shown as the present."""
LONGEST_NAME = 80
CORRECTION_K = 10.0
"""An `offset` of no more corrects a sensor, and does not convert its unit."""
AHEAD_S = 5.0
"""A time stamp may be so far ahead of this computer's clock [s]."""
WHY = {
    Reason.OVERFLOW: NoReading(
        reason=Reason.OVERFLOW, why="the logger wrote that the value is out of its range or open"
    ),
    Reason.UNREADABLE: NoReading(reason=Reason.UNREADABLE, why="its field holds no number"),
}


def _unit(of: Measured) -> str | None:
    """Return the unit that an input is read in; None where that is no usual one."""
    at_zero, per_number = of.value(0.0), of.value(1.0) - of.value(0.0)
    if of.unit_words == "um":
        return unit_of_scale(per_number)
    usual = {"degC": (1.0, 0.0), "degF": (1.0 / DEGF_PER_K, -DEGF_AT_0_DEGC / DEGF_PER_K)}
    for unit, (per, zero) in usual.items():
        if math.isclose(per_number, per) and abs(at_zero - zero) <= CORRECTION_K:
            return unit
    return None


class LoggerSource(PushedSource):
    """Each row that comes is a cycle: at its time stamp, or, where rows have none, when it was read."""

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        super().__init__(source, clock)
        assert isinstance(source.connection, CsvFiles)
        config = source.connection
        self._path = config.file.path
        self._stamped = bool(config.file.time_columns)
        self._keys = [each.key for each in source.inputs]
        channels = [
            DisplacementChannelConfig(name=f"sensor {each.key}"[:LONGEST_NAME], column=each.column)
            for each in config.every_input
        ]
        units = [_unit(each) for each in source.inputs]
        owner = f"source {source.name}: file"
        self._files = DisplacementCsvSource(
            LoggedNumbers(file=config.file, channels=channels, owner=owner, units=units), clock
        )
        self._newest_utc_s = clock.now().utc_s - NEWEST_PERIODS * source.cycle_period_s
        self._untimely = ""
        """How far the latest row's time stamp is from now, where the row is not used for that."""

    async def follow(self) -> None:
        """Follow the files; raises LinkError when they cannot be read for long."""
        try:
            async for row in self._files.samples(self.report):
                self._on_row(row)
        finally:
            await self._files.close()

    def _on_row(self, row: DisplacementSample) -> None:
        readings = {
            key: number if reason == Reason.NONE else WHY.get(Reason(reason), NOT_RECEIVED)
            for key, number, reason in zip(self._keys, row.um.tolist(), row.reason.tolist(), strict=True)
        }
        now = self._clock.now()
        if not self._stamped:
            if self._files.caught_up:
                self.put_set(readings)
            return
        ahead_s = row.utc_s - now.utc_s
        if ahead_s > AHEAD_S:
            self._untimely = (
                f"{row.source}: the time stamp is {ahead_s:.0f} s ahead of this computer's clock: correct `time_zone`, "
                "`time_format` or one of the two clocks; the row is not used"
            )
            self.report(self._untimely)
            return
        if row.utc_s <= self._newest_utc_s:
            if -ahead_s > NEWEST_PERIODS * self._source.cycle_period_s:
                self._untimely = (
                    f"the time stamp of its last row is {-ahead_s:.0f} s behind this computer's clock: where the "
                    "logger runs, correct `time_zone`, `time_format` or one of the two clocks"
                )
            return
        self._newest_utc_s, self._untimely = row.utc_s, ""
        age_s = max(0.0, -ahead_s)
        self.put_row(
            readings,
            Instant(
                monotonic_s=now.monotonic_s - age_s,
                utc_s=now.utc_s - age_s,
                real_s=now.real_s - age_s / self._clock.speed,
            ),
        )

    def silent(self) -> str:
        """Return what to check when no row comes."""
        problem = self._untimely or self._files.last_problem
        return (
            f"file {self._path} has brought no new row for {NEWEST_PERIODS:g} cycle periods "
            f"({self._source.cycle_period_s:g} s each){f' ({problem})' if problem else ''}: check that the logger "
            "runs, that its folder is mounted, `file.path`, and that `cycle_period_s` is not shorter than its interval"
        )
