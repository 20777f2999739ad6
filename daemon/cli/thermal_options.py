"""Options and the progress bar that the thermal commands share."""

from collections.abc import Callable
from typing import Any

import click

from daemon.cli.common import Command


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
    return click.option(name, metavar="A-B", callback=parse_hours, help=help)


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
