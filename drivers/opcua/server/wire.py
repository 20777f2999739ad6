"""One connection of the server: hello, secure channel, whole messages in and out (OPC 10000-6, 6.7 and 7.1).

Keys, chunks and sequence numbers are the library's. Whom the channel is opened for is decided here, before any of the
private key's costly operations: only a certificate that is trusted gets so far.
"""

import asyncio
import contextlib
import math
import struct
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, NamedTuple

from asyncua import ua
from asyncua.common.connection import MessageChunk, SecureConnection, TransportLimits
from asyncua.common.utils import Buffer
from asyncua.crypto import security_policies
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.ua_binary import header_from_binary, struct_from_binary, struct_to_binary, uatcp_to_binary

from drivers.opcua.bounded import Received
from drivers.opcua.server.settings import Identity, Trusted

LONGEST_CHUNK = 65_535
LEAST_CHUNK = 8192
"""The standard asks for no less [byte]."""
LONGEST_MESSAGE = 393_216
"""What a client may ask to watch all of the published machine's tags with in one request, with room [byte]."""
PART_S = 10.0
"""What has begun to arrive must have arrived within this, and what is sent must be taken within this [s]."""
SHORTEST_LIFE_MS, LONGEST_LIFE_MS = 60_000, 3_600_000
"""Life of the keys of a channel; a quarter more is granted until they are renewed [ms]."""
HANDSHAKE_PAUSE_S = 0.05
"""After each use of the private key, whoever asked for it: the daemon has other work [s]."""
NONCE = 32
MOST_BLOCKS = 8
"""Blocks of the server's key in a request for a channel, each a use of the private key; clients need two to four."""
HEAD = struct.Struct("<3scI")
POLICIES: Any = security_policies
TYPES: Any = ua
"""The library's, whose own types say less than it does."""


class WireError(Exception):
    """The connection ends; the client is told the status."""

    def __init__(self, status: int, words: str) -> None:
        super().__init__(words)
        self.status = status


class Message(NamedTuple):
    """A request as it came."""

    request: int
    body: Buffer


class Handshakes:
    """One at a time over all connections, with a pause after each."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._channels = 0

    @contextlib.asynccontextmanager
    async def turn(self) -> Any:
        async with self._lock:
            yield
            await asyncio.sleep(HANDSHAKE_PAUSE_S)

    def get_new_channel_id(self) -> int:
        """Return the number of a new channel (the library asks for it by this name)."""
        self._channels = self._channels % 0x7FFF_FFFF + 1
        return self._channels


class Wire:
    """Frames and deciphers; raises WireError, or OSError and its kin when the connection breaks."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        identity: Identity,
        trusted: Trusted,
        handshakes: Handshakes,
    ) -> None:
        self._reader, self._writer = reader, writer
        self._trusted, self._handshakes = trusted, handshakes
        limits = TransportLimits(LONGEST_CHUNK, LONGEST_CHUNK, LONGEST_MESSAGE // LEAST_CHUNK, LONGEST_MESSAGE)
        self._secure = SecureConnection(POLICIES.SecurityPolicyNone(), limits)
        self._limits = limits
        self._block = identity.private_key.key_size // 8
        modes = ua.MessageSecurityMode.Sign, ua.MessageSecurityMode.SignAndEncrypt
        certificate, key = identity.certificate, identity.private_key
        factories = [
            POLICIES.SecurityPolicyFactory(POLICIES.SecurityPolicyBasic256Sha256, mode, certificate, key)
            for mode in modes
        ]
        self._secure.set_policy_factories(factories)
        self._greeted = False
        self.most_bytes = self._most_chunks = math.inf
        """Of an answer, as the client's hello, and later its session, has it."""
        self._keys_until_s = time.monotonic() + PART_S
        self.peer: Any = None
        """Certificate of the client, None on a channel without security."""

    @property
    def policy(self) -> Any:
        """The library's policy of this channel: its cryptography, and the peer's certificate as it was sent."""
        return self._secure.security_policy

    @property
    def secured(self) -> bool:
        """Messages are signed, by a trusted client."""
        return self._secure.is_open() and self.peer is not None

    @property
    def unsent(self) -> int:
        """Bytes that the client has not taken yet."""
        return self._writer.transport.get_write_buffer_size()

    @property
    def longest_answer(self) -> float:
        """The longest answer that the client takes [byte]."""
        in_chunk = MessageChunk.max_body_size(self.policy.symmetric_cryptography, self._limits.max_send_buffer)
        return min(self.most_bytes, self._most_chunks * in_chunk)

    async def receive(self, patience_s: float) -> Message | None:
        """Return the next request, None when the client has closed the channel."""
        while True:
            async with asyncio.timeout(patience_s):
                head = await self._reader.readexactly(HEAD.size)
            kind, part, size = HEAD.unpack(head)
            if not HEAD.size < size <= LONGEST_CHUNK:
                raise WireError(StatusCodes.BadTcpMessageTooLarge, f"a chunk of {size} bytes")
            async with asyncio.timeout(PART_S):
                data = head + await self._reader.readexactly(size - HEAD.size)
            if part != b"F" and not self.secured:
                raise WireError(StatusCodes.BadTcpMessageTooLarge, "more than one chunk, by whom nobody knows yet")
            if kind == b"HEL":
                self._greet(data)
            elif kind == b"OPN":
                await self._open(data)
            elif kind == b"CLO":
                return None
            elif (found := self._message(data)) is not None:
                return found

    def send(self, body: bytes, request: int, kind: Any = ua.MessageType.SecureMessage) -> None:
        """Send an answer; what the client does not take waits, and `drained` ends a client that takes nothing."""
        self._writer.write(self._secure.message_to_binary(body, message_type=kind, request_id=request))

    async def drained(self) -> None:
        """Wait until most of what was sent is taken; raises TimeoutError."""
        async with asyncio.timeout(PART_S):
            await self._writer.drain()

    def end(self, error: WireError) -> None:
        """Tell the client why the connection ends."""
        message = TYPES.ErrorMessage(ua.StatusCode(ua.UInt32(error.status)), str(error))
        self._writer.write(uatcp_to_binary(TYPES.MessageType.Error, message))

    def abort(self) -> None:
        """Close without waiting."""
        self._writer.transport.abort()

    def _greet(self, data: bytes) -> None:
        hello = _decoded(lambda: struct_from_binary(ua.Hello, Received(data[HEAD.size :])))
        if self._greeted or min(hello.ReceiveBufferSize, hello.SendBufferSize) < LEAST_CHUNK:
            raise WireError(StatusCodes.BadConnectionRejected, "this is no hello")
        self._greeted = True
        self.most_bytes, self._most_chunks = hello.MaxMessageSize or math.inf, hello.MaxChunkCount or math.inf
        hello.MaxMessageSize = hello.MaxChunkCount = ua.UInt32(0)  # the library would have them for requests too
        answer = self._limits.create_acknowledge_and_set_limits(hello)
        self._writer.write(uatcp_to_binary(TYPES.MessageType.Acknowledge, answer))

    def _message(self, data: bytes) -> Message | None:
        """Return the request that this chunk completes."""
        if not self._secure.is_open() or time.monotonic() > self._keys_until_s:
            raise WireError(StatusCodes.BadSecureChannelClosed, "there is no channel, or its keys have expired")
        message = _decoded(lambda: self._taken(data))
        return None if message is None else Message(message.SequenceHeader().RequestId, message.body())

    def _taken(self, data: bytes) -> Any:
        buffer = Buffer(data)
        header = header_from_binary(buffer)
        return self._secure.receive_from_header_and_body(header, buffer)

    async def _open(self, data: bytes) -> None:
        """Open the channel, or renew its keys."""
        if not self._greeted:
            raise WireError(StatusCodes.BadConnectionRejected, "a channel before the hello")
        rest = Received(data[HEAD.size + 4 :])
        header = _decoded(lambda: struct_from_binary(ua.AsymmetricAlgorithmHeader, rest))
        secured = header.SecurityPolicyURI != POLICIES.SecurityPolicyNone.URI
        if secured:
            self._check(header)
            if len(rest) > MOST_BLOCKS * self._block:
                raise WireError(StatusCodes.BadTcpMessageTooLarge, f"{len(rest)} enciphered bytes to open a channel")
        elif self._secure.is_open() and self.peer is not None:
            raise WireError(StatusCodes.BadSecurityChecksFailed, "a secured channel stays secured")
        async with self._handshakes.turn() if secured else contextlib.nullcontext():
            message = _decoded(lambda: self._taken(data))
            if message is None:
                raise WireError(StatusCodes.BadTcpMessageTypeInvalid, "a channel is opened by one chunk")
            request = _decoded(lambda: struct_from_binary(ua.OpenSecureChannelRequest, Received.of(message.body())))
            wanted = request.Parameters
            if secured and len(wanted.ClientNonce or b"") != NONCE:
                raise WireError(StatusCodes.BadNonceInvalid, f"the nonce must have {NONCE} bytes")
            if not self._secure.is_open():
                policy = header.SecurityPolicyURI, header.SenderCertificate, wanted.SecurityMode
                _decoded(lambda: self._secure.select_policy(*policy))
            elif wanted.SecurityMode != self.policy.Mode:
                raise WireError(StatusCodes.BadSecurityModeRejected, "the mode of a channel stays")
            life_ms = min(max(wanted.RequestedLifetime, SHORTEST_LIFE_MS), LONGEST_LIFE_MS)
            wanted.RequestedLifetime = ua.UInt32(life_ms)
            self._keys_until_s = time.monotonic() + life_ms * 1.25e-3
            answer = ua.OpenSecureChannelResponse()
            answer.Parameters = self._secure.open(wanted, self._handshakes)
            answer.ResponseHeader.RequestHandle = request.RequestHeader.RequestHandle
            self.send(struct_to_binary(answer), message.SequenceHeader().RequestId, ua.MessageType.SecureOpen)

    def _check(self, header: Any) -> None:
        """Raise WireError unless the channel is asked for with our policy by a trusted client."""
        if header.SecurityPolicyURI != POLICIES.SecurityPolicyBasic256Sha256.URI:
            raise WireError(StatusCodes.BadSecurityPolicyRejected, "only Basic256Sha256 is served")
        peer = self._trusted.find(header.SenderCertificate or b"")
        if peer is None:
            raise WireError(StatusCodes.BadSecurityChecksFailed, "the client's certificate is not trusted here")
        if not peer.not_valid_before_utc <= datetime.now(UTC) <= peer.not_valid_after_utc:
            raise WireError(
                StatusCodes.BadCertificateTimeInvalid, "the client's certificate has expired, or is not yet valid"
            )
        if self.peer is not None and peer != self.peer:
            raise WireError(StatusCodes.BadSecurityChecksFailed, "the client's certificate stays that of its channel")
        if self._secure.is_open() and self.peer is None:
            raise WireError(StatusCodes.BadSecurityChecksFailed, "a channel without security stays so")
        self.peer = peer


def _decoded(decode: Callable[[], Any]) -> Any:
    """Return what the library makes of a client's bytes; whatever it raises is the client's fault."""
    try:
        return decode()
    except Exception as error:
        raise WireError(StatusCodes.BadSecurityChecksFailed, "the message cannot be read") from error
