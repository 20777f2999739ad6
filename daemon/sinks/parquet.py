"""The Parquet sink: one file per machine, kind of record and day (UTC), written when the day is over, or not at all.

A day is written again when rows of it come late, always from the store, so that a repeat makes the same file. What a
file has and the store has no longer, or never had, stays in it.
"""

import hashlib
import io
import json
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
import pyarrow
import structlog
from pyarrow import compute, fs, parquet

from config.files import write_whole
from config.schema.sinks import SinkConfig
from daemon.history.columns.kinds import KINDS, TEMPERATURES
from daemon.history.cursors import Cursor, Position
from daemon.history.export import Tabular, arrow_type
from daemon.history.series import NOT_IN_CYCLE, TemperatureHistory
from daemon.history.tables import Table, TableColumn, TableType, Values, names_of
from daemon.sinks.contract import Progress, SinkError
from daemon.sinks.outbox import STREAMS, Outbox, Stream
from models.quality import Quality, Reason

log = structlog.get_logger(__name__)
DAY_S = 86_400.0
GRACE_S = 7200.0
"""A day is written this long after its end: its last writes have found their outcome by then."""
LOOK_PERIOD_S = 60.0
LONGEST_NAME = 255
"""Bytes that a name may have in a folder."""
LEVEL = 18
"""Of the compression: two seconds of processor time for a day, an eighth less room than 9; 19 takes 40 MiB more."""
ONE_PAGE = 2**30
TIME = "time_utc"
HINTS = {
    "ACCESS_DENIED": "check the keys in the unit's environment, their rights there, and this computer's clock",
    "INVALID_ACCESS_KEY_ID": "check AWS_ACCESS_KEY_ID in the unit's environment",
    "SIGNATURE": "check AWS_SECRET_ACCESS_KEY in the unit's environment",
    "HTTP status 400)": "check the keys in the unit's environment: temporary ones (AWS_SESSION_TOKEN) expire",
    "configured region": "check `region=` in `folder`",
    "NO_SUCH_BUCKET": "there is no such bucket: check `folder`",
    "NETWORK_CONNECTION": "check `folder`, the network, and that the server runs",
    "Errno 28]": "free space on its disk",
    "Errno 122]": "the service's user has used up its quota there: raise it, or free space",
    "Errno 13]": "let the service's user write there (a group, and SupplementaryGroups= of the unit)",
    "Errno 30]": "let the unit write there: a line ReadWritePaths= (systemctl edit toolpoint-sink)",
}
"""What an object store or this computer says -> what to do."""
DELTAS = 128
"""So many differences are packed together: times that come again for each sensor begin such a block, to look alike."""


class ParquetSink:
    """Files in a folder, or in a bucket of an object store."""

    def __init__(self, config: SinkConfig, machine: str, now_utc_s: Callable[[], float] = time.time) -> None:
        assert config.parquet is not None
        self._config, self._machine, self._now_utc_s = config.parquet, machine, now_utc_s
        self._place = config.place
        self._where = f"sink {config.name}: {self._place}"
        self._files: _Files | None = None
        self._look_after_s = float("-inf")
        if not (folder := self._config.folder).startswith("/"):
            self._reach(f"{folder}{'&' if '?' in folder else '?'}region=none" if folder.startswith("s3:") else folder)

    def open(self, cursor: Cursor) -> Mapping[str, Position]:
        """Reach the folder or the bucket; the cursor says how far it is."""
        self._files = self._reach(self._config.folder)
        return cursor.positions

    def _reach(self, address: str) -> "_Files":
        """Return where files go; the network is asked only where the address of a bucket names no region."""
        try:
            return _Folder(Path(address)) if address.startswith("/") else _ObjectStore(address)
        except (OSError, ValueError) as error:
            why = str(error).replace(address, self._place)
            if "parse URI" in why:
                why += ": in a key, / is written %2F and + %2B; better put the keys into the unit's environment"
            raise SinkError(f"{self._where} cannot be reached: {why}") from None

    def close(self) -> None:
        """Nothing stays open."""

    def needs_rows(self) -> bool:
        return True

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        """Write a day that is over; where there is none, look again in a minute."""
        if time.monotonic() < self._look_after_s:
            return False
        today = int((self._now_utc_s() - GRACE_S) // DAY_S)
        for stream in STREAMS.values():
            before = progress.position(stream.name)
            days, after = outbox.days(stream, before)
            if days and days[0] < today:
                rows = self._write(outbox, stream, days[0])
                newest_utc_s = (days[0] + 1) * DAY_S
                progress.acknowledged(stream.name, _waiting(after, days[1:]), newest_utc_s, sent=rows, stored=rows)
                return True
            if (position := _waiting(after, days)) != before:
                progress.acknowledged(stream.name, position, None, sent=0, stored=0)
        self._look_after_s = time.monotonic() + LOOK_PERIOD_S
        return False

    def _write(self, outbox: Outbox, stream: Stream, day: int) -> int:
        """Write one day of a stream; return its records, 0 where the file there has all of them and more."""
        assert self._files is not None
        date = datetime.fromtimestamp(day * DAY_S, UTC).date().isoformat()
        name = f"{stream.name}/{machine_folder(self._machine)}/{date}.parquet"
        file = day_file(outbox, stream, day)
        try:
            if file.rows == 0 or (content := _with_what_is_there(file, partial(self._files.read, name))) is None:
                return 0
            self._files.put(name, content)
        except OSError as error:
            why = re.sub(r" \(Request ID: [^)]*\)", "", str(error))  # another one every time would be a new problem
            hint = next((hint for sign, hint in HINTS.items() if sign in why), "it is tried again")
            raise SinkError(f"{self._where}: {name} cannot be written: {why}: {hint}") from error
        except (pyarrow.ArrowException, KeyError) as error:
            raise SinkError(
                f"{self._where}: {name}: what stands there is no such file, or damaged: move it away ({error})"
            ) from error
        return file.records


def machine_folder(machine: str) -> str:
    """Return the folder of a machine's files, by which readers know it, of a length that every system takes.

    What is no ASCII letter, digit, blank or one of -._~ stands there by its bytes after a %. Where that is too long,
    letters of other scripts stand as they are; where that is too long too, the name is cut, and a hash keeps it apart.
    """
    pieces = [each if each > "\x7f" else quote(each, safe=" ") for each in machine]
    for name in (quote(machine, safe=" "), "".join(pieces)):
        if len(f"machine={name}".encode()) <= LONGEST_NAME:
            return f"machine={name}"
    end = f"~{hashlib.sha256(machine.encode()).hexdigest()[:16]}"
    while len(f"machine={''.join(pieces)}{end}".encode()) > LONGEST_NAME:
        pieces.pop()
    return f"machine={''.join(pieces)}{end}"


def _waiting(after: Position, days: list[int]) -> Position:
    """Return a position from which these days are still to be written."""
    needed_from_ms = int(days[0] * DAY_S * 1e3) if days else None
    return Position(row=after.row, chunk=after.chunk, needed_from_ms=needed_from_ms)


# --- where the files go --------------------------------------------------------------------


class _Files(Protocol):
    def read(self, name: str, columns: list[str] | None) -> pyarrow.Table | None:
        """Return these columns of a file (None: all), or None where there is none."""

    def put(self, name: str, content: bytes) -> None:
        """Put a file in its place, whole or not at all."""


class _Folder:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        if not folder.is_dir():
            raise OSError("there is no such folder: make it, and let the service's user write in it")

    def read(self, name: str, columns: list[str] | None) -> pyarrow.Table | None:
        path = self._folder / name
        return _read(path, columns) if path.exists() else None

    def put(self, name: str, content: bytes) -> None:
        path = self._folder / name
        for folder in (path.parent.parent, path.parent):
            if not folder.is_dir():
                folder.mkdir()
                folder.chmod(0o755)
        write_whole(path, content, 0o644)


class _ObjectStore:
    """A bucket; what is put there appears when it is complete."""

    def __init__(self, address: str) -> None:
        if "endpoint_override=" in address:  # servers other than Amazon's keep a checksum that follows as a part of it
            os.environ.setdefault("AWS_REQUEST_CHECKSUM_CALCULATION", "WHEN_REQUIRED")
        self._files, self._root = fs.FileSystem.from_uri(address)

    def read(self, name: str, columns: list[str] | None) -> pyarrow.Table | None:
        path = f"{self._root}/{name}"
        if self._files.get_file_info(path).type == fs.FileType.NotFound:
            return None
        with self._files.open_input_file(path) as file:
            return _read(file, columns)

    def put(self, name: str, content: bytes) -> None:
        path, size = f"{self._root}/{name}", None
        for _ in range(2):
            with self._files.open_output_stream(path) as stream:
                stream.write(content)
            if (size := self._files.get_file_info(path).size) == len(content):
                return
        with suppress(OSError):
            self._files.delete_file(path)  # it would be taken for a file of somebody else, which is left alone
        raise OSError(f"of {len(content)} bytes {size or 0} stand there afterwards")


def _read(file: Path | io.BytesIO | pyarrow.NativeFile, columns: list[str] | None) -> pyarrow.Table:
    with parquet.ParquetFile(file) as opened:
        return opened.read(columns=columns)


def _with_what_is_there(file: "DayFile", read: Callable[[list[str] | None], pyarrow.Table | None]) -> bytes | None:
    """Return a day with the rows of the file there whose times it lacks; None where that file is to stay."""
    if (there := read([TIME])) is None:
        return file.content
    before, now = there[TIME].unique(), _read(io.BytesIO(file.content), [TIME])[TIME].unique()
    if compute.all(compute.is_in(before, value_set=now)).as_py():
        return file.content if file.rows >= there.num_rows else None
    if compute.all(compute.is_in(now, value_set=before)).as_py():
        return None
    whole = read(None)
    assert whole is not None
    lacking = whole.filter(compute.invert(compute.is_in(whole[TIME], value_set=now)))
    log.warning("parquet.joined", rows=lacking.num_rows, why="the file has rows that the store has not")
    joined = pyarrow.concat_tables([_read(io.BytesIO(file.content), None), lacking], promote_options="default")
    return _written(joined.schema, [(joined, file.records)]).content


# --- the content of a day ------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class DayFile:
    content: bytes
    rows: int
    """Of the file: a cycle of temperatures has one per sensor."""
    records: int
    """Rows of the stream."""


def day_file(outbox: Outbox, stream: Stream, day: int) -> DayFile:
    span = day * DAY_S, (day + 1) * DAY_S
    if stream.name == TEMPERATURES:
        return _written(_TEMPERATURES, _lines(outbox, *span))
    table: Tabular = Table(outbox, stream.name, *span) if stream.name in KINDS else _Unpacked(outbox, stream, *span)
    schema = pyarrow.schema([(column.name, arrow_type(pyarrow, column.type)) for column in table.columns])
    windows = [_table(schema, each) for each in table.windows()]
    whole = pyarrow.concat_tables(windows) if windows else schema.empty_table()
    return _written(schema, [(whole, whole.num_rows)] if whole.num_rows else [])


def _written(schema: pyarrow.Schema, groups: Iterable[tuple[pyarrow.Table, int]]) -> DayFile:
    """Write tables as row groups of one page per column each, where alike values compress together.

    Numbers have 64 bits, split into bytes: a temperature's sixteenths stand in one byte and its whole degrees in
    another; in 32 bits the two share bytes, and the file is a quarter larger. (Of integers DuckDB reads this encoding
    since version 2 only.)
    """
    few, encodings = [], {}
    for field in schema:
        if pyarrow.types.is_floating(field.type):
            encodings[field.name] = "BYTE_STREAM_SPLIT"
        elif pyarrow.types.is_timestamp(field.type) or pyarrow.types.is_int64(field.type):
            encodings[field.name] = "DELTA_BINARY_PACKED"
        else:
            few.append(field.name)
    content, records = io.BytesIO(), 0
    with parquet.ParquetWriter(
        content,
        schema,
        compression="zstd",
        compression_level=LEVEL,
        use_dictionary=few,
        column_encoding=encodings,
        write_statistics=[TIME, "line", "sensor_id"],  # those of every macro would be a twentieth of the file
        store_schema=False,  # the types that Arrow alone has; of a wide table as large as all that a reader needs
        data_page_size=ONE_PAGE,
        max_rows_per_page=ONE_PAGE,
    ) as writer:
        for table, records_of_it in groups:
            writer.write_table(table, row_group_size=table.num_rows)
            records += records_of_it
            del table  # before the next is made: each is tens of megabytes
    written = content.getvalue()
    return DayFile(content=written, rows=parquet.read_metadata(io.BytesIO(written)).num_rows, records=records)


def _table(schema: pyarrow.Schema, columns: Iterable[Values]) -> pyarrow.Table:
    arrays = [
        pyarrow.array(values, type=field.type, from_pandas=True) for field, values in zip(schema, columns, strict=True)
    ]
    return pyarrow.Table.from_arrays(arrays, schema=schema)


def _lines(outbox: Outbox, from_utc_s: float, to_utc_s: float) -> Iterator[tuple[pyarrow.Table, int]]:
    """Yield per line its values, sensor by sensor, as the plant's database shows them, and its cycles.

    A column for each sensor instead would cost a tenth more for its description alone.
    """
    for line, sensor_ids in outbox.lines().items():
        table, cycles = _line(outbox.temperatures(sensor_ids, from_utc_s, to_utc_s), line)
        if cycles:
            yield table, cycles


def _line(history: TemperatureHistory, line: str) -> tuple[pyarrow.Table, int]:
    own = (history.quality != NOT_IN_CYCLE) & (np.array(history.line) == line)[:, None]
    whole = len(own) // DELTAS * DELTAS

    def by_sensor(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        values = np.broadcast_to(values, own.shape)
        return np.concatenate([values[part].T[own[part].T] for part in (slice(whole), slice(whole, None))])

    columns = (
        by_sensor(np.rint(history.time_s * 1e3).astype("datetime64[ms]")[:, None]),
        _coded({0: line}, np.zeros(np.count_nonzero(own), dtype=np.uint8)),
        by_sensor(history.number[:, None]),
        by_sensor(np.array(history.sensor_ids, dtype=np.int32)),
        by_sensor(history.degc),
        _coded(names_of(Quality), by_sensor(history.quality)),
        _coded(names_of(Reason), by_sensor(history.reason)),
    )
    return _table(_TEMPERATURES, columns), int(np.count_nonzero(own.any(axis=1)))


def _coded(names: Mapping[int, str], codes: npt.NDArray[np.uint8]) -> pyarrow.DictionaryArray:
    """Return texts that are few."""
    found = np.unique(codes)
    words = [names.get(code, str(code)) for code in found.tolist()]
    index_of = np.zeros(256, dtype=np.int8)
    index_of[found] = np.arange(found.size)
    return pyarrow.DictionaryArray.from_arrays(index_of[codes], words)


_WORD = pyarrow.dictionary(pyarrow.int8(), pyarrow.string())
_TEMPERATURES = pyarrow.schema(
    {
        "time_utc": pyarrow.timestamp("ms", tz="UTC"),
        "line": _WORD,
        "cycle": pyarrow.int64(),
        "sensor_id": pyarrow.int32(),
        "degc": pyarrow.float64(),
        "quality": _WORD,
        "reason": _WORD,
    }
)


class _Unpacked:
    """Rows of a stream that is never packed, as a table."""

    def __init__(self, outbox: Outbox, stream: Stream, from_utc_s: float, to_utc_s: float) -> None:
        self._rows = outbox.unpacked_rows(stream, int(from_utc_s * 1e3), int(to_utc_s * 1e3))
        names = ("time_utc", *stream.columns[1:])
        self.columns = [TableColumn(name=name, type=_TYPES.get(name, TableType.TEXT)) for name in names]

    def windows(self) -> Iterator[list[Values]]:
        if self._rows:
            columns = zip(*self._rows, strict=True)
            yield [_values(column.type, values) for column, values in zip(self.columns, columns, strict=True)]


_TYPES = {
    "time_utc": TableType.TIME,
    **dict.fromkeys(("monotonic_ms", "program", "work_offset", "power_on_count"), TableType.INTEGER),
    **dict.fromkeys(("deviation_um", "applied_um", "thermal_error_um"), TableType.NUMBER),
    "accepted": TableType.FLAG,
}


def _values(type_: TableType, values: tuple[Any, ...]) -> Values:
    if type_ is TableType.TEXT:
        return [json.dumps(value) if isinstance(value, list) else value for value in values]
    numbers = {TableType.TIME: "datetime64[ms]", TableType.NUMBER: "f8", TableType.FLAG: "?"}
    made: Values = np.array(values, dtype=numbers.get(type_, "i8"))
    return made
