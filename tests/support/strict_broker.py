"""A broker that takes rows by MQTT 5 and keeps to the letter what it announced; it ends connections when it is told."""

import contextlib
import socketserver
import struct
import threading
from collections.abc import Iterator

CONNECT, PUBLISH, SUBSCRIBE, PING, DISCONNECT = 1, 3, 8, 12, 14
RECEIVE_MAXIMUM, RECEIVE_MAXIMUM_EXCEEDED = 0x21, 0x93


class StrictBroker(socketserver.ThreadingTCPServer):
    """Counts how many messages wait for their acknowledgement, which comes when no more arrive."""

    daemon_threads = True

    def __init__(self, receive_maximum: int, cut_after: tuple[int, ...] = (), waits_s: float = 0.02) -> None:
        super().__init__(("127.0.0.1", 0), _Connection)
        self.receive_maximum, self.waits_s = receive_maximum, waits_s
        self.cut_after = list(cut_after)
        """After so many bytes the first, second, ... connection ends without a word."""
        self.most = 0
        self.taken: list[tuple[str, bytes]] = []

    @property
    def port(self) -> int:
        return self.server_address[1]


class _Connection(socketserver.BaseRequestHandler):
    server: StrictBroker

    def handle(self) -> None:
        self._left = self.server.cut_after.pop(0) if self.server.cut_after else 1 << 60
        self._waiting: list[bytes] = []
        with contextlib.suppress(ConnectionError):
            while True:
                self.request.settimeout(self.server.waits_s if self._waiting else None)
                try:
                    head = self._read(1)[0]
                except TimeoutError:
                    for number in self._waiting:
                        self.request.sendall(b"\x40\x02" + number)
                    self._waiting.clear()
                    continue
                self.request.settimeout(None)
                if not self._answer(head, self._read(self._length())):
                    return

    def _answer(self, head: int, body: bytes) -> bool:
        kind = head >> 4
        if kind == CONNECT:
            self.request.sendall(
                struct.pack(">BBBBBBH", 0x20, 6, 0, 0, 3, RECEIVE_MAXIMUM, self.server.receive_maximum)
            )
        elif kind == PUBLISH:
            end = 2 + int.from_bytes(body[:2], "big")
            if head & 6:
                self._waiting.append(body[end : end + 2])
                end += 2
            topic = body[2 : 2 + int.from_bytes(body[:2], "big")].decode()
            self.server.taken.append((topic, body[end + 1 + body[end] :]))  # after the properties
            self.server.most = max(self.server.most, len(self._waiting))
            if len(self._waiting) > self.server.receive_maximum:
                self.request.sendall(bytes([DISCONNECT << 4, 1, RECEIVE_MAXIMUM_EXCEEDED]))
                return False
        elif kind == SUBSCRIBE:
            self.request.sendall(b"\x90\x04" + body[:2] + b"\x00\x01")
        elif kind == PING:
            self.request.sendall(b"\xd0\x00")
        return kind != DISCONNECT

    def _length(self) -> int:
        length = shift = 0
        while True:
            byte = self._read(1)[0]
            length |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return length

    def _read(self, size: int) -> bytes:
        content = b""
        while len(content) < size:
            part = self.request.recv(size - len(content))
            self._left -= len(part)
            if not part or self._left < 0:
                raise ConnectionError
            content += part
        return content


@contextlib.contextmanager
def strict_broker(
    receive_maximum: int = 65_535, cut_after: tuple[int, ...] = (), waits_s: float = 0.02
) -> Iterator[StrictBroker]:
    """Run such a broker on 127.0.0.1."""
    with StrictBroker(receive_maximum, cut_after, waits_s) as broker:
        threading.Thread(target=broker.serve_forever, args=(0.05,), daemon=True).start()
        yield broker
        broker.shutdown()
