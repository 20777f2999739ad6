"""Kills what carries the history of a simulated fleet, at random moments, and brings it up again."""

import contextlib
import os
import random
import signal
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

from mosquitto import Mosquitto
from postgresql import Server

from daemon.simulation.fleet.run import Keeper

Kill = Callable[[], None]


class Killer:
    """A thread that makes so many kills, evenly over a time, each at a random moment of its share."""

    def __init__(self, kills: int, within_s: float, seed: int, others: Mapping[str, Kill]) -> None:
        """`others`: what is killed beside the kept processes, and started again, by name."""
        self.done: Counter[str] = Counter()
        self._kills, self._within_s, self._others = kills, within_s, others
        self._random = random.Random(seed)
        self._thread = threading.Thread(target=self._run, name="killer")
        self._keeper: Keeper | None = None

    def begin(self, keeper: Keeper) -> None:
        """Begin; `simulate_fleet` calls it when everything runs."""
        self._keeper = keeper
        self._thread.start()

    def join(self) -> None:
        """Wait for the last kill."""
        self._thread.join()

    def _kill_kept(self, name: str) -> None:
        """Kill a kept process; where the one before has died a moment ago, the next one, if one comes."""
        assert self._keeper is not None
        for _ in range(100):
            pid = self._keeper.pid(name)
            with contextlib.suppress(ProcessLookupError):
                if pid is not None:
                    os.kill(pid, signal.SIGKILL)
                    return
            threading.Event().wait(0.05)

    def _run(self) -> None:
        assert self._keeper is not None
        share_s = self._within_s / self._kills
        turns = [*self._keeper.names, *self._others]
        for number in range(self._kills):
            before_s = self._random.uniform(0.0, share_s)
            threading.Event().wait(before_s)
            # Each in turn first, so that few kills reach all of them; then at random.
            name = turns[number] if number < len(turns) else self._random.choice(turns)
            self.done[name.partition(" ")[0]] += 1
            if name in self._others:
                self._others[name]()
            else:
                self._kill_kept(name)
            threading.Event().wait(share_s - before_s)


def database_kill(server: Server, *settings: str) -> Kill:
    """Return what kills a PostgreSQL server and starts it again."""

    def kill() -> None:
        server.kill()
        server.start(*settings)

    return kill


def plant_broker(folder: Path) -> Mosquitto:
    """Return a broker with the settings that ship, but for its place."""
    shipped = (Path(__file__).parents[2] / "systemd/plant/mosquitto.conf").read_text("utf-8").splitlines()
    settings = [line for line in shipped if line and not line.startswith(("#", "listener", "persistence_location"))]
    return Mosquitto(folder, *settings, f"persistence_location {folder}/")


def broker_kill(broker: Mosquitto) -> Kill:
    """Return what kills a broker and starts it again."""

    def kill() -> None:
        broker.kill()
        broker.start()

    return kill


def dsn_of(server: Server, password: str) -> str:
    """Return how a command reaches a server."""
    return f"host=127.0.0.1 port={server.port} dbname=toolpoint user=toolpoint password='{password}'"
