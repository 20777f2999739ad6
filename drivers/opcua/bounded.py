"""The library's client at a server that may send anything: chunks, messages and what is decoded have bounds."""

import asyncio
import struct
from typing import Any, Self

from asyncua import ua
from asyncua.client.client import Client
from asyncua.client.ua_client import UASocketProtocol
from asyncua.common.connection import SecureConnection, TransportLimits
from asyncua.common.utils import Buffer, NotEnoughData
from asyncua.ua import ua_binary
from asyncua.ua.uaerrors import UaError

LONGEST_CHUNK = 65_535
"""The hello says so to the server [byte]."""
LEAST_CHUNK = 1024
"""A server that takes less at once is none [byte]."""
LONGEST_MESSAGE = 4 << 20
"""All that a server tells of its variables at once fits [byte]."""
MOST_CHUNKS = 1024
NAMELESS = ua.EndpointDescription()
SIZE = struct.Struct("<4xI")
TYPES: Any = ua
"""The library's, whose own types say less than they take."""

ARRAY, SHAPED, KIND = 0x80, 0x40, 0x3F
"""Bits of the first byte of a variant: it is an array, dimensions follow, number of the type."""
LIBRARY: Any = ua_binary
_variant_of_any = LIBRARY.variant_from_binary


class Received(Buffer):
    """A buffer of the library that is read forwards only."""

    @classmethod
    def of(cls, buffer: Buffer) -> Self:
        return cls(buffer.read(len(buffer)))

    def read(self, size: int) -> bytes:
        """Return the next bytes; raises NotEnoughData where they are fewer, and for a negative number."""
        if size < 0:
            raise NotEnoughData(f"a length of {size}")
        return super().read(size)

    def skip(self, size: int) -> None:
        """Pass over bytes; raises NotEnoughData where they are fewer, and for a negative number."""
        if size < 0:
            raise NotEnoughData(f"a length of {size}")
        super().skip(size)

    def copy(self, size: int = -1) -> Self:
        """Return a buffer of the next bytes, which stay."""
        return type(self)(self._data, self._cur_pos, self._size if size < 0 else min(size, self._size))


def variant_of_received(data: Buffer) -> ua.Variant:
    """Return a variant as the library does, but for the shape of an array; raises NotEnoughData."""
    if not isinstance(data, Received):
        whole: ua.Variant = _variant_of_any(data)
        return whole
    encoding = data.read(1)[0]
    kind: Any = ua.datatype_to_varianttype(encoding & KIND)
    array = bool(encoding & ARRAY)
    if array and kind is ua.VariantType.Null:
        raise NotEnoughData("an array of the null type")
    value = (LIBRARY.unpack_uatype_array if array else LIBRARY.unpack_uatype)(kind, data)
    if encoding & SHAPED:
        LIBRARY.unpack_uatype_array(ua.VariantType.Int32, data)
    return ua.Variant(value, kind, is_array=array)


def _decode_variants_so() -> None:
    """Let the library decode every variant of what was received by the function above."""
    LIBRARY.variant_from_binary = variant_of_received
    for what in ("uatype", "uatype_array", "list", "type", "dataclass"):
        getattr(LIBRARY, f"_create_{what}_deserializer").cache_clear()  # made before, it knows the library's function


_decode_variants_so()


class ReceivedMessage(TYPES.Message):  # type: ignore[misc]
    """An answer whose decoding ends with its bytes."""

    def body(self) -> Received:
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

    async def send_hello(self, url: str, max_messagesize: int = 0, max_chunkcount: int = 0) -> Any:
        """Tell the server how long a chunk may be: the library tells it 2 GiB."""
        ack = self._callbackmap[0] = asyncio.get_running_loop().create_future()
        assert self.transport is not None
        hello = TYPES.Hello(0, LONGEST_CHUNK, LONGEST_CHUNK, max_messagesize, max_chunkcount, url)
        self.transport.write(LIBRARY.uatcp_to_binary(TYPES.MessageType.Hello, hello))
        return await asyncio.wait_for(ack, self.timeout)

    def data_received(self, data: bytes) -> None:
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
    """Return a client of the library whose connections are bounded, and whose watchdog waits as long as all else."""
    client = Client(endpoint, timeout=timeout_s, watchdog_intervall=timeout_s)
    client.max_messagesize, client.max_chunkcount = LONGEST_MESSAGE, MOST_CHUNKS
    low: Any = client.uaclient

    def make_protocol() -> UASocketProtocol:
        protocol = low.protocol = BoundedProtocol(low._timeout, low.security_policy)
        protocol.pre_request_hook = low._pre_request_hook
        protocol.on_connection_lost = low._on_transport_lost
        protocol.is_session_closing = low._is_session_closing
        return protocol

    create_session = low.create_session

    async def create_whole_session(asked: ua.CreateSessionParameters) -> Any:
        """Let a server that does not say at a session what it is say it when it is asked for its endpoints."""
        made = await create_session(asked)
        if not all(each.Server.ApplicationUri for each in made.ServerEndpoints or (NAMELESS,)):
            made.ServerEndpoints = await low.get_endpoints(ua.GetEndpointsParameters(EndpointUrl=asked.EndpointUrl))
        return made

    low._make_protocol, low.create_session = make_protocol, create_whole_session
    return client
