"""The report that a person signs: one HTML file, nothing loaded, nothing that runs, fit for paper."""

from config.files import sha256_of
from config.html_page import Section, html_page
from config.records.commissioning import PROOF_TOLERANCE, CommissioningRecord, macro_map_digest
from config.records.commissioning_file import commissioning_text
from config.schema import Configuration

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
    sections = [
        _facts(record),
        _readings(record),
        _limits(record, configuration),
        _macros(configuration),
        Section(title="What this record permits", text=PERMITS),
        Section(title="When it becomes invalid", items=ENDS),
        Section(
            title="Signatures",
            text="I have seen the axes above move as the table says.",
            rows=((f"Commissioned by: {record.person}\nDate, signature", "Checked by (name):\nDate, signature"),),
            kind="signatures",
        ),
    ]
    if record.macro_map_sha256 != macro_map_digest(configuration.cnc.macros):
        void = (
            "This record does not fit the present configuration: the macro map has changed since. "
            "The macro variables and limits below are those of the present configuration."
        )
        sections.insert(0, Section(text=void, kind="void"))
    return html_page(f"Commissioning of {record.machine or record.cnc_identity}", sections, paper=True)


def record_digest(record: CommissioningRecord) -> str:
    """Return the digest of a record's file as it is written, by which paper and file can be held together."""
    return sha256_of(commissioning_text(record).encode())


def _facts(record: CommissioningRecord) -> Section:
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
    return Section(rows=rows, kind="facts")


def _readings(record: CommissioningRecord) -> Section:
    rows = []
    for axis, found in record.axes.items():
        read = found.readings
        others = ", ".join(f"{name} {um:+.2f}" for name, um in found.others_um.items()) or "not observed"
        shown = ("-", "-", "-", "-", "not recorded")
        if read is not None:
            noise = "-" if read.noise_um is None else f"{read.noise_um:.2f} ({read.samples})"
            shown = (f"{read.before_um:.2f}", f"{read.at_offset_um:.2f}", f"{read.after_um:.2f}", noise, read.source)
        rows.append(
            (axis, f"{found.written_um:+g}", *shown[:3], f"{found.measured_um:+.2f}", f"{found.sign:+d}",
             f"{found.scale:g}", shown[3], others, shown[4])
        )  # fmt: skip
    return Section(
        title="Readings",
        text="Movement is the reading with the offset minus the mean of both readings at zero. Sign and scale count as "
        f"proved when the movement is within {PROOF_TOLERANCE:.0%} of the offset.",
        head=("axis", "offset [um]", "before [um]", "with offset [um]", "after [um]", "movement [um]", "sign", "scale",
              "noise [um] (samples)", "other axes [um]", "read by"),
        rows=tuple(rows),
        kind="readings",
    )  # fmt: skip


def _limits(record: CommissioningRecord, configuration: Configuration) -> Section:
    rows = tuple(
        (name, "yes" if name in record.axes else "no", f"{axis.absolute_bound_um:g}", f"{axis.slew_um_per_min:g}",
         f"{axis.step_um:g}")
        for name, axis in configuration.compensation.outputs.items()
    )  # fmt: skip
    head = ("axis", "commissioned", "bound [um]", "slew rate [um/min]", "step [um]")
    return Section(title="Limits in the configuration", head=head, rows=rows)


def _macros(configuration: Configuration) -> Section:
    macros = configuration.cnc.macros
    numbers = {
        "sequence_a": macros.sequence_a,
        **{f"values.{axis}": number for axis, number in macros.values.items()},
        "valid_until": macros.valid_until,
        "enable": macros.enable,
        **({} if macros.check is None else {"check": macros.check}),
        "sequence_b": macros.sequence_b,
        **{f"echo_applied.{axis}": number for axis, number in macros.echo_applied.items()},
        "echo_time": macros.echo_time,
        "echo_status": macros.echo_status,
        "echo_guard_version": macros.echo_guard_version,
    }
    rows = [(key, f"#{number}") for key, number in numbers.items()]
    rows.append(("unit_um", f"{macros.unit_um:g} um per unit"))
    return Section(title="Macro variables", head=("key", "variable"), rows=tuple(rows))
