"""What the commands share: options, configuration, clear refusals, JSON output."""

import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from config.loader import load_with_warnings
from config.schema import Configuration
from config.schema.base import Problem
from models.json_values import printable

if TYPE_CHECKING:
    from daemon.checkup.machine import Finding

DEFAULT_CONFIGURATION = Path("/etc/toolpoint/toolpoint.yaml")
"""Where an installed daemon keeps its configuration."""
CONFIGURATION_VARIABLE = "TOOLPOINT_CONFIG"
"""Environment variable that names another."""
BAD_USAGE = 2
"""Exit status for bad usage or configuration."""
Command = TypeVar("Command", bound=Callable[..., Any])


class FiniteFloat(click.FloatRange):
    """A number between bounds that is neither infinite nor 'nan', which no comparison with a bound refuses."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or fail with a sentence."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


FILE = click.Path(path_type=Path)
EXISTING = click.Path(path_type=Path, exists=True)
EXISTING_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
NOT_A_FOLDER = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)
POSITIVE = FiniteFloat(min=0.0, min_open=True)
NOT_NEGATIVE = FiniteFloat(min=0.0)
PLACE = click.Choice(["nose", "holder", "tool"])
LOBES_METHOD = click.Choice(["zoa", "sdm"])


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


json_option = option(
    "--json",
    "json_path",
    metavar="FILE",
    callback=_writable,
    help="Write the result as JSON to FILE, '-' for standard output.",
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


def show_finding(finding: "Finding") -> None:
    """Print one line of what was tried."""
    mark, colour = ("ok", "green") if finding.passed else ("not yet", "yellow") if finding.pending else ("FAIL", "red")
    click.echo(f"{click.style(f'{mark:7}', fg=colour)}  {finding.subject}: {printable(finding.detail)}")


def write_json(destination: str | None, content: Any) -> None:
    """Write JSON to a file or to standard output; nothing without a destination."""
    if destination is None:
        return
    text = json.dumps(content, indent=2, allow_nan=False)
    if destination == "-":
        click.echo(text)
    else:
        Path(destination).write_text(text + "\n", encoding="utf-8")


def parse_hours(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, float] | None:
    """Return the two hours of a text such as 0-32."""
    if value is None:
        return None
    first, _, last = value.partition("-")
    try:
        hours = float(first), float(last)
    except ValueError:
        raise click.BadParameter(f"{value!r} are not two hours such as 0-32") from None
    if not 0.0 <= hours[0] < hours[1] < float("inf"):
        raise click.BadParameter(f"{value!r}: the first hour must lie before the last")
    return hours


def hours_option(name: str, help: str) -> Callable[[Command], Command]:  # noqa: A002
    """Return an option that takes hours such as 0-32."""
    return option(name, metavar="A-B", callback=parse_hours, help=help)


common_columns_option = option(
    "--common-columns", is_flag=True, help="Use only the columns that all recordings have, where they differ."
)


class ProgressBar:
    """A progress bar on standard error; nothing where that is no terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import Progress

        console = Console(stderr=True)
        self._progress = Progress(console=console, transient=True, disable=not console.is_terminal)
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> "ProgressBar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, what: str, done: int, total: int) -> None:
        """Show how far a piece of work is."""
        if what not in self._tasks:
            self._tasks[what] = self._progress.add_task(what, total=total)
        self._progress.update(self._tasks[what], completed=done, total=total)


PICTURES = (".png", ".html")
"""Endings of pictures: a still one, and a page to zoom into."""
directory_option = option(
    "--directory", type=FOLDER, help="Where all files of the run go, and stay (default: a folder that is removed)."
)
spindle_argument = click.argument("spindle_path", metavar="SPINDLE.yaml", type=FILE)
rotary_option = option(
    "--rotary",
    type=click.Choice(["correct", "published"]),
    help="Rotary inertia of a segment's rigid rotation: correct, or as published. Without: what the file says.",
)
trust_option = option(
    "--trust-units",
    is_flag=True,
    help="Take the units as stated (m/N over Hz), although the file's structure cannot have such a response.",
)


def _picture(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Refuse a picture that cannot be written before the work is done."""
    if value is None:
        return None
    if value.suffix.lower() not in PICTURES:
        raise click.BadParameter(f"{value}: a picture ends in {' or '.join(PICTURES)}")
    if not value.parent.is_dir():
        raise click.BadParameter(f"{value}: there is no folder {value.parent}")
    return value


def destination(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Refuse a file that cannot be written before the work is done."""
    if value is not None and (value.is_dir() or not value.parent.is_dir()):
        raise click.BadParameter(f"{value}: name a file in a folder that exists")
    return value


csv_option = option(
    "--csv",
    "csv_path",
    metavar="FILE",
    type=FILE,
    callback=destination,
    help="Write the response as frequency_hz,receptance_re,receptance_im (Hz, m/N).",
)
picture_option = option(
    "--picture",
    metavar="FILE",
    type=FILE,
    callback=_picture,
    help="Draw the result: .png (still) or .html (to zoom into, complete in one file).",
)


def show_warnings(found: dict[str, Any]) -> None:
    """Write the warnings of a result on standard error."""
    for warning in found["warnings"]:
        say(f"warning: {warning}")
