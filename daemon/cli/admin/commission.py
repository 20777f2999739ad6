"""`toolpoint commission`: prove sign, scale and axis on the machine, and write the record of it."""

import asyncio
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from config.files import read_whole, sha256_of
from daemon.cli.common import BAD_USAGE, FAILED, FILE, config_option, option, read_configuration, refuse, say
from daemon.cli.options import EXISTING_FILE, POSITIVE, FiniteFloat

if TYPE_CHECKING:
    from config.schema import Configuration
    from daemon.commissioning.procedure import Plan
    from daemon.commissioning.session import Sources

INTERRUPTED = 130
"""Exit status of an interrupted commissioning."""


def _pairs(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """Return AXIS=VALUE options as a mapping."""
    pairs: dict[str, str] = {}
    for value in values:
        name, sign, content = value.partition("=")
        if not (name and sign and content):
            raise click.BadParameter(f"{value!r} is not of the form AXIS=...")
        if name in pairs:
            raise click.BadParameter(f"{name} is given twice")
        pairs[name] = content
    return pairs


def _readings(
    ctx: click.Context, param: click.Parameter, values: tuple[str, ...]
) -> dict[tuple[str, str], tuple[float, float, float]]:
    """Return readings by commanded and observed axis: z=0,5.1,0.1 or z/x=0,0.2,0."""
    given = {}
    for name, content in _pairs(ctx, param, values).items():
        commanded, _, observed = name.partition("/")
        try:
            before, at_offset, after = (float(part) for part in content.split(","))
        except ValueError as error:
            raise click.BadParameter(f"{name}={content}: three numbers are needed, BEFORE,WITH,AFTER") from error
        if not all(math.isfinite(um) for um in (before, at_offset, after)):
            raise click.BadParameter(f"{name}={content}: only finite numbers count")
        given[commanded, observed or commanded] = (before, at_offset, after)
    return given


def _positions(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Return two positions [mm] by slope: z_slope=20,480."""
    given = {}
    for name, content in _pairs(ctx, param, values).items():
        try:
            first, second = (float(part) for part in content.split(","))
        except ValueError as error:
            raise click.BadParameter(f"{name}={content}: two numbers are needed, FIRST,SECOND") from error
        given[name] = (first, second)
    return given


@click.command()
@config_option
@option(
    "--axis",
    "axes",
    multiple=True,
    help="Commission this axis (repeatable; default: every axis that has a model, its `estimate`).",
)
@option(
    "--offset-um", type=FiniteFloat(min=-1000, max=1000), default=5.0, help="Offset that each axis is moved by [um]."
)
@option("--person", help="Who reads the instrument and signs (else asked).")
@option("--instrument", help="What is read, with its number (else asked).")
@option(
    "--channel",
    "channels",
    metavar="AXIS=NAME",
    multiple=True,
    callback=_pairs,
    help="Read this axis from a displacement channel of the configuration (repeatable).",
)
@option("--samples", type=click.IntRange(min=2), default=10, help="Samples of a channel.")
@option(
    "--reading",
    "readings",
    metavar="AXIS[/SEEN]=BEFORE,WITH,AFTER",
    multiple=True,
    callback=_readings,
    help="Readings [um] that are to be seen while AXIS is commanded, of AXIS or of another axis SEEN (repeatable); "
    "each is confirmed at its moment, so not with --yes.",
)
@option(
    "--position",
    "positions",
    metavar="AXIS=FIRST,SECOND",
    multiple=True,
    callback=_positions,
    help="Machine positions [mm] at which the slope AXIS is read (repeatable; else asked).",
)
@option("--patience-s", type=POSITIVE, default=300.0, help="Wait this long for the guard to be called [s].")
@option("--yes", is_flag=True, help="Agree to every step beforehand; foreign values are not covered.")
@option("--overwrite-foreign", is_flag=True, help="Set our variables to 0 although they hold foreign values.")
@option("--accept-reversed", multiple=True, metavar="AXIS", help="Record a reversed sign (repeatable).")
@option("--accept-scale", multiple=True, metavar="AXIS", help="Record a scale that is not 1 (repeatable).")
@option(
    "--guard-program",
    type=EXISTING_FILE,
    help="Text of the guard program that is loaded in the control; its digest goes into the record.",
)
@option(
    "--secrets",
    "secrets_path",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of the CNC's password and key files, when the service's credentials are not there.",
)
@option("--record", "record_path", type=FILE, help="Where the record goes (default: compensation.commissioning_file).")
@option(
    "--report",
    "report_path",
    type=click.Path(path_type=Path, dir_okay=False, writable=True),
    metavar="FILE.html",
    help="Write the report to sign.",
)
@option("--initialise-only", is_flag=True, help="Initialise the macro variables and end.")
@option("--check", "only_check", is_flag=True, help="Say what the record covers, without touching the CNC.")
@option("--simulated-clock", metavar="REAL:UTC:SPEED", help="Run on the clock of a simulated machine.")
def commission(
    config_path: Path,
    axes: tuple[str, ...],
    offset_um: float,
    person: str | None,
    instrument: str | None,
    channels: dict[str, str],
    samples: int,
    readings: dict[tuple[str, str], tuple[float, float, float]],
    positions: dict[str, tuple[float, float]],
    patience_s: float,
    yes: bool,
    overwrite_foreign: bool,
    accept_reversed: tuple[str, ...],
    accept_scale: tuple[str, ...],
    guard_program: Path | None,
    secrets_path: Path | None,
    record_path: Path | None,
    report_path: Path | None,
    initialise_only: bool,
    only_check: bool,
    simulated_clock: str | None,
) -> None:
    """Move each axis by a small offset, take readings, and record that sign, scale and axis are right.

    Stop the daemon first, and load the programs of `toolpoint guard` into the control. Nothing moves by itself:
    each time you are told to, have the guard called, by hand in MDI or by a program that stands at a safe point.
    A reading is the position of the tool relative to the work along the axis [um]; it must rise when the axis is
    jogged in plus.

    Exit status 0 when the record is written, 1 when the commissioning was refused, 130 when it was interrupted.
    After an early end the offsets go back to zero, which the guard has to be called for as well. Where that is
    not possible (no link, a second Ctrl-C, somebody else writes the block) what is LEFT BEHIND is said.
    """
    from daemon.commissioning.initialising import CommissioningRefusedError
    from daemon.commissioning.procedure import Plan
    from daemon.commissioning.session import Sources, with_secrets

    configuration = read_configuration(config_path)
    try:
        configuration = configuration if secrets_path is None else with_secrets(configuration, secrets_path)
    except CommissioningRefusedError as error:
        refuse(str(error))
    record_file = record_path.resolve() if record_path else configuration.compensation.commissioning_file
    if only_check:
        sys.exit(_check(configuration, record_file, report_path))
    known = tuple(configuration.compensation.axes)
    _refuse_of_slopes(configuration, positions, readings)
    named = {*axes, *channels, *accept_reversed, *accept_scale, *(axis for pair in readings for axis in pair)}
    if unknown := sorted(named - set(known)):
        refuse(f"there is no axis {', '.join(unknown)}; axes are {', '.join(known)}")
    _refuse_channels_of_others(configuration, channels)
    if yes and readings:
        refuse(
            "--yes does not cover --reading: what the instrument shows can only be confirmed once the axis has moved. "
            "Leave --yes out, or read a --channel"
        )
    wanted = set(axes) or {name for name, axis in configuration.compensation.axes.items() if axis.estimate}
    if not wanted and not initialise_only:
        refuse("no axis has a model yet (compensation.axes, `estimate`); name the axes to commission with --axis")
    if record_file is None and not initialise_only:
        refuse("no place for the record: set compensation.commissioning_file, or name --record")
    if guard_program is not None:
        _compare_guard(configuration, guard_program)
    plan = Plan(
        axes=tuple(axis for axis in known if axis in wanted),
        offset_um=offset_um,
        person=person or "",
        instrument=instrument or "",
        patience_s=patience_s,
        initialise_only=initialise_only,
        overwrite_foreign=overwrite_foreign,
        accept_reversed=frozenset(accept_reversed),
        accept_scale=frozenset(accept_scale),
        positions=positions,
        guard_program_sha256=None if guard_program is None else sha256_of(read_whole(guard_program)),
        replaces=record_file == configuration.compensation.commissioning_file,
    )
    sources = Sources(channels=channels, given=readings, samples=samples)
    sys.exit(_commission(configuration, plan, sources, record_file, report_path, simulated_clock, consent=yes))


def _refuse_channels_of_others(configuration: "Configuration", channels: dict[str, str]) -> None:
    """Where two axes are swapped, the other axis' channel would prove the movement of the wrong one."""
    axes, slopes = configuration.compensation.axes, configuration.compensation.slopes
    for axis, channel in channels.items():
        measured = [name for name, each in axes.items() if each.estimate == channel]
        if measured and not {axis, slopes[axis].of if axis in slopes else axis} & set(measured):
            refuse(
                f"--channel {axis}={channel}: {channel} is the thermal error of axis {measured[0]} "
                f"(compensation.axes.{measured[0]}.estimate), so it cannot prove that {axis} moves; "
                f"name a channel along {axis}"
            )


def _refuse_of_slopes(
    configuration: "Configuration",
    positions: dict[str, tuple[float, float]],
    readings: dict[tuple[str, str], tuple[float, float, float]],
) -> None:
    slopes = configuration.compensation.slopes
    if wrong := sorted(set(positions) - set(slopes)):
        refuse(f"--position: {wrong[0]} is no slope; slopes are {', '.join(slopes) or 'none'} (compensation.axes)")
    if wrong := sorted({axis for pair in readings for axis in pair} & set(slopes)):
        refuse(f"--reading: the slope {wrong[0]} is read at two positions; answer when asked, or name a --channel")


def _commission(
    configuration: "Configuration",
    plan: "Plan",
    sources: "Sources",
    record_file: Path | None,
    report_path: Path | None,
    simulated_clock: str | None,
    *,
    consent: bool,
) -> int:
    from config.records.commissioning import CommissioningError, CommissioningRecord
    from config.records.commissioning_file import save_commissioning
    from config.signing import SigningError, TrustedKeys
    from config.signing_key import SigningKey
    from daemon.cli.operate.run import parse_simulated_clock
    from daemon.commissioning.dialogue import TerminalDialogue
    from daemon.commissioning.initialising import CommissioningRefusedError
    from daemon.commissioning.preconditions import refuse_shipped
    from daemon.commissioning.report import report_html
    from daemon.commissioning.session import check_destination, commission_by
    from daemon.telemetry.logs import configure_logging
    from drivers.clock import SystemClock
    from drivers.contract import DriverError

    configure_logging("warning")
    clock = parse_simulated_clock(simulated_clock) if simulated_clock else SystemClock()
    try:
        key = SigningKey.of_this_account(TrustedKeys.read(configuration.signatures.public_keys), "commissioning record")
        for path in (record_file, report_path):
            if path is not None:
                refuse_shipped(path)
                check_destination(path)
        dialogue = TerminalDialogue(consent=consent)

        def save(record: CommissioningRecord) -> None:
            if record_file is not None:
                save_commissioning(record, record_file, key)

        record = asyncio.run(commission_by(configuration, plan, sources, dialogue, clock, record_file, save))
        if record is None or record_file is None:
            return 0
        click.echo(f"Record: {record_file}")
        if report_path is not None:
            _write_report(report_path, report_html(record, configuration))
    except (CommissioningRefusedError, CommissioningError, SigningError, DriverError) as error:
        say(f"Not commissioned: {error}")
        return FAILED
    except asyncio.CancelledError:
        say("Not commissioned: interrupted")
        return INTERRUPTED
    if configuration.compensation.commissioning_file != record_file:
        click.echo(f"The daemon reads it once the configuration says compensation.commissioning_file: {record_file}")
    return 0


def _compare_guard(configuration: "Configuration", path: Path) -> None:
    from drivers.guard.programs import guard_program
    from drivers.guard.text import GuardTextError

    try:
        same = read_whole(path) == guard_program(configuration).encode("ascii")
    except GuardTextError as error:
        refuse(str(error))
    if not same:
        click.echo(f"{path} differs from what `toolpoint guard` prints for this configuration; it is recorded as it is")


def _write_report(report_path: Path, text: str) -> None:
    try:
        report_path.write_text(text, encoding="utf-8")
    except OSError as error:
        refuse(f"{report_path}: the report cannot be written ({error.strerror}); make it with --check --report")
    click.echo(f"Report to sign: {report_path}")


def _check(configuration: "Configuration", record_file: Path | None, report_path: Path | None) -> int:
    """Print what a record covers; 1 when an axis that has a model is not covered."""
    from config.records.commissioning import CommissioningError, commissioning_inhibit, load_commissioning
    from daemon.commissioning.report import record_digest, report_html

    if record_file is None:
        say("there is no record: set compensation.commissioning_file, or name --record")
        return BAD_USAGE
    try:
        record = load_commissioning(record_file)
    except CommissioningError as error:
        say(str(error))
        return FAILED
    click.echo(f"{record_file}: format {record.format_version}, SHA-256 {record_digest(record)}")
    click.echo(f"control {record.cnc_identity}, guard version {record.guard_version or 'not named'}")
    click.echo(f"by {record.person} on {record.date}, with {record.instrument or 'an instrument that is not named'}")
    for axis, found in record.axes.items():
        click.echo(
            f"axis {axis}: {found.written_um:+g} um moved it by {found.measured_um:+.2f} um, "
            f"sign {found.sign:+d}, scale {found.scale:g}"
        )
    if report_path is not None:
        _write_report(report_path, report_html(record, configuration))
    wanted = sorted(name for name, axis in configuration.compensation.axes.items() if axis.estimate)
    inhibit = commissioning_inhibit(
        record,
        cnc_identity=record.cnc_identity,
        macros=configuration.cnc.macros,
        axes=wanted,
        slopes=configuration.compensation.slopes,
        machine=configuration.machine,
    )
    if inhibit:
        say(f"It does not permit what the configuration wants: {inhibit}")
        return FAILED
    click.echo("It fits the configuration. The control's identity and the guard's version are compared by the daemon.")
    return 0
