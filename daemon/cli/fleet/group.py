"""`toolpoint fleet`: many machines together."""

import os
import signal
import sys
import tempfile
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command_group import Group
from daemon.cli.common import FAILED, FILE, option, refuse, say, write_json
from daemon.cli.options import EXISTING_FILE, POSITIVE, ProgressBar, directory_option, json_option, writable

if TYPE_CHECKING:
    from config.schema.plant_store import PlantStoreConfig


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=FILE)
@option("--machines", "machine_map", required=True, type=FILE, help="Which recording is of which machine (YAML).")
@option("--type-id", default="type", help="What the type is called in the models that are made of it.")
@option("--channels", help="Displacement channels, separated by commas. Without: those that all machines have.")
@option("--workers", type=click.IntRange(1, 1024), default=1, help="Processes that read and fit machines.")
@option("--dask", metavar="ADDRESS", help="Let the workers of a Dask cluster do it; they must see the same files.")
@option("-o", "--output", type=FILE, callback=writable(), help="The file of the type, for `thermal train --prior`.")
@json_option
def train(
    recordings: tuple[Path, ...],
    machine_map: Path,
    type_id: str,
    channels: str | None,
    workers: int,
    dask: str | None,
    output: Path | None,
    json_path: str | None,
) -> None:
    """Learn a type of machine from the RECORDINGS of many machines.

    Tells how good it is on machines that it does not know: each is left out in turn, and taken over with none, one,
    three and ten of its own recordings. Recordings of one machine are given in the order in which they were made.
    A machine or a recording that cannot be used is named and left out; the exit status is then 1.
    """
    from config.files import write_whole
    from config.recordings.machine_map import load_machine_map
    from daemon.telemetry.metrics import keep_one_heap
    from daemon.workbench.thermal.fleet import fleet_executor, train_fleet
    from daemon.workbench.thermal.fleet_report import summary

    if dask is not None and workers != 1:
        raise click.UsageError("--workers is for processes of this computer; leave it out with --dask")
    if channels is not None and not channels.strip(", "):
        raise click.BadParameter(
            "there is no channel in it; without it, those that all machines have", param_hint="--channels"
        )
    machines = load_machine_map(machine_map, recordings)
    wanted = None if channels is None else [name.strip() for name in channels.split(",") if name.strip()]
    keep_one_heap()
    with ProgressBar() as bar, fleet_executor(workers, dask) as executor:
        result = train_fleet(machines, type_id, wanted, executor, bar.show)
    found = summary(result, output)
    if output is not None:
        try:
            write_whole(output, result.machine_type.to_json())
        except OSError as error:
            refuse(f"{output}: the type cannot be written ({error.strerror})")
    _show(found)
    write_json(json_path, found)
    if found["refused"]:
        refuse(f"left out, because they cannot be used:{_named(found['refused'])}", FAILED)


def _named(refused: list[dict[str, Any]]) -> str:
    """Return machines and recordings with the reason, a line for each."""
    return "".join(
        f"\n  {one['machine']}: {one['why']}" + ("; learned from its other recordings" if one["recording"] else "")
        for one in refused
    )


def _show(found: dict[str, Any]) -> None:
    """Write the outcome for people, on standard error."""
    for machine in found["machines"]:
        for warning in machine["warnings"]:
            say(f"warning: {machine['machine']}: {warning}")
        if machine["stale_recordings"]:
            say(
                f"{machine['machine']}: changed after its first {machine['stale_recordings']} recordings, which count "
                "little"
            )
    made = found["type"]
    of = f"the models of {len(made['machines_kept'])} of {len(found['machines'])} machines"
    say(f"{made['type_id']}: {of}, {made['sensors']} sensors, {made['directions']} directions")
    if not found["left_out"]:
        return
    say("machines left out in turn; share of the error that is gone, mean (worst machine)")
    say(f"{'own recordings':>14}  {'machines':>8}  {'with the fleet':>15}  {'alone':>15}")
    for row in found["left_out"]:
        say(f"{row['recordings']:14}  {row['machines']:8}  {_share(row['with_prior'])}  {_share(row['alone'])}")


def _share(figures: dict[str, float] | None) -> str:
    if figures is None:
        return f"{'-':>15}"
    return f"{figures['mean']:8.1%} ({figures['worst']:4.0%})"


@click.command()
@option(
    "--config",
    "-c",
    "config_path",
    type=EXISTING_FILE,
    required=True,
    help="File with the sections `mqtt` and `postgresql`; docs/how-to/run-a-plant.md shows one.",
)
@option("--status", is_flag=True, help="Say instead whether such a process runs, and how late each machine's rows are.")
@option("--late-s", type=POSITIVE, default=60.0, help="With --status: end with 1 where no machine's row is newer [s].")
@json_option
def store(config_path: Path, status: bool, late_s: float, json_path: str | None) -> None:
    """Store in PostgreSQL what machines publish over MQTT, until SIGTERM or Ctrl-C.

    A message is acknowledged when its row is committed; repeats change nothing. One such process per broker.
    """
    from config.loader import load_yaml_model
    from config.schema.plant_store import PlantStoreConfig
    from daemon.ending import set_by_signals
    from daemon.sinks.plant_store import PlantStore
    from daemon.telemetry.logs import configure_logging
    from daemon.telemetry.sd_notify import ServiceManager

    config = load_yaml_model(config_path, PlantStoreConfig)
    if status:
        _say_status(config, late_s, json_path)
        return
    if json_path is not None:
        raise click.UsageError("--json belongs to --status")
    configure_logging("info")
    stop = set_by_signals(signal.SIGTERM, signal.SIGINT)
    manager = ServiceManager()
    manager.ready("storing")
    folder = os.environ.get("STATE_DIRECTORY")  # from the unit
    PlantStore(config, stop, manager.watchdog, Path(folder) / "newest.json" if folder else None).run()


def _say_status(config: "PlantStoreConfig", late_s: float, json_path: str | None) -> None:
    """Write how late each machine is; ends with 1 where nothing is stored."""
    from daemon.sinks.contract import SinkError
    from daemon.sinks.plant_store import store_status

    try:
        found = store_status(config)
    except SinkError as error:
        refuse(str(error), FAILED)
    write_json(json_path, found)
    machines = found["machines"]
    for each in machines if json_path is None else ():
        newest = datetime.fromtimestamp(each["newest_utc_s"], UTC).isoformat(timespec="seconds")
        click.echo(f"{each['machine']}: {each['late_s']:.0f} s late, its newest row is of {newest}")
    arrives = any(each["late_s"] <= late_s for each in machines)
    if not found["running"]:
        refuse("no store is connected to the database: see `systemctl status toolpoint-store`", FAILED)
    if not arrives:
        refuse(
            f"no machine's newest row is younger than {late_s:g} s: see that the sinks of the machines run, and that "
            f"the broker lets this store read {config.mqtt.topic}/+/history/+",
            FAILED,
        )


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

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends what it has started, as Ctrl-C does
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


@click.group(cls=Group)
def fleet() -> None:
    """Many machines together."""


for _command in (simulate, store, train):
    fleet.add_command(_command)
