"""What the two ways of sending share: a time within which a message must be taken, and answers."""

import socket
import ssl
import threading
from contextlib import suppress
from typing import Self

from models.json_values import printable

LONGEST_ANSWER = 200


def answer(text: object, *secrets: str) -> str:
    """Return what a server said, on one line, bounded, without what it must not repeat."""
    words = " ".join(str(text).split())
    for each in filter(None, secrets):
        words = words.replace(each, "...")
    return printable(words)[:LONGEST_ANSWER]


class Connection:
    """A connection that is broken off after a time, also where the other end sends a byte now and then."""

    def __init__(self, host: str, port: int, timeout_s: float, whole_s: float) -> None:
        """`timeout_s` bounds every wait, `whole_s` all of them together."""
        self._host, self._whole_s = host, whole_s
        self._over = threading.Event()
        self._timer = threading.Timer(whole_s, self._end)
        self._timer.daemon = True
        self.socket = socket.create_connection((host, port), timeout_s)

    def __enter__(self) -> Self:
        self._timer.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        self._timer.cancel()
        self.socket.close()
        if self._over.is_set() and isinstance(error, Exception):
            raise TimeoutError(f"nothing was taken within {self._whole_s:g} s") from error

    def encrypt(self, context: ssl.SSLContext) -> socket.socket:
        """Go on encrypted; return what to go on with."""
        self.socket = encrypted = context.wrap_socket(
            self.socket, server_hostname=self._host, do_handshake_on_connect=False
        )
        encrypted.do_handshake()
        return encrypted

    def _end(self) -> None:
        self._over.set()
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
