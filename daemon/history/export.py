"""Tables of the history as CSV or Parquet files."""

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol, TextIO

import numpy as np

from daemon.history.database import HistoryError
from daemon.history.tables import TableColumn, TableType, Values

if TYPE_CHECKING:
    import pyarrow

Advance = Callable[[], None]


class Tabular(Protocol):
    """Columns, and their values piece by piece."""

    @property
    def columns(self) -> Sequence[TableColumn]:
        """The columns, in order."""

    def windows(self) -> Iterable[list[Values]]:
        """Yield per column its values."""


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """Give a temporary path; what is written there becomes `path` when all went well."""
    partial = path.with_name(path.name + ".partial")
    try:
        partial.unlink(missing_ok=True)  # a link that was put there is not followed
        yield partial
        partial.replace(path)
    except OSError as error:
        raise HistoryError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        partial.unlink(missing_ok=True)


def write_csv(table: Tabular, stream: TextIO, advance: Advance = lambda: None) -> int:
    """Write a table as CSV: a header, then one line per row, empty where there is no value. Returns the rows."""
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([column.name for column in table.columns])
    rows = 0
    for window in table.windows():
        cells = [cells_of(column, values) for column, values in zip(table.columns, window, strict=True)]
        writer.writerows(zip(*cells, strict=True))
        rows += len(cells[0])
        advance()
    return rows


def cells_of(column: TableColumn, values: Values) -> list[str]:
    """Return the texts of one column; numbers with as many digits as they need."""
    if isinstance(values, list):
        return [text or "" for text in values]
    if column.type is TableType.TIME:
        texts = np.datetime_as_string(values.astype("datetime64[ms]"), unit="ms").tolist()
        return ["" if text == "NaT" else f"{text}Z" for text in texts]
    if column.type is TableType.FLAG:
        return ["1" if flag else "0" for flag in values.tolist()]
    if column.type is TableType.INTEGER:
        return [str(number) for number in values.tolist()]
    return ["" if math.isnan(number) else repr(number) for number in values.astype(np.float64).tolist()]


def write_parquet(table: Tabular, path: Path | BinaryIO, advance: Advance = lambda: None) -> int:
    """Write a table as a Parquet file. Returns the rows. Raises HistoryError when pyarrow is not installed."""
    try:
        import pyarrow  # noqa: PLC0415 - an extra, loaded only when a Parquet file is asked for
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise HistoryError(
            "Parquet files need pyarrow, which is not installed: install toolpoint[parquet], or choose --format csv"
        ) from error
    schema = pyarrow.schema([(column.name, arrow_type(pyarrow, column.type)) for column in table.columns])
    rows = 0
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for window in table.windows():
            arrays = [
                pyarrow.array(values, type=field.type, from_pandas=True)
                for field, values in zip(schema, window, strict=True)
            ]
            writer.write_table(pyarrow.Table.from_arrays(arrays, schema=schema))
            rows += len(arrays[0])
            advance()
    return rows


def arrow_type(pyarrow: "pyarrow", type_: TableType) -> "pyarrow.DataType":
    """Return how Parquet files hold a type."""
    return {
        TableType.TIME: pyarrow.timestamp("ms", tz="UTC"),
        TableType.NUMBER: pyarrow.float64(),
        TableType.INTEGER: pyarrow.int64(),
        TableType.FLAG: pyarrow.bool_(),
        TableType.TEXT: pyarrow.string(),
    }[type_]
