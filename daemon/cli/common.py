"""What the commands share: options, configuration, clear refusals, JSON output."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import click

from config.loader import ConfigurationError, load_configuration
from config.schema import Configuration

DEFAULT_CONFIGURATION = Path("/etc/toolpoint/toolpoint.yaml")
"""Where an installed daemon keeps its configuration."""
BAD_USAGE = 2
"""Exit status for bad usage or configuration."""

Command = TypeVar("Command", bound=Callable[..., Any])

config_option = click.option(
    "--config",
    "-c",
    "config_path",
    type=click.Path(path_type=Path),
    default=DEFAULT_CONFIGURATION,
    show_default=True,
    envvar="TOOLPOINT_CONFIG",
    help="Configuration file.",
)
json_option = click.option(
    "--json",
    "json_path",
    metavar="FILE",
    default=None,
    help="Write the result as JSON to FILE, '-' for standard output.",
)


def refuse(message: str) -> NoReturn:
    """End with a sentence on standard error and the status for bad usage."""
    click.echo(message, err=True)
    sys.exit(BAD_USAGE)


def read_configuration(path: Path) -> Configuration:
    """Load the configuration, or end with every problem it has."""
    try:
        return load_configuration(path)
    except ConfigurationError as error:
        refuse(str(error))


def write_json(destination: str | None, content: Any) -> None:
    """Write JSON to a file or to standard output; nothing without a destination."""
    if destination is None:
        return
    text = json.dumps(content, indent=2, allow_nan=False)
    if destination == "-":
        click.echo(text)
    else:
        Path(destination).write_text(text + "\n", encoding="utf-8")
