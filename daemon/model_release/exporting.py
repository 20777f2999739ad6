"""Exports for the monitor, in a process of their own: `python -m daemon.model_release.exporting`, started by it alone.

Standard input holds the request as JSON; standard output gets the file, piece by piece; standard error the sentence
why there is none.
"""

import io
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from config.schema import Configuration
from daemon.history.columns.kinds import TEMPERATURES, WRITES
from daemon.history.export import Tabular, write_csv, write_parquet
from daemon.history.reader import HistoryReader
from daemon.history.tables import EVENTS, Table, TableColumn, TableType, Values
from daemon.model_release.past_recordings import (
    MINUTE_S,
    Minutes,
    commissioned_um_per_unit,
    minutes_of_history,
    used_channels,
    what_is_left_out,
)
from models.errors import RefusedInputError
from models.recordings.dataset import DatasetError

NICENESS = 15
REFUSED = 3
"""Exit status when there is nothing to export."""
TABLES = {"temperatures": TEMPERATURES, "writes": WRITES.name, "events": EVENTS}
"""What can be asked for beside recordings -> kind of record."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    what: str
    format: str
    from_s: float
    to_s: float


class RecordingTable:
    """One-minute means under the usual names of a recording, as `toolpoint thermal train` reads them."""

    def __init__(self, configuration: Configuration, reader: HistoryReader, export: Export) -> None:
        """Raise DatasetError where no displacement is measured, or none in that time."""
        self._channels = used_channels(configuration)
        if not self._channels:
            raise DatasetError(
                "a recording holds displacements beside temperatures, and no axis of this machine follows a channel "
                "that is measured; download temperatures instead"
            )
        self._minutes = minutes_of_history(
            configuration, reader, self._channels, commissioned_um_per_unit(configuration), export.from_s, export.to_s
        )
        self._first = next(self._minutes, None)
        if self._first is None:
            raise DatasetError(
                "no displacements were measured in that time; a recording needs them, choose another"
                + what_is_left_out(reader, export.from_s)
            )
        names = ["utc_s", "spindle_speed_rpm", *(f"t{i}" for i in configuration.temperatures.sensor_ids)]
        names += [*configuration.cnc.axis_positions, *(f"{channel}_um" for channel in self._channels)]
        self.columns = tuple(TableColumn(name=name, type=TableType.NUMBER) for name in names)

    def windows(self) -> Iterator[list[Values]]:
        """Yield the means, per column."""
        assert self._first is not None
        yield _values(self._first)
        for piece in self._minutes:
            yield _values(piece)


def _values(piece: Minutes) -> list[Values]:
    return [MINUTE_S * piece.minute, piece.speed_rpm, *piece.degc.T, *piece.positions_mm.T, *piece.own_um.T]


def write(configuration: Configuration, export: Export, stream: BinaryIO) -> None:
    """Write what is asked for; raises DatasetError or HistoryError with a sentence when there is none."""
    with HistoryReader(configuration.history.path) as reader:
        table: Tabular
        if export.what == "recording":
            table = RecordingTable(configuration, reader, export)
        else:
            table = Table(reader, TABLES[export.what], export.from_s, export.to_s)
            if table.window_count == 0:
                raise DatasetError(f"no {export.what} were recorded in that time; choose another")
        if export.format == "parquet":
            write_parquet(table, stream)
        else:
            text = io.TextIOWrapper(stream, encoding="utf-8", newline="")
            write_csv(table, text)
            text.flush()
            text.detach()


def main() -> None:
    """Answer one request."""
    os.nice(NICENESS)
    request = json.load(sys.stdin)
    configuration = Configuration.model_validate_json(request.pop("configuration"))
    np.seterr(all="ignore")
    try:
        write(configuration, Export(**request), sys.stdout.buffer)
        sys.stdout.flush()
    except (RefusedInputError, DatasetError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(REFUSED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
