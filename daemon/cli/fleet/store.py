"""`toolpoint fleet store`: the plant's end of a broker."""

import signal
import threading
from pathlib import Path

import click

from daemon.cli.common import EXISTING_FILE, option


@click.command()
@option(
    "--config",
    "-c",
    "config_path",
    type=EXISTING_FILE,
    required=True,
    help="File with the sections `mqtt` and `postgresql`; docs/how-to/run-a-plant.md shows one.",
)
def store(config_path: Path) -> None:
    """Store in PostgreSQL what machines publish over MQTT, until SIGTERM or Ctrl-C.

    A message is acknowledged when its row is committed; repeats change nothing. One such process per broker.
    """
    from config.loader import load_yaml_model
    from config.schema.plant_store import PlantStoreConfig
    from daemon.sinks.plant_store import PlantStore
    from daemon.telemetry.logs import configure_logging
    from daemon.telemetry.sd_notify import ServiceManager

    config = load_yaml_model(config_path, PlantStoreConfig)
    configure_logging("info")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    ServiceManager().ready("storing")
    PlantStore(config, stop).run()
