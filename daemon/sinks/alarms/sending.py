"""What the two ways of sending share: a time within which a message must be taken, secrets, and certificates."""

import socket
import ssl
import threading
from contextlib import suppress
from pathlib import Path
from typing import Self

from models.json_values import printable

LONGEST_SECRET = 8192
LONGEST_ANSWER = 200


class UnreadableError(Exception):
    """A file that the configuration names cannot be used; the text names the key and the file."""


def secret(key: str, path: Path) -> str:
    """Return the one line of a file; raises UnreadableError, whose text never holds what the file says."""
    try:
        text = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise UnreadableError(
            f"`{key}` {path} cannot be read ({why}): check the path, and that the service may read it"
        ) from None
    if not text or len(text) > LONGEST_SECRET or not text.isprintable():
        raise UnreadableError(f"`{key}` {path} must hold one line of text: write it anew")
    return text


def tls_context(ca_certificate: Path | None) -> ssl.SSLContext:
    """Return what accepts a server whose certificate is vouched for; raises UnreadableError."""
    try:
        return ssl.create_default_context(cafile=None if ca_certificate is None else str(ca_certificate))
    except (OSError, ssl.SSLError) as error:
        raise UnreadableError(
            f"`ca_certificate` {ca_certificate} cannot be read ({error}): name a certificate in PEM"
        ) from error


def answer(text: object, *secrets: str) -> str:
    """Return what a server said, on one line, bounded, without what it must not repeat."""
    words = " ".join(str(text).split())
    for each in secrets:
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
