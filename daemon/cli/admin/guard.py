"""`toolpoint guard`: the NC programs for this machine, and the sheet of their commissioning."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.cli.admin.configuration import deliver, output_option
from daemon.cli.common import config_option, option, read_configuration, refuse, say
from daemon.cli.options import NOT_A_FOLDER

if TYPE_CHECKING:
    from config.schema import Configuration


@click.command("guard")
@config_option
@option(
    "--policy",
    type=click.Choice(["keep", "zero"]),
    help="What an expired block does at a safe point (default: cnc.guard.on_expiry).",
)
@option("--program", metavar="NUMBER", type=int, help="O number of the guard (default: cnc.guard.program).")
@option(
    "--dialect",
    type=click.Choice(["fanuc", "sinumerik", "linuxcnc"]),
    help="Language: custom macro B, SINUMERIK with R parameters, or LinuxCNC (default: cnc.guard.dialect).",
)
@output_option
@option(
    "--sheet",
    type=NOT_A_FOLDER,
    help="Write the commissioning sheet to this new file (.html or .md) instead of printing the programs.",
)
@option("--speed", is_flag=True, help="Print the speed program (spindle_speed) instead.")
def guard(
    config_path: Path,
    policy: str | None,
    program: int | None,
    dialect: str | None,
    output: Path | None,
    sheet: Path | None,
    speed: bool,
) -> None:
    """Print the NC programs of this machine: the guard macro, and what belongs to it.

    The text holds the macro numbers, limits and time limit of the configuration. Load it into the
    control as it is; it is the very text that the simulated CNC runs. With --sheet the sheet that
    goes with it is written: what to load, check and try, with lines to sign.
    """
    from drivers.guard.programs import guard_program
    from drivers.guard.sheet import sheet_html, sheet_markdown
    from drivers.guard.speed_text import speed_program
    from drivers.guard.text import GuardTextError

    unchanged = read_configuration(config_path)
    configuration = _with_changes(unchanged, policy, program, dialect)
    if configuration.cnc.guard != unchanged.cnc.guard:
        say(
            f"This is not the guard that {config_path} describes. Say the same there (cnc.guard.on_expiry, program, "
            "dialect) before you load it: the daemon expects the guard that is configured there, and anything else is "
            "a FAULT"
        )
    if sheet is not None and output is not None:
        refuse("--sheet writes the sheet and --output the programs; give one of them")
    if sheet is not None and sheet.suffix not in (".html", ".md"):
        refuse(f"{sheet}: the sheet is .html or .md")
    if speed and (sheet, policy, program, dialect) != (None, None, None, None):
        refuse("--speed prints the speed program, whose number and limits stand in spindle_speed; leave the others out")
    try:
        if speed:
            deliver(speed_program(configuration), output)
        elif sheet is None:
            deliver(guard_program(configuration), output)
        else:
            deliver((sheet_html if sheet.suffix == ".html" else sheet_markdown)(configuration), sheet)
    except GuardTextError as error:
        refuse(f"{config_path}: {error}")


def _with_changes(
    configuration: "Configuration", policy: str | None, program: int | None, dialect: str | None
) -> "Configuration":
    """Return the configuration with what the command line says otherwise."""
    from pydantic import ValidationError

    from config.schema.guard import GuardConfig

    changes = {"on_expiry": policy, "program": program, "dialect": dialect}
    settings = configuration.cnc.guard.model_dump() | {
        key: value for key, value in changes.items() if value is not None
    }
    try:
        changed = GuardConfig.model_validate(settings)
    except ValidationError as error:
        refuse(f"--program {program}: {error.errors()[0]['msg'].lower()}")
    cnc = configuration.cnc.model_copy(update={"guard": changed})
    return configuration.model_copy(update={"cnc": cnc})
