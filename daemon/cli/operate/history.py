"""`toolpoint history` and `toolpoint export`: look into the store, also while the daemon writes it."""

import itertools
import math
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FILE, config_option, option, read_configuration, refuse, say, write_json
from daemon.cli.operate.history_view import (
    FAR_FUTURE_S,
    NEWEST,
    duration,
    iso,
    moment,
    print_rows,
    sensor_list,
    until,
    view,
)
from daemon.cli.options import ProgressBar, json_option
from daemon.history.columns.kinds import TEMPERATURES
from daemon.history.reader import HistoryReader
from daemon.history.restart_reader import TABLES
from daemon.history.tables import EVENTS, Table
from models.json_values import plain
from models.records import ProbeSample

KINDS_SHOWN = ("summary", "writes", "events", "probes", "estimates", "cnc")
RECORDING = "recording"
KINDS_EXPORTED = (TEMPERATURES, "displacements", "cnc", "estimates", "writes", EVENTS, RECORDING)
FORMATS = ("csv", "parquet")
store_option = option("--store", type=FILE, help="The store's file (else the configuration's history.path).")


@contextmanager
def open_history(store: Path | None, config_path: Path) -> Iterator[HistoryReader]:
    """Open the store, or end with a sentence and the status for bad usage."""
    path = store or read_configuration(config_path).history.path
    with HistoryReader(path) as reader:
        yield reader


@click.command()
@click.argument("what", type=click.Choice(KINDS_SHOWN), default="summary")
@config_option
@store_option
@option("--last", "last_s", callback=duration, default="1h", help="How far back to look.")
@option("--limit", type=click.IntRange(min=1), default=50, help="Rows shown, newest kept.")
@json_option
def history(what: str, config_path: Path, store: Path | None, last_s: float, limit: int, json_path: str | None) -> None:
    """Show what the daemon recorded: WHAT is summary, writes, events, probes, estimates or cnc."""
    with open_history(store, config_path) as reader:
        if what == "summary":
            content = summary(reader)
            write_json(json_path, content)
            if json_path is None:
                _print_summary(content)
            return
        from_utc_s = time.time() - last_s
        if json_path is None:
            _print_view(reader, what, from_utc_s, limit)
        else:
            write_json(json_path, rows_of(reader, what, from_utc_s))


def summary(reader: HistoryReader) -> dict[str, Any]:
    kinds = {}
    for kind in TABLES:
        extent = reader.extent(kind)
        kinds[kind] = {
            "rows": reader.row_count(kind),
            "first_utc": iso(extent[0]) if extent else None,
            "last_utc": iso(extent[1]) if extent else None,
        }
    return {
        "store": str(reader.path),
        "size_bytes": sum(f.stat().st_size for f in (reader.path, Path(f"{reader.path}-wal")) if f.is_file()),
        "sensors": len(reader.sensor_ids()),
        "kinds": kinds,
        "acknowledged_cycle": reader.acknowledged(),
        "writes_without_outcome": [record.write_id for record in reader.unsettled_writes()],
    }


def rows_of(reader: HistoryReader, what: str, from_utc_s: float) -> list[dict[str, Any]]:
    """Return records since a time as rows of names and plain values, oldest first."""
    if what == "events":
        events = reader.events(from_utc_s, FAR_FUTURE_S)
        return [{"time_utc": iso(e.time_s), "kind": e.kind, "text": e.text, "person": e.person} for e in events]
    if what == "probes":
        return [_probe_row(probe) for probe in reader.probes(from_utc_s, FAR_FUTURE_S)]
    table = Table(reader, what, from_utc_s, FAR_FUTURE_S)
    names = [column.name for column in table.columns]
    rows: list[dict[str, Any]] = []
    for window in table.windows():
        columns = [[_plain(value) for value in values] for values in window]
        rows += [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
    return rows


def _probe_row(probe: ProbeSample) -> dict[str, Any]:
    numbers = {name: getattr(probe, name) for name in ("deviation_um", "applied_um", "thermal_error_um")}
    return {
        "time_utc": iso(probe.time.utc_s),
        "axis": probe.axis,
        **plain(numbers),
        "reference_id": probe.reference_id,
        "accepted": probe.accepted,
        "reason": probe.reason,
    }


def _plain(value: Any) -> Any:
    """Return a cell as JSON has it; None where there is no value."""
    if value is None or isinstance(value, str):
        return value
    if value.dtype.kind == "M":
        text = str(value)
        return None if text == "NaT" else f"{text}Z"
    plain = value.item()
    if isinstance(plain, float) and not math.isfinite(plain):
        return None if math.isnan(plain) else str(plain)
    return plain


def _print_summary(content: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table as RichTable

    table = RichTable(title=f"{content['store']}: {content['size_bytes'] / 2**20:.1f} MiB")
    table.add_column("records")
    table.add_column("rows", justify="right")
    table.add_column("first")
    table.add_column("last")
    for kind, found in content["kinds"].items():
        table.add_row(kind, f"{found['rows']:,}", found["first_utc"] or "-", found["last_utc"] or "-")
    console = Console()
    console.print(table)
    cycles = ", ".join(f"{line} {number}" for line, number in content["acknowledged_cycle"].items()) or "none yet"
    console.print(f"sensors: {content['sensors']}; last cycle committed of each line: {cycles}", markup=False)
    if open_writes := content["writes_without_outcome"]:
        console.print(f"writes without a known outcome: {open_writes}", style="yellow")


def _print_view(reader: HistoryReader, what: str, from_utc_s: float, limit: int) -> None:
    headings, rows = view(reader, what, from_utc_s)
    if not rows:
        extent = reader.extent(what)
        newest = f"the newest is of {iso(extent[1])}" if extent else "the store has none at all"
        click.echo(f"No {what} in this time; {newest}.")
        return
    shown = rows[-limit:]
    title = f"{what}: {len(shown)} of {len(rows)} rows" if len(shown) < len(rows) else f"{what}: {len(rows)} rows"
    print_rows(title, headings, shown)


@click.command()
@config_option
@store_option
@option("--what", type=click.Choice(KINDS_EXPORTED), required=True, help="Which records.")
@option("--from", "from_utc_s", callback=moment, required=True, help="Start: ISO 8601 (UTC without offset) or -24h.")
@option("--to", "to_utc_s", callback=until, default=NEWEST, help="End, not included.")
@option("--sensors", callback=sensor_list, help="Sensor IDs, such as 1-5,7 (temperatures only).")
@option("--quality", is_flag=True, help="Add quality and reason of every temperature.")
@option(
    "--format",
    "format_",
    type=click.Choice(FORMATS),
    help="Else by the file's suffix: .parquet or .csv; CSV for any other.",
)
@option(
    "-o", "--output", type=click.Path(path_type=Path, allow_dash=True), required=True, help="File; '-': CSV to stdout."
)
def export(
    config_path: Path,
    store: Path | None,
    what: str,
    from_utc_s: float,
    to_utc_s: float,
    sensors: tuple[int, ...] | None,
    quality: bool,
    format_: str | None,
    output: Path,
) -> None:
    """Export records as CSV or Parquet, units in the column names. Reads a running daemon's store too.

    A recording holds what `thermal train` reads: means of one minute of temperatures, spindle speed, and displacements
    without what the NC has applied; every stretch with displacements becomes a file of its own.
    """
    if what != TEMPERATURES and (sensors or quality):
        refuse(f"--sensors and --quality go with --what temperatures, not with {what}")
    suffix = output.suffix.lower().removeprefix(".")
    if format_ is not None and suffix in FORMATS and suffix != format_:
        refuse(f"--format {format_} does not go with a file named {output.name}; leave one of them out")
    format_ = format_ or (suffix if suffix in FORMATS else "csv")
    if format_ == "parquet" and str(output) == "-":
        refuse("a Parquet file cannot go to standard output; give a file with -o")
    if to_utc_s <= from_utc_s:
        refuse(f"--to ({iso(to_utc_s)}) must be later than --from ({iso(from_utc_s)})")
    if what == RECORDING:
        _write_recordings(config_path, store, output, format_, from_utc_s, to_utc_s)
        return
    with open_history(store, config_path) as reader:
        if unknown := sorted(set(sensors or ()) - set(reader.sensor_ids())):
            refuse(f"{reader.path}: the store knows no sensors {unknown}")
        table = Table(reader, what, from_utc_s, to_utc_s, sensor_ids=sensors, quality=quality)
        if table.window_count == 0:
            extent = reader.extent(what)
            held = f"it has them from {iso(extent[0])} to {iso(extent[1])}" if extent else "it has none at all"
            to = NEWEST if to_utc_s == FAR_FUTURE_S else iso(to_utc_s)
            refuse(f"{reader.path}: no {what} from {iso(from_utc_s)} to {to}; {held}")
        rows = _write(table, output, format_)
        say(f"{rows} rows of {what} written to {output}")


def _write_recordings(
    config_path: Path, store: Path | None, output: Path, format_: str, from_utc_s: float, to_utc_s: float
) -> None:
    """Write recordings, and say how to train on them; the configuration says which axis follows which displacement."""
    from daemon.model_release.recording_files import write_recordings

    if format_ != "csv" or output.suffix.lower() != ".csv":
        refuse(f"{output}: a recording is a CSV file; name one that ends in .csv")
    configuration = read_configuration(config_path)
    try:
        with HistoryReader(store or configuration.history.path) as reader:
            paths = write_recordings(configuration, reader, output, from_utc_s=from_utc_s, to_utc_s=to_utc_s)
    except OSError as error:
        refuse(f"{output}: cannot be written ({error.strerror})")
    recordings = [str(path) for path in paths if path.suffix == ".csv"]
    with_map = [text for path in paths if path.suffix == ".yaml" for text in ("--map", str(path))]
    say(f"{len(recordings)} recording(s): {', '.join(recordings)}")
    command = shlex.join(["toolpoint", "thermal", "train", *recordings, *with_map])
    say(f"train on them with: {command} --model default -o model.json")


def _write(table: Table, output: Path, format_: str) -> int:
    from daemon.history.export import complete_file, write_csv, write_parquet

    done = itertools.count(1)
    with ProgressBar() as bar:

        def advance() -> None:
            bar.show(f"exporting {table.what}", next(done), table.window_count)

        if str(output) == "-":
            return write_csv(table, sys.stdout, advance)
        with complete_file(output) as partial:
            if format_ == "parquet":
                return write_parquet(table, partial, advance)
            with partial.open("w", encoding="utf-8", newline="") as stream:
                return write_csv(table, stream, advance)
