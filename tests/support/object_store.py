"""An object store that speaks S3, moto's server in a process of its own, and a wire to it that can be cut."""

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import boto3

from daemon.simulation.processes import free_port

PATIENCE_S = 60.0
BUCKET = "plant"


class ObjectStore:
    """A server on 127.0.0.1 with one bucket. It keeps objects in memory: `start` puts back what was there."""

    def __init__(self) -> None:
        self.port = free_port()
        self._process: subprocess.Popen[bytes] | None = None
        self._kept: dict[str, bytes] = {}

    def _bucket(self) -> Any:
        there = boto3.resource("s3", endpoint_url=f"http://127.0.0.1:{self.port}", region_name="us-east-1")
        return there.Bucket(BUCKET)

    def start(self) -> None:
        words = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)]
        self._process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                break
            time.sleep(0.02)
        bucket = self._bucket()
        bucket.create()
        for key, content in self._kept.items():
            bucket.put_object(Key=key, Body=content)

    def objects(self) -> dict[str, bytes]:
        return {each.key: each.get()["Body"].read() for each in self._bucket().objects.all()}

    def kill(self) -> None:
        """End it as a power cut does; what was complete then, a disk would have."""
        self._kept = self.objects()
        self.end()

    def end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def wire(port: int, before: Callable[[bytes], None]) -> Iterator[int]:
    """Pass on what clients send to a port, having shown each piece of it; yields the port that passes on."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=_accept, args=(listener, port, before), daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)


def _accept(listener: socket.socket, port: int, before: Callable[[bytes], None]) -> None:
    with contextlib.suppress(OSError):
        while True:
            client, _ = listener.accept()
            try:
                server = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
            except OSError:
                client.close()
                continue
            for from_, to, shown in ((client, server, before), (server, client, lambda _piece: None)):
                threading.Thread(target=_pass_on, args=(from_, to, shown), daemon=True).start()


def _pass_on(from_: socket.socket, to: socket.socket, before: Callable[[bytes], None]) -> None:
    with contextlib.suppress(OSError):
        while piece := from_.recv(65_536):
            before(piece)
            to.sendall(piece)
    for each in (from_, to):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)
