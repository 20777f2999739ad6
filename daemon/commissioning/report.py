"""The report that a person signs: one HTML file, nothing loaded, nothing that runs, fit for paper."""

import hashlib
from collections.abc import Iterable, Sequence
from html import escape

from config.records.commissioning import PROOF_TOLERANCE, CommissioningRecord, commissioning_text, macro_map_digest
from config.schema import Configuration

STYLE = """
body { font: 11pt/1.4 sans-serif; color: #111; background: #fff; max-width: 180mm; margin: 12mm auto; }
h1 { font-size: 18pt; margin: 0 0 2mm; } h2 { font-size: 13pt; margin: 7mm 0 2mm; }
table { border-collapse: collapse; width: 100%; margin: 2mm 0; }
th, td { border: 0.3mm solid #777; padding: 1mm 2mm; text-align: left; vertical-align: top; }
th { background: #eee; }
table.readings { font-size: 8.5pt; } code { font-size: 9pt; overflow-wrap: anywhere; }
.signatures td { height: 16mm; width: 50%; vertical-align: bottom; }
.void { border: 0.6mm solid #900; padding: 2mm 3mm; }
tr, .signatures { page-break-inside: avoid; }
@page { size: A4; margin: 15mm; } @media print { body { margin: 0; max-width: none; } }
"""

PERMITS = (
    "The daemon may compensate the axes in the table of readings, on this control, through these macro variables, "
    "with this version of the guard, and no others. Bound, slew rate and step of the configuration still hold."
)
ENDS = (
    "another control: its identity differs",
    "a change of the macro map (numbers, unit, axes)",
    "another version of the guard program, or none",
    "an axis that is not in the table",
    "a change at the machine that turns, swaps or scales an axis; no program can see this, so repeat the "
    "commissioning after it",
)


def report_html(record: CommissioningRecord, configuration: Configuration) -> str:
    """Return the report of a record; every text of a person or a file is escaped."""
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">",
        f"<title>Commissioning of {escape(record.machine or record.cnc_identity)}</title>",
        f"<style>{STYLE}</style></head><body>",
        f"<h1>Commissioning of {escape(record.machine or record.cnc_identity)}</h1>",
        *_void(record, configuration),
        *_facts(record),
        "<h2>Readings</h2>",
        _readings(record),
        f"<p>Movement is the reading with the offset minus the mean of both readings at zero. Sign and scale count as "
        f"proved when the movement is within {PROOF_TOLERANCE:.0%} of the offset.</p>",
        "<h2>Limits in the configuration</h2>",
        _limits(record, configuration),
        "<h2>Macro variables</h2>",
        _macros(configuration),
        f"<h2>What this record permits</h2><p>{PERMITS}</p>",
        "<h2>When it becomes invalid</h2>",
        f"<ul>{''.join(f'<li>{escape(end)}</li>' for end in ENDS)}</ul>",
        "<h2>Signatures</h2>",
        "<p>I have seen the axes above move as the table says.</p>",
        '<table class="signatures"><tr>'
        f"<td>Commissioned by: {escape(record.person)}<br>Date, signature</td>"
        "<td>Checked by (name):<br>Date, signature</td></tr></table>",
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def record_digest(record: CommissioningRecord) -> str:
    """Return the digest of a record's file as it is written, by which paper and file can be held together."""
    return hashlib.sha256(commissioning_text(record).encode()).hexdigest()


def _void(record: CommissioningRecord, configuration: Configuration) -> Iterable[str]:
    if record.macro_map_sha256 != macro_map_digest(configuration.cnc.macros):
        yield (
            '<p class="void">This record does not fit the present configuration: the macro map has changed since. '
            "The macro variables and limits below are those of the present configuration.</p>"
        )


def _facts(record: CommissioningRecord) -> Iterable[str]:
    rows = (
        ("Machine", record.machine or "not named"),
        ("Control", record.cnc_identity),
        ("Date", record.date),
        ("Person", record.person),
        ("Instrument", record.instrument or "not named"),
        ("Guard version", "not named" if record.guard_version is None else str(record.guard_version)),
        ("Guard program, SHA-256", record.guard_program_sha256 or "not given"),
        ("Software", record.software or "not named"),
        ("Macro map, SHA-256", record.macro_map_sha256),
        ("Record, format and SHA-256 of its file", f"{record.format_version}, {record_digest(record)}"),
    )
    yield _table((), [(f"<b>{name}</b>", f"<code>{escape(value)}</code>") for name, value in rows])


def _readings(record: CommissioningRecord) -> str:
    rows = []
    for axis, found in record.axes.items():
        read = found.readings
        others = ", ".join(f"{escape(name)} {um:+.2f}" for name, um in found.others_um.items()) or "not observed"
        shown = ("-", "-", "-", "-", "not recorded")
        if read is not None:
            noise = "-" if read.noise_um is None else f"{read.noise_um:.2f} ({read.samples})"
            shown = (f"{read.before_um:.2f}", f"{read.at_offset_um:.2f}", f"{read.after_um:.2f}", noise, read.source)
        rows.append(
            (
                escape(axis),
                f"{found.written_um:+g}",
                *shown[:3],
                f"{found.measured_um:+.2f}",
                f"{found.sign:+d}",
                f"{found.scale:g}",
                shown[3],
                others,
                escape(shown[4]),
            )
        )
    head = (
        "axis",
        "offset [um]",
        "before [um]",
        "with offset [um]",
        "after [um]",
        "movement [um]",
        "sign",
        "scale",
        "noise [um] (samples)",
        "other axes [um]",
        "read by",
    )
    return _table(head, rows, "readings")


def _limits(record: CommissioningRecord, configuration: Configuration) -> str:
    rows = [
        (
            escape(name),
            "yes" if name in record.axes else "no",
            f"{axis.absolute_bound_um:g}",
            f"{axis.slew_um_per_min:g}",
            f"{axis.step_um:g}",
        )
        for name, axis in configuration.compensation.axes.items()
    ]
    return _table(("axis", "commissioned", "bound [um]", "slew rate [um/min]", "step [um]"), rows)


def _macros(configuration: Configuration) -> str:
    macros = configuration.cnc.macros
    rows = [("sequence_a", f"#{macros.sequence_a}")]
    rows += [(f"values.{axis}", f"#{number}") for axis, number in macros.values.items()]
    rows += [("valid_until", f"#{macros.valid_until}"), ("enable", f"#{macros.enable}")]
    rows += [("sequence_b", f"#{macros.sequence_b}")]
    rows += [(f"echo_applied.{axis}", f"#{number}") for axis, number in macros.echo_applied.items()]
    rows += [
        ("echo_time", f"#{macros.echo_time}"),
        ("echo_status", f"#{macros.echo_status}"),
        ("echo_guard_version", f"#{macros.echo_guard_version}"),
        ("unit_um", f"{macros.unit_um:g} um per unit"),
    ]
    return _table(("key", "variable"), [(escape(key), value) for key, value in rows])


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "plain") -> str:
    """Return a table; its cells are HTML already. Without a head there is none."""
    top = f"<tr>{''.join(f'<th>{name}</th>' for name in head)}</tr>" if head else ""
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f'<table class="{kind}">{top}{body}</table>'
