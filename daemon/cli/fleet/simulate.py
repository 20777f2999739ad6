"""`toolpoint fleet simulate`: histories of many simulated machines, sent into real sinks and counted there."""

import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path

import click

from daemon.cli.common import option, say, write_json
from daemon.cli.options import POSITIVE, directory_option, json_option


@click.command()
@option("--machines", type=click.IntRange(1, 1000), default=10, help="How many.")
@option("--minutes", type=POSITIVE, default=10.0, help="Simulated minutes.")
@option("--speed", type=POSITIVE, default=1.0, help="Simulated seconds per second.")
@option("--postgres", "dsn", metavar="DSN", required=True, help="Database, such as postgresql://user@host/db.")
@option(
    "--mqtt",
    metavar="URL",
    help="Send over this broker, such as mqtt://user@host:1883, and store from there with `fleet store`.",
)
@option("--period-s", type=POSITIVE, default=1.0, help="Time from one look of a sink for new rows to the next [s].")
@directory_option
@json_option
def simulate(
    machines: int,
    minutes: float,
    speed: float,
    dsn: str,
    mqtt: str | None,
    period_s: float,
    directory: Path | None,
    json_path: str | None,
) -> None:
    """Record histories of many simulated machines, send them to a database, and count what arrived.

    Every machine has the published machine's 302 sensors and the physics of the simulated machine, with parameters of
    its own. Its rows end about now, or follow those that the database has of it. Exit status 1 when a row was lost or
    doubled. Passwords stand in the environment (PGPASSWORD, TOOLPOINT_BROKER_PASSWORD): all see a command line.
    """
    from daemon.simulation.fleet.run import check_route, plan_of, route_of, simulate_fleet

    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() if directory is None else nullcontext(str(directory)) as folder:
        route = route_of(dsn, mqtt, Path(folder), period_s)
        plan = plan_of(Path(folder), machines, minutes, speed, dsn)
        check_route(route)
        result = simulate_fleet(plan, route, say=say)
    found = result.as_json()
    write_json(json_path, found)
    if json_path is None:
        rows, lag = found["rows"], found["lag_s"]
        click.echo(
            f"{rows['recorded']} rows recorded, {rows['stored']} in the database: {rows['lost']} lost, "
            f"{rows['duplicates']} doubled; {rows['waiting']} not acknowledged"
        )
        click.echo(f"delay to the database: half within {lag['p50']} s, 99 of 100 within {lag['p99']} s")
    sys.exit(0 if result.complete else 1)
