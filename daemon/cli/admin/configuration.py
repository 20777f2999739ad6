"""`toolpoint sample-config` and `toolpoint config-schema`."""

import json
from pathlib import Path

import click

from daemon.cli.common import option, refuse
from daemon.cli.options import NOT_A_FOLDER

output_option = option("--output", "-o", type=NOT_A_FOLDER, help="Write to this new file instead of standard output.")


@click.command("sample-config")
@option(
    "--machine",
    metavar="NAME",
    help="Print a shipped machine description (such as cfrpmt) instead of the sample of all keys.",
)
@output_option
def sample_config(machine: str | None, output: Path | None) -> None:
    """Print a commented configuration that is valid as it stands.

    It holds every key with its meaning, type, bounds and default; keys that are not in use are
    commented out.
    """
    from config.machines import machine_names, shipped_file
    from config.sample import sample_configuration

    if machine is None:
        deliver(sample_configuration(), output)
        return
    if machine not in machine_names():
        refuse(f"no machine {machine!r} ships with Toolpoint; there are {', '.join(machine_names())}")
    deliver(shipped_file(f"{machine}.yaml").read_text(encoding="utf-8"), output)


@click.command("config-schema")
@output_option
def config_schema(output: Path | None) -> None:
    """Print the JSON Schema of the configuration, for editors that check and complete while you type."""
    from config.sample import configuration_json_schema

    deliver(json.dumps(configuration_json_schema(), indent=2) + "\n", output)


def deliver(text: str, output: Path | None) -> None:
    """Write to standard output or to a file that does not exist yet."""
    if output is None:
        click.echo(text, nl=False)
        return
    try:
        with output.open("x", encoding="utf-8") as file:
            try:
                file.write(text)
                file.flush()
            except OSError:
                output.unlink()  # half a program must not reach a control
                raise
    except FileExistsError:
        refuse(f"{output} exists already and is left as it is; name a new file")
    except OSError as error:
        refuse(f"{output} cannot be written: {error.strerror}")
