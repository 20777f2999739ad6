"""`toolpoint fleet store`: the plant's end of a broker."""

import signal
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.cli.common import option, refuse, write_json
from daemon.cli.options import EXISTING_FILE, POSITIVE, json_option

if TYPE_CHECKING:
    from config.schema.plant_store import PlantStoreConfig

NOT_STORED = 1
"""Exit status where nothing is stored now."""


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
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    manager = ServiceManager()
    manager.ready("storing")
    PlantStore(config, stop, manager.watchdog).run()


def _say_status(config: "PlantStoreConfig", late_s: float, json_path: str | None) -> None:
    """Write how late each machine is; ends with 1 where nothing is stored."""
    from daemon.sinks.contract import SinkError
    from daemon.sinks.plant_store import store_status

    try:
        found = store_status(config)
    except SinkError as error:
        refuse(str(error), NOT_STORED)
    write_json(json_path, found)
    machines = found["machines"]
    for each in machines if json_path is None else ():
        newest = datetime.fromtimestamp(each["newest_utc_s"], UTC).isoformat(timespec="seconds")
        click.echo(f"{each['machine']}: {each['late_s']:.0f} s late, its newest row is of {newest}")
    arrives = any(each["late_s"] <= late_s for each in machines)
    if not found["running"]:
        refuse("no store is connected to the database: see `systemctl status toolpoint-store`", NOT_STORED)
    if not arrives:
        refuse(
            f"no machine's newest row is younger than {late_s:g} s: see that the sinks of the machines run, and that "
            f"the broker lets this store read {config.mqtt.topic}/+/history/+",
            NOT_STORED,
        )
