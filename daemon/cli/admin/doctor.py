"""`toolpoint doctor`: is this computer fit to run the daemon?"""

import asyncio
import sys
from pathlib import Path

import click

from daemon.checkup.finding import Finding, show_finding
from daemon.checkup.machine import preflight
from daemon.cli.common import (
    DEFAULT_CONFIGURATION,
    config_option,
    option,
    read_with_warnings,
    say,
    write_json,
)
from daemon.cli.options import json_option
from drivers.clock import SystemClock


@click.command()
@config_option
@json_option
def doctor(config_path: Path, json_path: str | None) -> None:
    """Examine the installation: Python, packages, clashing package names, serial ports, clock, the machine's model.

    Without a configuration at the default place, this computer alone is examined.
    """
    from daemon.checkup.computer import examine

    machine = None if config_path == DEFAULT_CONFIGURATION and not config_path.exists() else config_path
    findings = list(examine(machine))
    write_json(json_path, [finding.as_json() for finding in findings])
    if json_path is None:
        for finding in findings:
            show_finding(finding)
    sys.exit(1 if any(finding.failed for finding in findings) else 0)


@click.command()
@config_option
@option(
    "--devices/--no-devices",
    default=True,
    help="Also open the ports, the files and the CNC (read only).",
    show_default=False,
)
@json_option
def check(config_path: Path, devices: bool, json_path: str | None) -> None:
    """Check the configuration and everything it names.

    Exit status 1 when something that the configuration names is not there, does not answer or is refused. What it
    does not name yet, a thermal model or a commissioning record, is marked "not yet" and is no failure.

    Stop the daemon first: a serial port has one reader.
    """
    configuration, warnings = read_with_warnings(config_path)
    for warning in warnings:
        say(f"warning: {warning}")
    findings: list[Finding] = []

    async def collect() -> None:
        async for finding in preflight(configuration, SystemClock(), devices=devices):
            findings.append(finding)
            if json_path is None:
                show_finding(finding)

    if json_path is None:
        show_finding(Finding(subject="configuration", passed=True, detail=str(config_path)))
    asyncio.run(collect())
    write_json(json_path, [finding.as_json() for finding in findings])
    sys.exit(1 if any(finding.failed for finding in findings) else 0)
