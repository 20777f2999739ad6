"""`toolpoint doctor`: is this computer fit to run the daemon?"""

import sys
from pathlib import Path

import click

from daemon.cli.common import DEFAULT_CONFIGURATION, config_option, json_option, show_finding, write_json


@click.command()
@config_option
@json_option
def doctor(config_path: Path, json_path: str | None) -> None:
    """Examine the installation: Python, packages, clashing package names, serial ports, clock, the machine's model.

    Without a configuration at the default place, this computer alone is examined.
    """
    from daemon.diagnosis import examine

    machine = None if config_path == DEFAULT_CONFIGURATION and not config_path.exists() else config_path
    findings = list(examine(machine))
    write_json(json_path, [finding.as_json() for finding in findings])
    if json_path is None:
        for finding in findings:
            show_finding(finding)
    sys.exit(1 if any(finding.failed for finding in findings) else 0)
