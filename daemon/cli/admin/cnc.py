"""`toolpoint cnc`: what the configured control gives and takes."""

import asyncio
import sys
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import config_option, json_option, read_configuration, say, write_json

FAILED = 1
"""Exit status when the control could not be asked."""


@click.group()
def cnc() -> None:
    """Look at the control, without writing anything."""


@cnc.command()
@config_option
@json_option
def probe(config_path: Path, json_path: str | None) -> None:
    """Say who the control is, whether the connection is secure, and what can be read and written.

    Nothing is written: what stands under write_macros is what the daemon itself would refuse. Exit status 1 when the
    control does not answer or refuses what the daemon needs.
    """
    from daemon.checkup.control import probe_control
    from drivers.clock import SystemClock

    found = asyncio.run(probe_control(read_configuration(config_path), SystemClock()))
    write_json(json_path, found)
    if json_path is None:
        for line in _in_words(found):
            say(line)
    sys.exit(0 if found["identity"] else FAILED)


def _in_words(found: dict[str, Any]) -> list[str]:
    security = "encrypted" if found["secure"] else "NOT secure: anybody on this network can read and write"
    can = ", ".join(name.replace("_", " ") for name, able in found["can"].items() if able)
    return [
        f"{found['identity'] or 'no control'} by driver {found['driver']}, {security}",
        f"can: {can or 'nothing'}",
        *(f"cannot: {entry['what'].replace('_', ' ')}: {entry['why']}" for entry in found["refused"]),
    ]
