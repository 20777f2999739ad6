"""Messages of one whole chunk: framed as the library frames them, and what is not usual left to it."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from asyncua import ua
from asyncua.client.ua_client import UASocketProtocol
from asyncua.common.connection import SecureConnection, TransportLimits
from asyncua.crypto.security_policies import (
    Cryptography,
    CryptographyNone,
    DecryptorAesCbc,
    EncryptorAesCbc,
    SignerHMac256,
    VerifierHMac256,
)

from drivers.opcua.services import Channel

BODY = b"what is asked or answered" * 3
REQUEST = 7


def crypto(*, encrypted: bool) -> CryptographyNone:
    if not encrypted:
        return CryptographyNone()
    made = Cryptography(ua.MessageSecurityMode.SignAndEncrypt)
    made.Signer, made.Verifier = SignerHMac256(b"s" * 32), VerifierHMac256(b"s" * 32)
    made.Encryptor, made.Decryptor = EncryptorAesCbc(b"k" * 32, b"i" * 16), DecryptorAesCbc(b"k" * 32, b"i" * 16)
    return made


def connection(*, encrypted: bool, first: int = 0) -> SecureConnection:
    policy: Any = SimpleNamespace(symmetric_cryptography=crypto(encrypted=encrypted))
    made = SecureConnection(policy, TransportLimits(8192, 8192, 0, 0))
    made.security_token = ua.ChannelSecurityToken(ChannelId=3, TokenId=13)
    made._sequence_number = first
    return made


class Bench:
    """A client whose library is the real one, and the server's end of its channel."""

    def __init__(self, *, encrypted: bool, first: int = 0) -> None:
        self.protocol = UASocketProtocol()
        self.protocol._connection = connection(encrypted=encrypted, first=first)
        self.server = connection(encrypted=encrypted, first=40)
        self.answered = self.waiting(REQUEST)
        self.left: list[bytes] = []
        librarys = self.protocol.data_received

        def left(data: bytes) -> None:
            self.left.append(data)
            librarys(data)

        self.protocol.data_received = left  # type: ignore[method-assign]
        self.channel = Channel(self.protocol)
        self.protocol._connection._peer_sequence_number = 40

    def waiting(self, request: int) -> asyncio.Future[Any]:
        future = self.protocol._callbackmap[request] = asyncio.get_running_loop().create_future()
        return future

    def answer(self, body: bytes = BODY, request: int = REQUEST) -> bytes:
        return self.server.message_to_binary(body, request_id=request)


@pytest.fixture(params=[False, True], ids=["plain", "encrypted"])
async def bench(request: pytest.FixtureRequest) -> Bench:
    return Bench(encrypted=request.param)


@pytest.mark.parametrize("encrypted", [False, True])
@pytest.mark.parametrize("first", [0, 99, (1 << 32) - 2, (1 << 32) - 1])
@pytest.mark.parametrize("size", [1, 15, 16, 31, 32, 500, 8100, 30_000])
async def test_a_message_is_what_the_library_would_send(encrypted: bool, first: int, size: int) -> None:
    bench, twin = Bench(encrypted=encrypted, first=first), connection(encrypted=encrypted, first=first)
    body = (bytes(range(256)) * (size // 256 + 1))[:size]
    assert bench.channel.framed(body, 5) == twin.message_to_binary(body, request_id=5)
    assert bench.protocol._connection._sequence_number == twin._sequence_number


async def test_an_answer_reaches_who_waits_for_it_without_the_library(bench: Bench) -> None:
    bench.protocol.data_received(bench.answer())
    assert bytes(bench.answered.result()) == BODY and bench.left == []
    assert bench.protocol._connection._peer_sequence_number == 41 and not bench.protocol._callbackmap


async def test_pieces_and_two_at_once_are_put_together_by_the_library(bench: Bench) -> None:
    second = bench.waiting(8)
    whole = bench.answer() + bench.answer(b"another", 8)
    for at in range(0, len(whole), 50):
        bench.protocol.data_received(whole[at : at + 50])
    assert bytes(bench.answered.result()) == BODY and bytes(second.result()) == b"another" and bench.left
    third = bench.waiting(9)
    bench.left.clear()
    bench.protocol.data_received(bench.answer(b"third", 9))
    assert bytes(third.result()) == b"third" and bench.left == [], "the number in sequence was kept up to date"


@pytest.mark.parametrize("at", range(0, 60, 3))
async def test_a_changed_byte_is_judged_by_the_library(bench: Bench, at: int) -> None:
    message = bytearray(bench.answer())
    message[at] ^= 0x41
    bench.protocol.data_received(bytes(message))
    unsigned = not isinstance(bench.server.security_policy.symmetric_cryptography, Cryptography)
    if unsigned and at >= 24:  # the body of a plain channel is taken as it is, by the library too
        assert bench.left == [] and bytes(bench.answered.result()) != BODY
    else:
        assert bench.left == [bytes(message)]
        assert not bench.answered.done() or bench.answered.exception() is not None


async def test_an_answer_out_of_turn_or_for_nobody_is_judged_by_the_library(bench: Bench) -> None:
    skipped, answer = bench.answer(), bench.answer()
    bench.protocol.data_received(answer)
    assert skipped != answer and bench.left == [answer] and not bench.answered.done()
    nobody = bench.server.message_to_binary(BODY, request_id=99)
    bench.protocol.data_received(nobody)
    assert bench.left == [answer, nobody]
