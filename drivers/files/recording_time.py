"""Reads the times of a recording: numbers with a unit, ISO 8601, or the form that its map gives, in local time."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta, tzinfo
from zoneinfo import ZoneInfo

from config.recordings.recording_map import RecordingMap

SECONDS = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
HOURS = 24

TimeReader = Callable[[str], float]
"""Text of a row's time -> seconds; rows in order. Raises ValueError for what is no time."""


def time_reader(recording_map: RecordingMap) -> TimeReader:
    """Return what reads the times of one recording, row by row."""
    zone = UTC if recording_map.time_zone is None else ZoneInfo(recording_map.time_zone)
    if (form := recording_map.time_format) is not None:
        if not recording_map.has_dates:
            return _OfDay(form)
        return _Local(lambda text: datetime.strptime(text, form), zone)
    if recording_map.time_unit == "iso":
        return _Local(datetime.fromisoformat, zone)
    factor = SECONDS[recording_map.time_unit]
    return lambda text: float(text.replace(",", ".")) * factor


class _Local:
    """Date and time in a zone; in the hour that comes twice in autumn, what goes back is the second one."""

    def __init__(self, read: Callable[[str], datetime], zone: tzinfo) -> None:
        self._read, self._zone = read, zone
        self._last_s = float("-inf")

    def __call__(self, text: str) -> float:
        moment = self._read(text)
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=self._zone)
            if moment.timestamp() <= self._last_s < (again := moment.replace(fold=1)).timestamp():
                moment = again
        self._last_s = moment.timestamp()
        return self._last_s


class _OfDay:
    """The time of day alone, or since the start: what goes back by more than half a day, or says so, is another day."""

    def __init__(self, form: str) -> None:
        self._form = form
        self._days, self._last = timedelta(), datetime.min

    def __call__(self, text: str) -> float:
        hours, _, rest = text.partition(":")
        since_start = self._form.startswith("%H:") and hours.isdecimal() and int(hours) >= HOURS
        moment = datetime.strptime(f"{int(hours) % HOURS}:{rest}" if since_start else text, self._form)
        if since_start:
            self._days = timedelta(days=int(hours) // HOURS)
        elif self._last - moment > timedelta(hours=HOURS / 2):
            self._days += timedelta(days=1)
        self._last = moment
        return (moment + self._days - datetime(1900, 1, 1)).total_seconds()
