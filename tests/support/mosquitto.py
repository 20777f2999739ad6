"""An MQTT broker of a maker's own, mosquitto, for as long as a test needs it."""

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.simulation.processes import free_port

PATIENCE_S = 30.0
PROGRAM = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")


@contextlib.contextmanager
def mosquitto(folder: Path, *settings: str) -> Iterator[int]:
    """Run a broker on 127.0.0.1 with these lines of configuration; yields its port."""
    if PROGRAM is None:
        pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
    port = free_port()
    lines = [f"listener {port} 127.0.0.1", *settings, "user root"]
    (folder / "m.conf").write_text("\n".join(lines) + "\n")
    process = subprocess.Popen([PROGRAM, "-c", str(folder / "m.conf")], stderr=subprocess.DEVNULL)
    try:
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                break
            time.sleep(0.02)
        yield port
    finally:
        process.kill()
        process.wait()
