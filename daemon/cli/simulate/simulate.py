"""`toolpoint simulate`: one's own configuration, or the simulated machine alone, on real wires."""

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import config_option, option, read_configuration, refuse
from daemon.cli.operate.run import parse_simulated_clock
from daemon.cli.options import EXISTING, NOT_NEGATIVE, POSITIVE, FiniteFloat, hours_option, json_option
from daemon.simulation.replaying import map_of
from daemon.simulation.simulation import packed_simulation, recorded_simulation, simulated_day
from daemon.telemetry.logs import configure_logging
from drivers.contract import DriverError


@click.command()
@config_option
@option(
    "--directory",
    type=click.Path(path_type=Path, file_okay=False),
    help="Where wires, store and logs go; left out: a temporary folder.",
)
@option(
    "--simulated-clock",
    metavar="REAL:UTC:SPEED",
    help="The machine alone, for a daemon on the same clock: monotonic and calendar second at which simulated time "
    "is 0, and its speed; '-' reads them from standard input.",
)
@option(
    "--minutes", type=POSITIVE, help="One's own machine: simulated minutes until it ends; left out: Ctrl-C ends it."
)
@option(
    "--speed",
    type=FiniteFloat(min=0, min_open=True, max=600),
    default=60.0,
    help="One's own machine: simulated seconds per second.",
)
@option("--enable", is_flag=True, help="One's own machine: switch the output on at once.")
@json_option
@option("--day", type=int, help="Seed of the simulated day (default: the demo's).")
@option("--standing", is_flag=True, help="Stand at a safe point, spindle off, and call the guard again and again.")
@option(
    "--recording",
    type=EXISTING,
    help="Play this recording instead of the simulated machine (prepared by `toolpoint replay`).",
)
@option("--map", "map_path", type=EXISTING, help="Map of the recording's columns (YAML).")
@option(
    "--packs",
    "packs_path",
    type=EXISTING,
    help="Script (YAML) of a sensor that is moved between two packs (prepared by `toolpoint latency`).",
)
@hours_option("--hours", help="Play these hours of the recording only.")
@option("--faults", "faults_path", type=EXISTING, help="Fault script (YAML).")
@option("--until-s", type=NOT_NEGATIVE, help="Send no cycle that would begin after this time [s].")
@option("--report-s", type=POSITIVE, default=10.0, help="Time between reports [s].")
@option(
    "--server-key",
    type=EXISTING,
    help="Private key of the simulated CNC; it then demands what cnc.opcua.security says.",
)
def simulate(
    config_path: Path,
    directory: Path | None,
    simulated_clock: str | None,
    minutes: float | None,
    speed: float,
    enable: bool,
    json_path: str | None,
    day: int | None,
    standing: bool,
    recording: Path | None,
    map_path: Path | None,
    packs_path: Path | None,
    hours: tuple[float, float] | None,
    faults_path: Path | None,
    until_s: float | None,
    report_s: float,
    server_key: Path | None,
) -> None:
    """Simulate a configuration: its sensors, axes and CNC driver on a simulated machine, with a daemon beside it.

    Sensors of any source and components of any name sit at plausible places of the simulated machine, and a model is
    trained on its days. With --simulated-clock the simulated machine runs alone: serial lines, displacement file and
    the CNC's server, with reports as JSON lines; --day and the options after it are for that.
    """
    if simulated_clock is None:
        from daemon.cli.simulate.own_machine import simulate_own

        simulate_own(config_path, directory, minutes=minutes, speed=speed, enable=enable, json_path=json_path)
        return
    if directory is None or not directory.is_dir():
        refuse("--simulated-clock needs --directory with a folder that exists")
    configuration = read_configuration(config_path)
    configure_logging(configuration.service.log_level)

    def report(content: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(content) + "\n")
        sys.stdout.flush()

    if simulated_clock == "-":
        report({"loaded": True})
        simulated_clock = sys.stdin.readline().strip()
    clock = parse_simulated_clock(simulated_clock)
    try:
        if packs_path is not None:
            work = packed_simulation(configuration, clock, packs_path, report)
        elif recording is not None:
            work = recorded_simulation(
                configuration, clock, recording, recording_map=map_of(recording, map_path), hours=hours
            )
        else:
            work = simulated_day(configuration, clock, day, standing=standing)
        asyncio.run(
            work.run(
                directory,
                faults_path=faults_path,
                until_s=until_s,
                report_s=report_s,
                report=report,
                server_key=server_key,
            )
        )
    except (DriverError, ValueError) as error:
        refuse(str(error))
    except KeyboardInterrupt:
        return
