"""What `toolpoint demo` and `toolpoint replay` share: their folder, and what is said when a run breaks off."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import click

from daemon.cli.common import refuse
from daemon.operation.control_socket import DaemonUnreachableError
from daemon.rehearsal.processes import RehearsalError, folder_for

BROKEN_OFF = 1
"""Exit status when the run could not be brought to its end."""
LOGS = ("daemon.log", "simulator.log")
LAST_LINES = 5
"""Of each log this many lines are shown when its folder is removed."""


@contextmanager
def rehearsal_folder(directory: Path | None) -> Iterator[Path]:
    """Yield the folder of a run; end with sentences when it cannot be used or the run breaks off."""
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(folder_for(directory))
        except RehearsalError as error:
            refuse(str(error))
        try:
            yield folder
        except (RehearsalError, DaemonUnreachableError) as error:
            if directory is None:
                click.echo("\n".join([str(error), *last_lines(folder)]), err=True)
            else:
                click.echo(f"{error}; logs are in {folder}", err=True)
            sys.exit(BROKEN_OFF)


def last_lines(folder: Path) -> Iterator[str]:
    """Yield the end of each log in the folder, under its name."""
    for name in LOGS:
        path = folder / name
        if path.exists() and (lines := path.read_text(encoding="utf-8", errors="replace").splitlines()):
            yield f"the end of {name}:"
            yield from (f"  {line}" for line in lines[-LAST_LINES:])
