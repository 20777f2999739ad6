"""Requests and answers of the services: their numbers, headers, and lists that are read piece by piece."""

import asyncio
import struct
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

from asyncua.common.utils import Buffer
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.ua_binary import nodeid_from_binary, struct_from_binary

from drivers.opcua.bounded import Received
from drivers.opcua.server.encoding import NodeKey, node_id, string, time_100ns
from drivers.opcua.server.standard import MOST_NODES

AT_ONCE = 8
"""So many entries of a request are worked on before the loop turns to other work."""
FAULT = 397
OPERATION_TEXT = 0x80
"""A client that asks for diagnostics with this bit gets the sentence beside a status (OPC 10000-4, 7.33)."""
_HEADER = struct.Struct("<qII")
_COUNT = struct.Struct("<i")


class ServiceError(Exception):
    """The whole request is refused."""

    def __init__(self, status: int) -> None:
        super().__init__(f"status {status:08x}")
        self.status = status


class Request:
    """One request: its service, its header, and what is left to read."""

    def __init__(self, number: int, body: Buffer) -> None:
        """`number` is that of the message; raises ServiceError when the beginning cannot be read."""
        self.number, self.body = number, Received.of(body)
        self.service: int = self._read(lambda: int(nodeid_from_binary(self.body).Identifier))
        self.token: Any = self._read(lambda: nodeid_from_binary(self.body).Identifier)
        _, self.handle, diagnostics = self.unpacked("<qII")
        self._pass_over()  # name of an entry in the client's own log
        (timeout_ms,) = self.unpacked("<I")
        self.timeout_s: float = timeout_ms / 1000.0
        self.wants_words = bool(diagnostics & OPERATION_TEXT)
        self._read(lambda: nodeid_from_binary(self.body))  # an additional header, which nothing here needs
        if self.unpacked("<B")[0]:
            self._pass_over()

    def unpacked(self, form: str) -> tuple[Any, ...]:
        size = struct.calcsize(form)
        return struct.unpack(form, self._read(lambda: self.body.read(size)))

    def structure(self, kind: Any) -> Any:
        return self._read(lambda: struct_from_binary(kind, self.body))

    def count(self, most: int = MOST_NODES) -> int:
        """Return how many entries the list that begins here has; raises ServiceError where none, or too many."""
        (count,) = self.unpacked("<i")
        if count <= 0:
            raise ServiceError(StatusCodes.BadNothingToDo)
        if count > most:
            raise ServiceError(StatusCodes.BadTooManyOperations)
        return int(count)

    def numbers(self) -> AsyncIterator[int]:
        return self._listed(lambda: self.unpacked("<I")[0], MOST_NODES)

    def nodes(self) -> AsyncIterator[Any]:
        """Yield the node ids of a list."""
        return self._listed(lambda: self._read(lambda: nodeid_from_binary(self.body)), MOST_NODES)

    def texts(self, most: int) -> AsyncIterator[bytes]:
        """Yield the byte strings of a list."""
        return self._listed(lambda: self._read(lambda: self.body.read(max(self.unpacked("<i")[0], 0))), most)

    def each(self, kind: Any, most: int = MOST_NODES) -> AsyncIterator[Any]:
        """Yield the structures of a list."""
        return self._listed(lambda: self.structure(kind), most)

    async def _listed(self, read: Callable[[], Any], most: int) -> AsyncIterator[Any]:
        """Yield the entries of a list; raises ServiceError as `count` does."""
        for place in range(self.count(most)):
            if place % AT_ONCE == AT_ONCE - 1:
                await asyncio.sleep(0)
            yield read()

    def _pass_over(self) -> None:
        (count,) = self.unpacked("<i")
        self._read(lambda: self.body.skip(max(count, 0)))

    def _read(self, read: Any) -> Any:
        try:
            return read()
        except Exception as error:  # what cannot be read is the client's fault, whatever the library says of it
            raise ServiceError(StatusCodes.BadDecodingError) from error


def answer(service: int, handle: int, body: bytes, status: int = 0) -> bytes:
    """Return an answer: type, header, and its own body."""
    header = _HEADER.pack(time_100ns(time.time()), handle, status)
    return b"".join((node_id((0, service)), header, b"\x00\xff\xff\xff\xff\x00\x00\x00", body))


def fault(handle: int, status: int) -> bytes:
    """Return the answer to a request that is refused as a whole."""
    return answer(FAULT, handle, b"", status)


def too_large(longer: bytes) -> bytes:
    """Return the answer in place of one that is longer than the client takes."""
    _, handle, _ = _HEADER.unpack_from(longer, len(node_id((0, FAULT))))
    return fault(handle, StatusCodes.BadResponseTooLarge)


def listed(entries: list[bytes]) -> bytes:
    """Return a list of what is encoded already."""
    return _COUNT.pack(len(entries)) + b"".join(entries)


def results(entries: list[bytes], words: list[str] | None = None) -> bytes:
    """Return results with their diagnostics; `words`: a sentence for each, where the client asked for them."""
    if not words or not any(words):
        return listed(entries) + b"\xff\xff\xff\xff"
    return listed(entries) + listed([b"\x10" + string(each) if each else b"\x00" for each in words])


def status_bytes(status: int) -> bytes:
    return status.to_bytes(4, "little")


def key_of(node: Any) -> NodeKey:
    """Return the key of a node that a client names; one that nobody has for a form that we do not use."""
    identifier = node.Identifier
    return (node.NamespaceIndex, identifier if isinstance(identifier, int | str) else "")
