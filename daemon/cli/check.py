"""`toolpoint check`: configuration, model, commissioning record and devices."""

import asyncio
import sys
from pathlib import Path

import click

from daemon.cli.common import config_option, json_option, read_configuration, write_json
from daemon.probe import Finding, probe
from drivers.clock import SystemClock


@click.command()
@config_option
@click.option("--devices/--no-devices", default=True, help="Also open the ports, the files and the CNC (read only).")
@json_option
def check(config_path: Path, devices: bool, json_path: str | None) -> None:
    """Check the configuration and everything it names; exit status 1 when something does not answer.

    Stop the daemon first: a serial port has one reader.
    """
    configuration = read_configuration(config_path)
    findings: list[Finding] = []

    async def collect() -> None:
        async for finding in probe(configuration, SystemClock(), devices=devices):
            findings.append(finding)
            if json_path is None:
                mark = click.style("ok  ", fg="green") if finding.passed else click.style("FAIL", fg="red")
                click.echo(f"{mark}  {finding.subject}: {finding.detail}")

    if json_path is None:
        click.echo(f"{click.style('ok  ', fg='green')}  configuration: {config_path}")
    asyncio.run(collect())
    write_json(json_path, [{"subject": f.subject, "passed": f.passed, "detail": f.detail} for f in findings])
    sys.exit(0 if all(finding.passed for finding in findings) else 1)
