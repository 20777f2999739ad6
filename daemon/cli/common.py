"""What the commands share: options, configuration, clear refusals, JSON output."""

import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from config.loader import ConfigurationError, load_configuration
from config.schema import Configuration

if TYPE_CHECKING:
    from daemon.probe import Finding

DEFAULT_CONFIGURATION = Path("/etc/toolpoint/toolpoint.yaml")
"""Where an installed daemon keeps its configuration."""
CONFIGURATION_VARIABLE = "TOOLPOINT_CONFIG"
"""Environment variable that names another."""
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
    envvar=CONFIGURATION_VARIABLE,
    help="Configuration file.",
)


class FiniteFloat(click.FloatRange):
    """A number between bounds that is neither infinite nor 'nan', which no comparison with a bound refuses."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or fail with a sentence."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


def _writable(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    """Refuse a destination before the work is done whose result it shall take."""
    if value is None or value == "-":
        return value
    path = Path(value)
    if path.is_dir():
        raise click.BadParameter(f"{value} is a folder; name a file")
    if not path.parent.is_dir():
        raise click.BadParameter(f"{value}: there is no folder {path.parent}")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise click.BadParameter(f"{value} cannot be written (permission denied)")
    return value


json_option = click.option(
    "--json",
    "json_path",
    metavar="FILE",
    callback=_writable,
    default=None,
    help="Write the result as JSON to FILE, '-' for standard output.",
)


def refuse(message: str) -> NoReturn:
    """End with a sentence on standard error and the status for bad usage."""
    click.echo(message, err=True)
    sys.exit(BAD_USAGE)


def read_configuration(path: Path) -> Configuration:
    """Load the configuration, or end with every problem it has."""
    if not path.exists():
        refuse(
            f"{path}: there is no configuration. Name yours with --config FILE or the environment variable "
            f"{CONFIGURATION_VARIABLE}; `toolpoint sample-config --output toolpoint.yaml` makes one to begin with"
        )
    try:
        return load_configuration(path)
    except ConfigurationError as error:
        refuse(str(error))


def show_finding(finding: "Finding") -> None:
    """Print one line of what was tried."""
    mark, colour = ("ok", "green") if finding.passed else ("not yet", "yellow") if finding.pending else ("FAIL", "red")
    click.echo(f"{click.style(f'{mark:7}', fg=colour)}  {finding.subject}: {finding.detail}")


def write_json(destination: str | None, content: Any) -> None:
    """Write JSON to a file or to standard output; nothing without a destination."""
    if destination is None:
        return
    text = json.dumps(content, indent=2, allow_nan=False)
    if destination == "-":
        click.echo(text)
    else:
        Path(destination).write_text(text + "\n", encoding="utf-8")
