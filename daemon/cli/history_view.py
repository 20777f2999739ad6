"""Records as rows that fit a terminal."""

from collections.abc import Iterable, Mapping

import numpy as np

from daemon.cli.history_times import iso
from daemon.history import HistoryReader
from models.records import WriteOutcome

FAR_FUTURE_S = 2.0**40
STYLES = {
    WriteOutcome.VERIFIED: "green",
    WriteOutcome.INTENDED: "yellow",
    WriteOutcome.DIFFERS: "red",
    WriteOutcome.FAILED: "red",
    WriteOutcome.REFUSED: "red",
}
Cell = str | tuple[str, str]
"""Text, or text and its style."""
View = tuple[tuple[str, ...], list[tuple[Cell, ...]]]
"""Headings, and the rows."""


def view(reader: HistoryReader, what: str, from_utc_s: float) -> View:
    """Return records since a time, oldest first."""
    return {"writes": _writes, "events": _events, "estimates": _estimates, "cnc": _cnc, "probes": _probes}[what](
        reader, from_utc_s
    )


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
