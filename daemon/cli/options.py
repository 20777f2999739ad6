"""Arguments and options of the commands that read recordings, draw pictures or write files."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FILE, Command, option


class FiniteFloat(click.FloatRange):
    """A number between bounds that is neither infinite nor 'nan', which no comparison with a bound refuses."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or fail with a sentence."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


EXISTING = click.Path(path_type=Path, exists=True)
EXISTING_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
NOT_A_FOLDER = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)
POSITIVE = FiniteFloat(min=0.0, min_open=True)
NOT_NEGATIVE = FiniteFloat(min=0.0)
PLACE = click.Choice(["nose", "holder", "tool"])
LOBES_METHOD = click.Choice(["zoa", "sdm"])


def writable(*endings: str) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """Return a callback that refuses a file before the work is done whose result it shall take."""

    def check(ctx: click.Context, param: click.Parameter, value: str | Path | None) -> str | Path | None:
        if value is None or str(value) == "-":
            return value
        path = Path(value)
        if endings and path.suffix.lower() not in endings:
            raise click.BadParameter(f"{path}: its name ends in {' or '.join(endings)}")
        if path.is_dir():
            raise click.BadParameter(f"{path} is a folder; name a file")
        if not path.parent.is_dir():
            raise click.BadParameter(f"{path}: there is no folder {path.parent}")
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise click.BadParameter(f"{path} cannot be written (permission denied)")
        return value

    return check


json_option = option(
    "--json",
    "json_path",
    metavar="FILE",
    callback=writable(),
    help="Write the result as JSON to FILE, '-' for standard output.",
)


def parse_hours(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, float] | None:
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

    def show(self, what: str, done: float, total: float) -> None:
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
csv_option = option(
    "--csv",
    "csv_path",
    metavar="FILE",
    type=FILE,
    callback=writable(),
    help="Write the response as frequency_hz,receptance_re,receptance_im (Hz, m/N).",
)
picture_option = option(
    "--picture",
    metavar="FILE",
    type=FILE,
    callback=writable(*PICTURES),
    help="Draw the result: .png (still) or .html (to zoom into, complete in one file).",
)
