"""Read and Write of OPC UA (OPC 10000-4, 5.11) with as little work per call as the daemon's feedback needs.

The library keeps the channel: socket, keys, tokens, sequence numbers. Only the body of these two requests is put
together here, from bytes that the library's own encoder made once per request (OPC 10000-6, 5.2), and a plain answer
is taken apart here; whatever is not plain (diagnostics, arrays, other types) goes to the library's decoder. Messages
of one whole chunk are framed here too (6.7.2); parts of one, several at once, another token, a number out of turn, a
signature that does not fit and an answer nobody waits for are left to the library untouched, which judges them.
"""

import asyncio
import contextlib
import math
import struct
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from asyncua import ua
from asyncua.client.ua_client import UaClient
from asyncua.crypto import uacrypto
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.ua_binary import nodeid_to_binary, struct_from_binary, struct_to_binary
from asyncua.ua.uaerrors import UaError

from drivers.opcua.bounded import Received

HEADER = struct.Struct("<4sIII")
"""Type and that the chunk is the only one, size, number of the channel, number of its token."""
SEQUENCE = struct.Struct("<II")
"""Number in the channel's sequence, number of the request."""
WHOLE_MESSAGE = b"MSGF"
LIBRARY: Any = uacrypto
"""Its InvalidSignature is a class of its own, which it hides from a type checker."""
LAST_NUMBER = (1 << 32) - 1


class Channel:
    """Frames what is sent over the library's client, and takes what it receives."""

    def __init__(self, protocol: Any) -> None:
        """Take the library's `UASocketProtocol` with an open channel; from now on it receives through this."""
        self._protocol = protocol
        self._connection = protocol._connection
        self._left_to_library = protocol.data_received
        protocol.data_received = self.received

    def framed(self, body: bytes, request: int) -> bytes:
        connection = self._connection
        crypto, token = connection.security_policy.symmetric_cryptography, connection.security_token
        number = connection._sequence_number + 1
        plain = SEQUENCE.pack(number & LAST_NUMBER, request) + body
        plain += crypto.padding(len(plain))
        signed = len(plain) + crypto.signature_size()
        size = HEADER.size + signed // crypto.plain_block_size() * crypto.encrypted_block_size()
        if size > connection._limits.max_send_buffer or number > LAST_NUMBER:
            whole: bytes = connection.message_to_binary(body, request_id=request)
            return whole
        connection._sequence_number = number
        header = HEADER.pack(WHOLE_MESSAGE, size, token.ChannelId, token.TokenId)
        encrypted: bytes = crypto.encrypt(plain + crypto.signature(header + plain))
        return header + encrypted

    def received(self, data: bytes) -> None:
        if self._protocol.receive_buffer or not self._taken(data):
            self._left_to_library(data)

    def _taken(self, data: bytes) -> bool:
        """Hand the usual message to whom it answers; False, with nothing changed, when it is not a usual one."""
        connection = self._connection
        token, limits = connection.security_token, connection._limits
        if len(data) <= HEADER.size or connection._incoming_parts or len(data) > limits.max_recv_buffer:
            return False
        if HEADER.unpack_from(data) != (WHOLE_MESSAGE, len(data), token.ChannelId, token.TokenId):
            return False
        crypto = connection.security_policy.symmetric_cryptography
        try:
            plain = _opened(crypto, data)
        except (LIBRARY.InvalidSignature, ValueError):
            return False
        if len(plain) < SEQUENCE.size or 0 < limits.max_message_size < len(plain):
            return False
        number, request = SEQUENCE.unpack_from(plain)
        answered = self._protocol._callbackmap.get(request)
        if connection._peer_sequence_number != number - 1 or answered is None or answered.done():
            return False
        connection._peer_sequence_number = number
        del self._protocol._callbackmap[request]
        answered.set_result(Received(plain[SEQUENCE.size :]))
        return True


def _opened(crypto: Any, data: bytes) -> bytes:
    """Return what a message holds, decrypted; raises InvalidSignature, or ValueError for a size no cipher has."""
    crypto.use_prev_key = False
    plain: bytes = crypto.decrypt(data[HEADER.size :])
    if size := crypto.vsignature_size():
        plain, signature = plain[:-size], plain[-size:]
        crypto.verify(data[: HEADER.size] + plain, signature)
    whole: bytes = crypto.remove_padding(plain)
    return whole


class Answer(NamedTuple):
    """What a server says of one value."""

    status: int
    value: Any
    """None where there is none."""


def _type_id(identifier: int) -> bytes:
    """Return the four-byte node id with which a message begins."""
    return struct.pack("<BBH", 1, 0, identifier)


READ_REQUEST = _type_id(ObjectIds.ReadRequest_Encoding_DefaultBinary)
READ_RESPONSE = _type_id(ObjectIds.ReadResponse_Encoding_DefaultBinary)
WRITE_REQUEST = _type_id(ObjectIds.WriteRequest_Encoding_DefaultBinary)
WRITE_RESPONSE = _type_id(ObjectIds.WriteResponse_Encoding_DefaultBinary)
SERVICE_FAULT = _type_id(ObjectIds.ServiceFault_Encoding_DefaultBinary)

REQUEST_HEADER = struct.Struct("<qIIiI3s")
"""After the session's token: time, handle, diagnostics asked for, no audit entry, time-out, no additional header."""
NO_ADDITION = bytes(3)
RESPONSE_HEADER = struct.Struct("<4sqIIBi3si")
"""Type, time, handle, result, no diagnostics, no texts, no additional header; then the number of results."""
WITH_VALUE, WITH_STATUS = 1, 2
NULL, FLOAT, DOUBLE, STRING = 0, 10, 11, 12
"""Built-in types of a value, in which most servers take no other than the variable's own."""
LENGTH = struct.Struct("<i")
STATUS = struct.Struct("<I")
NUMBERS = {kind: struct.Struct("<" + code) for kind, code in enumerate("?bBhHiIqQfd", start=1)}
"""Built-in type on the wire -> its bytes (OPC 10000-6, 5.1.2)."""
UNREADABLE = (
    *(ValueError, LookupError, ArithmeticError, RecursionError),
    *(TypeError, AttributeError, AssertionError, struct.error),
)
"""What the library raises, beside its own errors, when it decodes an answer that makes no sense."""
NOTHING = ua.DataValue(None, StatusCode=None)
EPOCH_100NS = 116_444_736_000_000_000
"""1970-01-01 in the time of OPC UA, which counts steps of 100 ns from 1601."""


def encode_read(nodes: Sequence[ua.NodeId], attribute: AttributeIds = AttributeIds.Value) -> bytes:
    """Return the parameters of a request that reads an attribute of these nodes, without time stamps."""
    wanted = [ua.ReadValueId(NodeId=node, AttributeId=attribute) for node in nodes]
    parameters = ua.ReadParameters(TimestampsToReturn=ua.TimestampsToReturn.Neither, NodesToRead=wanted)
    encoded: bytes = struct_to_binary(parameters)
    return encoded


def encode_target(node: ua.NodeId) -> bytes:
    """Return the part of a written value that names its node."""
    item: bytes = struct_to_binary(ua.WriteValue(NodeId=node, AttributeId=AttributeIds.Value, Value=NOTHING))
    return item[: -len(struct_to_binary(NOTHING))]


def encode_write(values: Sequence[tuple[bytes, bytes]]) -> bytes:
    """Return the parameters of a request that writes numbers. Only values travel: many CNCs refuse status and time."""
    items = [target + bytes((WITH_VALUE,)) + value for target, value in values]
    return struct.pack("<i", len(items)) + b"".join(items)


def encode_number(value: float, kind: int = DOUBLE) -> tuple[bytes, float]:
    """Return a number as a value of a built-in type, and what that holds of it: NaN where it cannot."""
    number, content = NUMBERS.get(kind), b""
    with contextlib.suppress(struct.error, OverflowError):
        content = number.pack(value if kind in (FLOAT, DOUBLE) else round(value)) if number else b""
    return bytes((kind,)) + content, float(number.unpack(content)[0]) if number and content else math.nan


def decode_read(body: bytes) -> list[Answer]:
    """Return what the server answers to a read; raises UaStatusCodeError when it refuses the whole request."""
    try:
        answers = _plain_values(body)
    except (struct.error, IndexError):  # it breaks off
        answers = None
    if answers is None:
        answers = [_answer(each) for each in _decoded(ua.ReadResponse, body, READ_RESPONSE).Results or ()]
    return answers


def decode_write(body: bytes) -> list[int]:
    """Return the status of each written value; raises UaStatusCodeError when the server refuses the whole request."""
    plain = _plain(body, WRITE_RESPONSE)
    if plain is None or len(body) < plain[1] + 4 * plain[0]:
        return [status.value for status in _decoded(ua.WriteResponse, body, WRITE_RESPONSE).Results or ()]
    count, at = plain
    return list(struct.unpack_from(f"<{count}I", body, at))


def _plain_values(body: bytes) -> list[Answer] | None:
    """Return the values of a good answer that holds numbers, texts and statuses alone; None where it holds more."""
    plain = _plain(body, READ_RESPONSE)
    if plain is None:
        return None
    count, at = plain
    answers = []
    for _ in range(count):
        mask, value, status = body[at], None, 0
        at += 1
        if mask & ~(WITH_VALUE | WITH_STATUS):
            return None
        if mask & WITH_VALUE:
            kind = body[at]
            at += 1
            if kind != NULL:
                if kind == STRING:
                    (length,) = LENGTH.unpack_from(body, at)
                    at += LENGTH.size + max(length, 0)
                    if length < -1 or at > len(body):
                        return None
                    value = str(body[at - length : at], "utf-8", "replace") if length >= 0 else None
                elif (number := NUMBERS.get(kind)) is not None:
                    (value,) = number.unpack_from(body, at)
                    at += number.size
                else:
                    return None
        if mask & WITH_STATUS:
            (status,) = STATUS.unpack_from(body, at)
            at += STATUS.size
        answers.append(Answer(status, value))
    return answers


def _plain(body: bytes, type_id: bytes) -> tuple[int, int] | None:
    """Return number and place of the results of a good answer without diagnostics; None where it is not that plain."""
    if len(body) < RESPONSE_HEADER.size:
        return None
    found, _, _, result, diagnostics, texts, addition, count = RESPONSE_HEADER.unpack_from(body)
    plain = found == type_id and result == 0 and diagnostics == 0 and texts <= 0 and addition == NO_ADDITION
    return (count, RESPONSE_HEADER.size) if plain and count >= 0 else None


def _decoded(kind: Any, body: bytes, type_id: bytes) -> Any:
    """Return the answer as the library reads it; raises UaError when it is another, UaStatusCodeError a refusal."""
    if body[:4] == SERVICE_FAULT:
        status = RESPONSE_HEADER.unpack_from(body.ljust(RESPONSE_HEADER.size, b"\0"))[3]
        ua.StatusCode(ua.UInt32(status)).check()
    if body[:4] != type_id:
        raise UaError(f"the server answers with a message of type {body[:4].hex()} to a {kind.__name__[:-8]}")
    try:
        response = struct_from_binary(kind, Received(body))
    except UNREADABLE as error:
        raise UaError(f"the answer cannot be read ({type(error).__name__}: {error})") from error
    response.ResponseHeader.ServiceResult.check()
    return response


def _answer(found: ua.DataValue) -> Answer:
    status = 0 if found.StatusCode is None else found.StatusCode.value
    return Answer(status, None if found.Value is None else found.Value.Value)


class Services:
    """Sends the two requests over the library's channel; one at a time, which its owner sees to."""

    def __init__(self, client: UaClient, timeout_s: float) -> None:
        """Take a client with an activated session."""
        protocol: Any = client.protocol
        self._protocol = protocol
        self._channel = Channel(protocol)
        self._token = nodeid_to_binary(protocol.authentication_token)
        self._timeout_ms = int(timeout_s * 1000)

    async def read(self, requests: Sequence[bytes]) -> list[Answer]:
        """Read what `encode_read` has put together, one request after the other."""
        return [answer for each in requests for answer in decode_read(await self._sent(READ_REQUEST, each))]

    async def write(self, parameters: bytes) -> list[int]:
        """Write what `encode_write` has put together."""
        return decode_write(await self._sent(WRITE_REQUEST, parameters))

    async def _sent(self, type_id: bytes, parameters: bytes) -> bytes:
        """Send a request as the library's `UASocketProtocol.send_request` does; return the answer's body."""
        protocol = self._protocol
        if protocol.transport is None:
            raise ConnectionError("the connection is closed")
        number = protocol._request_id + 1
        header = REQUEST_HEADER.pack(EPOCH_100NS + time.time_ns() // 100, number, 0, -1, self._timeout_ms, NO_ADDITION)
        protocol.revolve_security_token()
        message = self._channel.framed(b"".join((type_id, self._token, header, parameters)), number)
        protocol._request_id = number
        answered = protocol._callbackmap[number] = asyncio.get_running_loop().create_future()
        protocol.transport.write(message)
        body: Received = await answered
        return body.read(len(body))
