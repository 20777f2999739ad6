"""What carries the histories of a simulated fleet: sinks of many machines in one process, and the plant's store."""

import signal
import threading
from collections.abc import Sequence
from pathlib import Path

from config.schema import Configuration
from config.schema.plant_store import PlantStoreConfig
from config.schema.service import HistoryConfig
from config.schema.sinks import SinkConfig
from daemon.ending import set_by_signals
from daemon.sinks.plant_store import PlantStore
from daemon.sinks.running import run_sinks
from daemon.telemetry.logs import configure_logging

Machine = tuple[str, Path]
"""Name and store."""


def with_sink(base: Configuration, machine: Machine, sink: SinkConfig) -> Configuration:
    """Return the configuration of one machine whose history goes to a sink."""
    name, store = machine
    return base.model_copy(update={"machine": name, "history": HistoryConfig(path=store), "sinks": (sink,)})


def run_senders(base: Configuration, machines: Sequence[Machine], sink: SinkConfig) -> None:
    """Send the histories of some machines until told to stop; body of a process of its own.

    `base`, the configuration that the machines share, is given: a sender that was killed loads nothing of a machine.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = set_by_signals(signal.SIGTERM)
    configure_logging("error")
    threads = [
        threading.Thread(target=run_sinks, args=(with_sink(base, machine, sink), stop), name=machine[0])
        for machine in machines
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def run_store(config: PlantStoreConfig) -> None:
    """Store what comes over a broker until told to stop; body of a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = set_by_signals(signal.SIGTERM)
    configure_logging("error")
    PlantStore(config, stop).run()
