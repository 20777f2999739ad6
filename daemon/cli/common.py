"""What the commands share: options, configuration, clear refusals, JSON output."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import click

from config.loader import load_with_warnings
from config.schema import Configuration
from config.schema.base import Problem

DEFAULT_CONFIGURATION = Path("/etc/toolpoint/toolpoint.yaml")
"""Where an installed daemon keeps its configuration."""
CONFIGURATION_VARIABLE = "TOOLPOINT_CONFIG"
"""Environment variable that names another."""
FAILED = 1
"""Exit status when nothing was done, or something did not hold."""
BAD_USAGE = 2
"""Exit status for bad usage or configuration."""
Command = TypeVar("Command", bound=Callable[..., Any])
FILE = click.Path(path_type=Path)
for kind in (click.FloatRange, click.IntRange):  # what help and refusals call them, for people who write no programs
    kind.name = "number" if kind is click.FloatRange else "whole number"


def option(*names: str, **settings: Any) -> Callable[[Command], Command]:
    """Return an option whose default, where it has one, stands in its help."""
    return click.option(*names, **{"show_default": "default" in settings, **settings})


config_option = option(
    "--config",
    "-c",
    "config_path",
    type=FILE,
    default=DEFAULT_CONFIGURATION,
    envvar=CONFIGURATION_VARIABLE,
    help="Configuration file.",
)


def say(message: str) -> None:
    """Write something for a person, on standard error: standard output is for results."""
    click.echo(message, err=True)


def refuse(message: str, status: int = BAD_USAGE) -> NoReturn:
    """End with a sentence on standard error, and a status that says what kind of refusal it is."""
    say(message)
    sys.exit(status)


def read_configuration(path: Path) -> Configuration:
    """Load the configuration, or end with every problem it has."""
    return read_with_warnings(path)[0]


def read_with_warnings(path: Path) -> tuple[Configuration, tuple[Problem, ...]]:
    """Load the configuration and which of its keys have a new name, or end with every problem it has."""
    if not path.exists():
        refuse(
            f"{path}: there is no configuration. Name yours with --config FILE or the environment variable "
            f"{CONFIGURATION_VARIABLE}; `toolpoint sample-config --output toolpoint.yaml` makes one to begin with"
        )
    return load_with_warnings(path)


def write_json(destination: str | None, content: Any) -> None:
    """Write JSON to a file or to standard output; nothing without a destination."""
    if destination is None:
        return
    text = json.dumps(content, indent=2, allow_nan=False)
    if destination == "-":
        click.echo(text)
    else:
        try:
            Path(destination).write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            error.filename = destination  # a full disk names none
            raise


def show_warnings(found: dict[str, Any]) -> None:
    """Write the warnings of a result on standard error."""
    for warning in found["warnings"]:
        say(f"warning: {warning}")
