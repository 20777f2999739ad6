"""The library's client at a server that may send anything: chunks, messages and what is decoded have bounds.

The library waits for a chunk of any length, joins chunks without end, and lets the server's hello raise its bounds.
"""

import struct
from typing import Any

from asyncua import ua
from asyncua.client.client import Client
from asyncua.client.ua_client import UASocketProtocol
from asyncua.common.connection import SecureConnection, TransportLimits
from asyncua.ua.uaerrors import UaError

from drivers.opcua.received import Received

LONGEST_CHUNK = 65_535
"""The hello says so to the server [byte]."""
LEAST_CHUNK = 1024
"""A server that takes less at once is none [byte]."""
LONGEST_MESSAGE = 4 << 20
"""All that a server tells of its variables at once fits [byte]."""
MOST_CHUNKS = 1024
SIZE = struct.Struct("<4xI")
MESSAGE: Any = ua.Message
"""Its constructor has no types."""


class ReceivedMessage(MESSAGE):  # type: ignore[misc]
    """An answer whose decoding ends with its bytes."""

    def body(self) -> Received:
        """Return what it holds."""
        return Received(b"".join(chunk.Body for chunk in self._chunks))


class ClientLimits(TransportLimits):
    """Bounds that a server's acknowledge lowers for what is sent and never raises."""

    def update_client_limits(self, msg: Any) -> None:
        """Send no larger chunks than the server takes; raises UaError where it takes none."""
        if msg.ReceiveBufferSize < LEAST_CHUNK:
            raise UaError(f"the server takes chunks of {msg.ReceiveBufferSize} byte only")
        self.max_send_buffer = min(LONGEST_CHUNK, msg.ReceiveBufferSize)


class BoundedConnection(SecureConnection):
    """The library's channel."""

    def _receive(self, msg: Any) -> Any:
        found = super()._receive(msg)
        return None if found is None else ReceivedMessage(found._chunks)


class BoundedProtocol(UASocketProtocol):
    """Hands whole chunks to the library; ends a connection whose next chunk would be too long."""

    def __init__(self, timeout: float, security_policy: Any) -> None:
        super().__init__(timeout, security_policy)
        limits = ClientLimits(LONGEST_CHUNK, LONGEST_CHUNK, MOST_CHUNKS, LONGEST_MESSAGE)
        self._connection = BoundedConnection(security_policy, limits)

    def data_received(self, data: bytes) -> None:
        """Take bytes from the socket."""
        data, at, self.receive_buffer = (self.receive_buffer or b"") + data, 0, None
        while self.transport is not None and not self.transport.is_closing() and len(data) - at >= SIZE.size:
            (size,) = SIZE.unpack_from(data, at)
            if not SIZE.size < size <= LONGEST_CHUNK:
                self._fail_all_pending(UaError(f"no OPC UA server answers there (a chunk of {size} byte)"))
                self.transport.abort()
                return
            if len(data) - at < size:
                break
            self._process_received_data(data[at : at + size])
            at += size
        self.receive_buffer = data[at:] or None


def bounded_client(endpoint: str, timeout_s: float) -> Client:
    """Return a client of the library whose connections are bounded."""
    client = Client(endpoint, timeout=timeout_s)
    client.max_messagesize, client.max_chunkcount = LONGEST_MESSAGE, MOST_CHUNKS
    low: Any = client.uaclient

    def make_protocol() -> UASocketProtocol:
        protocol = low.protocol = BoundedProtocol(low._timeout, low.security_policy)
        protocol.pre_request_hook = low._pre_request_hook
        protocol.on_connection_lost = low._on_transport_lost
        protocol.is_session_closing = low._is_session_closing
        return protocol

    low._make_protocol = make_protocol
    return client
