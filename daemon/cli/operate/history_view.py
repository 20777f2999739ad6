"""Records as rows that fit a terminal."""

import re
import textwrap
import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import click
import numpy as np

from config.schema.temperatures import expand_ranges
from daemon.history.reader import HistoryReader
from models.json_values import printable
from models.records import WriteOutcome

if TYPE_CHECKING:
    from rich.text import Text

FAR_FUTURE_S = 2.0**40
NEWEST = "newest"
STYLES = {
    WriteOutcome.VERIFIED: "green",
    WriteOutcome.INTENDED: "yellow",
    WriteOutcome.DIFFERS: "red",
    WriteOutcome.FAILED: "red",
    WriteOutcome.REFUSED: "red",
}
WIDEST = 10_000
"""No table is wider [character]."""
INDENT = "    "
"""Before the second and later lines of a record."""
Cell = str | tuple[str, str]
"""Text, or text and its style."""
View = tuple[tuple[str, ...], list[tuple[Cell, ...]]]
"""Headings, and the rows."""


def view(reader: HistoryReader, what: str, from_utc_s: float) -> View:
    """Return records since a time, oldest first."""
    return {"writes": _writes, "events": _events, "estimates": _estimates, "cnc": _cnc, "probes": _probes}[what](
        reader, from_utc_s
    )


def print_rows(title: str, headings: tuple[str, ...], rows: list[tuple[Cell, ...]]) -> None:
    """Print a table where it fits; else each record over several lines of a terminal, or in one line of a pipe.

    Nothing is ever cut, and no record is as wide as the widest.
    """
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    table = Table(*headings, title=title, title_justify="left")
    texts = [[Text(printable(cell)) if isinstance(cell, str) else Text(*cell) for cell in row] for row in rows]
    for row in texts:
        table.add_row(*row)
    console = Console()
    needed = Measurement.get(console, console.options.update(max_width=WIDEST), table).maximum
    if needed <= console.width:
        console.print(table)
        return
    console.print(title, style="italic", markup=False)
    for row in texts:
        console.print(_record(headings, row, console.width if console.is_terminal else WIDEST), soft_wrap=True)


def _record(headings: tuple[str, ...], cells: "list[Text]", width: int) -> "Text":
    """Return one record as lines of 'heading value', wrapped between words only."""
    from rich.text import Text

    lines, used = Text(), 0
    for heading, cell in zip(headings, cells, strict=True):
        if not cell.plain or cell.plain == "-":
            continue
        piece = cell if heading == "UTC" else Text.assemble((f"{heading} ", "dim"), cell)
        if used and used + 2 + len(piece) > width:
            lines.append("\n")
            used = 0
        if len(piece) > width - len(INDENT):
            wrapped = textwrap.wrap(piece.plain, width, initial_indent=INDENT, subsequent_indent=2 * INDENT)
            lines.append(("" if not used else "\n") + "\n".join(wrapped))
            used = width
            continue
        before = "  " if used else INDENT if lines.plain else ""
        lines.append(before)
        lines.append_text(piece)
        used += len(before) + len(piece)
    return lines


def _writes(reader: HistoryReader, from_utc_s: float) -> View:
    headings = (
        "id",
        "UTC",
        "cause",
        "state",
        "outcome",
        "written um",
        "applied um",
        "feedback ms",
        "echoed s",
        "reason",
    )
    rows: list[tuple[Cell, ...]] = []
    for record in reader.writes(from_utc_s, FAR_FUTURE_S):
        feedback_s = record.delay_s.get("read_back")
        rows.append(
            (
                str(record.write_id),
                iso(record.time_s),
                " by ".join(word for word in (record.cause, record.person) if word),
                record.state or "-",
                (record.outcome.name.lower(), STYLES[record.outcome]),
                _signed(record.compensation_um) if record.compensation_um else _macros(record.macros),
                _signed(record.applied_um),
                "-" if feedback_s is None else f"{feedback_s * 1e3:.1f}",
                "-" if record.echoed_after_s is None else f"{record.echoed_after_s:.1f}",
                record.detail or record.reason or "",
            )
        )
    return headings, rows


def _events(reader: HistoryReader, from_utc_s: float) -> View:
    events = reader.events(from_utc_s, FAR_FUTURE_S)
    return ("UTC", "kind", "text", "person"), [(iso(e.time_s), e.kind, e.text, e.person or "-") for e in events]


def _probes(reader: HistoryReader, from_utc_s: float) -> View:
    headings = ("UTC", "axis", "deviation um", "applied um", "estimate um", "taken", "reason")
    rows: list[tuple[Cell, ...]] = [
        (
            iso(probe.time.utc_s),
            probe.axis,
            f"{probe.deviation_um:+.2f}",
            f"{probe.applied_um:+.2f}",
            f"{probe.thermal_error_um:+.2f}",
            ("yes", "green") if probe.accepted else ("no", "yellow"),
            probe.reason,
        )
        for probe in reader.probes(from_utc_s, FAR_FUTURE_S)
    ]
    return headings, rows


def _estimates(reader: HistoryReader, from_utc_s: float) -> View:
    found = reader.estimates(from_utc_s, FAR_FUTURE_S)
    headings = ("UTC", "line", "thermal error um", "band um", "domain", "confidence", "model", "reference")
    rows: list[tuple[Cell, ...]] = [
        (
            iso(time_s),
            found.line[k],
            _signed({channel: values[k] for channel, values in found.thermal_error_um.items()}),
            _widest(values[k] for values in found.band_um.values()),
            "inside" if found.in_domain[k] else ("outside", "yellow"),
            f"{found.confidence[k]:.0%}",
            found.model_id[k],
            found.reference_id[k] or "none",
        )
        for k, time_s in enumerate(found.time_s)
    ]
    return headings, rows


def _cnc(reader: HistoryReader, from_utc_s: float) -> View:
    found = reader.cnc(from_utc_s, FAR_FUTURE_S)
    headings = ("UTC", "mode", "run", "alarm", "block", "spindle rpm", "motor degC", "tool", "offset", "macros")
    rows: list[tuple[Cell, ...]] = [
        (
            iso(time_s),
            found.mode[k],
            found.run[k],
            ("yes", "red") if found.alarm[k] else "no",
            f"O{found.program[k]} N{found.sequence_number[k]}",
            f"{found.spindle_speed_rpm[k]:.0f}",
            f"{found.motor_temperature_degc[k]:.1f}",
            f"T{found.tool_number[k]}",
            f"G{found.work_offset[k]}",
            _macros((number, values[k]) for number, values in sorted(found.macros.items())),
        )
        for k, time_s in enumerate(found.time_s)
    ]
    return headings, rows


def _signed(numbers: Mapping[str, float | None]) -> str:
    """Return 'Y +1.25  Z -0.50', a dash where there is no number."""
    known = ((key, np.nan if value is None else value) for key, value in numbers.items())
    return "  ".join(f"{key} -" if np.isnan(value) else f"{key} {value:+.2f}" for key, value in known)


def _macros(numbers: Iterable[tuple[int, float]]) -> str:
    return "  ".join(f"#{number}={'vacant' if np.isnan(value) else f'{value:g}'}" for number, value in numbers)


def _widest(bands: Iterable[float]) -> str:
    known = [band for band in bands if not np.isnan(band)]
    return f"{max(known):.2f}" if known else "-"


_UNITS_S = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|d|w)")
_SENSORS = re.compile(r"\d+(-\d+)?(,\d+(-\d+)?)*")


def duration_s(text: str) -> float | None:
    """Return '90s', '5m', '1.5h', '2d' or '1w' as seconds; None when it is none of these."""
    match = _DURATION.fullmatch(text.strip())
    return float(match[1]) * _UNITS_S[match[2]] if match else None


def duration(_context: click.Context, _parameter: click.Parameter, text: str) -> float:
    """Return a length of time [s]; a callback of click."""
    seconds = duration_s(text)
    if not seconds:
        raise click.BadParameter(f"{text!r} is no length of time; write 90s, 5m, 1h, 2d or 1w")
    return seconds


def moment(_context: click.Context, _parameter: click.Parameter, text: str) -> float:
    """Return a point in time [s since 1970]: ISO 8601 (UTC without an offset), 'now', or -24h; a callback of click."""
    if text == "now":
        return time.time()
    if text.startswith("-") and (seconds := duration_s(text[1:])) is not None:
        return time.time() - seconds
    try:
        parsed = datetime.fromisoformat(text)
    except ValueError:
        raise click.BadParameter(
            f"{text!r} is no time; write 2026-03-01T08:00, 2026-03-01T08:00+01:00, now, or -24h"
        ) from None
    return (parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)).timestamp()


def until(context: click.Context, parameter: click.Parameter, text: str) -> float:
    """Return the end of a span: like `moment`; the newest record may be later than now (a replay's store)."""
    return FAR_FUTURE_S if text == NEWEST else moment(context, parameter, text)


def sensor_list(_context: click.Context, _parameter: click.Parameter, text: str | None) -> tuple[int, ...] | None:
    """Return sensor IDs such as 1-5,7, each once; a callback of click."""
    if text is None:
        return None
    compact = text.replace(" ", "")
    if not _SENSORS.fullmatch(compact):
        raise click.BadParameter(f"{text!r} is no list of sensors; write 1-5,7")
    try:
        ids = expand_ranges([part if "-" in part else int(part) for part in compact.split(",")])
    except ValueError as error:
        raise click.BadParameter(f"{text!r}: {error}") from error
    return tuple(dict.fromkeys(ids))


def iso(utc_s: float) -> str:
    """Return a point in time as ISO 8601 to the second, in UTC."""
    return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
