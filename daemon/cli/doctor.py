"""`toolpoint doctor`: is this computer fit to run the daemon?"""

import sys

import click

from daemon.cli.common import json_option, write_json


@click.command()
@json_option
def doctor(json_path: str | None) -> None:
    """Examine the installation: Python, packages, clashing package names, serial ports, clock, socket rights."""
    from daemon.diagnosis import examine

    findings = list(examine())
    write_json(json_path, [{"subject": f.subject, "passed": f.passed, "detail": f.detail} for f in findings])
    if json_path is None:
        for finding in findings:
            mark = click.style("ok  ", fg="green") if finding.passed else click.style("FAIL", fg="red")
            click.echo(f"{mark}  {finding.subject}: {finding.detail}")
    sys.exit(0 if all(finding.passed for finding in findings) else 1)
