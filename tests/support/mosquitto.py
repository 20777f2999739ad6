"""An MQTT broker of a maker's own, mosquitto, and its client that subscribes, for as long as a test needs them."""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.simulation.processes import free_port

PATIENCE_S = 60.0
PROGRAM = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
CLIENT = shutil.which("mosquitto_sub")


def wait_until(condition: Callable[[], object]) -> None:
    """Wait for something that has no event of its own."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come about"
        time.sleep(0.01)


class Mosquitto:
    """A broker on 127.0.0.1 with these lines of configuration."""

    def __init__(self, folder: Path, *settings: str) -> None:
        if PROGRAM is None:
            pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
        self.port = free_port()
        self._file = folder / "m.conf"
        self.configure(*settings)
        self._process: subprocess.Popen[bytes] | None = None

    def configure(self, *settings: str) -> None:
        self._file.write_text("\n".join([f"listener {self.port} 127.0.0.1", *settings, "user root"]) + "\n")

    def start(self) -> None:
        self._process = subprocess.Popen([str(PROGRAM), "-c", str(self._file)], stderr=subprocess.DEVNULL)
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                break
            time.sleep(0.02)

    def kill(self) -> None:
        """End it without a word, as a power cut does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def mosquitto(folder: Path, *settings: str) -> Iterator[int]:
    """Run a broker on 127.0.0.1 with these lines of configuration; yields its port."""
    broker = Mosquitto(folder, *settings)
    broker.start()
    try:
        yield broker.port
    finally:
        broker.kill()


class Subscriber:
    """What mosquitto's own client prints of some topics."""

    def __init__(self, port: int, *topics: str, options: tuple[str, ...] = ()) -> None:
        if CLIENT is None:
            pytest.skip("mosquitto_sub is not installed (apt-get install mosquitto-clients)")
        command = ["stdbuf", "-oL", CLIENT, "-h", "127.0.0.1", "-p", str(port), "-V", "mqttv5", "-q", "1"]
        command += ["-d", "-F", "=%r\t%t\t%p"]
        for topic in topics:
            command += ["-t", topic]
        self.messages: list[tuple[bool, str, str]] = []
        """Whether it was retained, topic, payload."""
        self._subscribed = threading.Event()
        self._changed = threading.Condition()
        self._process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        assert self._subscribed.wait(PATIENCE_S), "mosquitto_sub has not subscribed"

    def _read(self) -> None:
        assert self._process.stdout is not None
        for raw in self._process.stdout:
            line = raw.decode().rstrip("\n")
            if line.startswith("Subscribed"):
                self._subscribed.set()
            if line.startswith("="):
                retained, topic, payload = line[1:].split("\t", 2)
                with self._changed:
                    self.messages.append((retained == "1", topic, payload))
                    self._changed.notify_all()

    def until(self, enough: Callable[[list[tuple[bool, str, str]]], bool]) -> None:
        """Wait for messages."""
        with self._changed:
            assert self._changed.wait_for(lambda: enough(self.messages), PATIENCE_S), self.messages[-3:]

    def last(self, topic: str) -> Any:
        """Return the newest payload of a topic, from JSON where it is; None where none came."""
        found = [payload for _, name, payload in list(self.messages) if name == topic]
        return _read(found[-1]) if found else None

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()


def _read(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


@contextlib.contextmanager
def subscriber(port: int, *topics: str, options: tuple[str, ...] = ()) -> Iterator[Subscriber]:
    """Subscribe with mosquitto's own client."""
    made = Subscriber(port, *topics, options=options)
    try:
        yield made
    finally:
        made.close()
