"""The A/D logger of a simulated machine: a CSV file that grows by one row a minute.

The file is laid out as the configuration describes it, so that the daemon's reader finds what it
expects. Nothing here sleeps: the owner moves the logger on in simulated time with `step`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

from config.schema.displacements import DisplacementFileConfig, DisplacementsConfig
from drivers.displacement.rows import unit_of_scale
from drivers.sim.faults import Fault, FaultKind, of_kind

ROW_PERIOD_S = 60.0
NO_UNIT = "-"
BYTE_ORDER_MARK = b"\xef\xbb\xbf"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Column:
    title: str
    channel: str | None = None
    """None: a column of the time stamp, or one that stays empty."""
    time_part: int | None = None


class DisplacementCsv:
    """Writes one logger's file."""

    def __init__(
        self,
        config: DisplacementsConfig,
        read: Callable[[], Mapping[str, float]],
        utc_of: Callable[[float], float],
        *,
        start_s: float = 0.0,
        period_s: float | None = None,
        faults: Sequence[Fault] = (),
        unit: str | None = None,
    ) -> None:
        """Prepare the logger: `read` gives [um] by channel, `utc_of` UTC; `unit`: its row of units, None: by scale."""
        assert config.file is not None
        self._file = config.file
        self._scale_um = {channel.name: channel.scale_um for channel in config.channels}
        self._units = {name: unit or unit_of_scale(um) or NO_UNIT for name, um in self._scale_um.items()}
        self._columns = _columns(config)
        self._read = read
        self._utc_of = utc_of
        self._period_s = period_s or config.file.interval_s or ROW_PERIOD_S
        self._next_s = start_s
        self._faults = list(of_kind(faults, FaultKind.CSV_TRUNCATED, FaultKind.CSV_ROTATED))
        self._halves = list(of_kind(faults, FaultKind.CSV_HALF_ROW))
        self._rest: tuple[float, bytes] | None = None
        self._files = 0
        self.path = self._new_path()
        self.rows = 0

    def begin(self) -> None:
        """Write the file's head, which else comes with the first row."""
        self._append(b"")

    def step(self, now_s: float) -> None:
        """Write the rows that are due at a simulated time [s] and let faults happen."""
        while self._next_s <= now_s:
            self._damage(self._next_s)
            self._write_row(self._next_s)
            self._next_s += self._period_s
        self._damage(now_s)
        if self._rest is not None and self._rest[0] <= now_s:
            self._write_rest()

    def _write_row(self, at_s: float) -> None:
        self._write_rest()
        row = self._line(self._texts(at_s))
        self.rows += 1
        if not self._halves or self._halves[0].at_s > at_s:
            self._append(row)
            return
        half = self._halves.pop(0)
        self._append(row[: len(row) // 2])
        self._rest = (at_s + (half.duration_s or 0.0), row[len(row) // 2 :])

    def _write_rest(self) -> None:
        rest, self._rest = self._rest, None
        if rest is not None:
            self._append(rest[1])

    def _damage(self, now_s: float) -> None:
        while self._faults and self._faults[0].at_s <= now_s:
            fault = self._faults.pop(0)
            self._write_rest()
            if fault.kind is FaultKind.CSV_ROTATED:
                self._rotate()
            elif self.path.exists():
                with self.path.open("r+b") as file:
                    file.truncate(min(int(fault.amount), self.path.stat().st_size))

    def _rotate(self) -> None:
        """Begin a new file: under a new name where the configuration has a pattern, else after moving the old one."""
        old = self.path
        self.path = self._new_path()
        if self.path == old and old.exists():
            old.replace(old.with_name(f"{old.name}.{self._files - 1}"))

    def _new_path(self) -> Path:
        self._files += 1
        pattern = self._file.path
        return pattern.with_name(pattern.name.replace("*", f"{self._files:04d}", 1).replace("*", ""))

    def _texts(self, at_s: float) -> list[str]:
        moment = datetime.fromtimestamp(self._utc_of(at_s), tz=UTC).astimezone(ZoneInfo(self._file.time_zone))
        parts = _time_parts(moment, self._file)
        values = self._read()
        return [
            parts[column.time_part] if column.time_part is not None else self._number(column.channel, values)
            for column in self._columns
        ]

    def _number(self, channel: str | None, values: Mapping[str, float]) -> str:
        if channel is None or channel not in values:
            return ""
        return f"{values[channel] / self._scale_um[channel]:.3f}".replace(".", self._file.decimal)

    def _append(self, data: bytes) -> None:
        """Open, write and close, so that a program that moves or cuts the file finds no open handle."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as file:
            file.write((self._head() if file.tell() == 0 else b"") + data)

    def _head(self) -> bytes:
        if self._file.header is None:
            return b""
        head = self._line([column.title for column in self._columns])
        if self._file.unit_row:
            head += self._line([self._units[column.channel] if column.channel else "" for column in self._columns])
        return BYTE_ORDER_MARK + head if self._file.encoding == "utf-8-sig" else head

    def _line(self, texts: Sequence[str]) -> bytes:
        encoding = "utf-8" if self._file.encoding == "utf-8-sig" else self._file.encoding
        return (self._file.delimiter.join(texts) + "\r\n").encode(encoding)


def _columns(config: DisplacementsConfig) -> list[_Column]:
    """Return the file's columns: numbered ones where they belong, named ones in the places that are left."""
    file = config.file
    assert file is not None
    wanted: list[tuple[str | int, _Column]] = []
    for part, key in enumerate(file.time_columns if file.start is None else []):
        wanted.append((key, _Column(title=str(key) if isinstance(key, str) else f"Time{part or ''}", time_part=part)))
    for channel in config.channels:
        title = channel.column if isinstance(channel.column, str) else channel.name
        wanted.append((channel.column, _Column(title=title, channel=channel.name)))
    placed = {key: column for key, column in wanted if isinstance(key, int)}
    place = 1
    for column in (column for key, column in wanted if isinstance(key, str)):
        while place in placed:
            place += 1
        placed[place] = column
    if file.header is not None and file.time_columns[:1] == [1] and 1 in placed and placed[1].time_part == 0:
        placed[1] = _Column(title=file.header, time_part=0)
    columns = [placed.get(number, _Column(title="-")) for number in range(1, max(placed) + 1)]
    _refuse_unreadable(file, columns, named=any(isinstance(key, str) for key, _ in wanted))
    return columns


def _refuse_unreadable(file: DisplacementFileConfig, columns: Sequence[_Column], *, named: bool) -> None:
    titles = file.delimiter.join(column.title for column in columns)
    if file.header is None and named:
        raise ValueError("displacements.file.header is not given, so columns must be given by number")
    if file.header is not None and not titles.startswith(file.header):
        raise ValueError(f"the simulated logger's header row {titles!r} does not start with {file.header!r}")


def _time_parts(moment: datetime, file: DisplacementFileConfig) -> list[str]:
    count = len(file.time_columns)
    text = str(int(moment.timestamp())) if file.time_format == "%s" else moment.strftime(file.time_format)
    parts = text.split(" ", count - 1)
    return parts + [""] * (count - len(parts))
