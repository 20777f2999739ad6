"""Messages of one whole chunk on the library's secure channel (OPC 10000-6, 6.7.2), with as little work as that needs.

The library's keys, tokens and sequence numbers are used and kept up to date. Whatever is not the usual message (parts
of one, several at once, another token, a number out of turn, a signature that does not fit, an answer nobody waits for)
is left to the library untouched, which judges it.
"""

import struct
from typing import Any

from asyncua.crypto import uacrypto

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
        """Return a message as it goes over the wire."""
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
