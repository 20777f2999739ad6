"""Encryption, users and certificates: who is let in, and what is said when somebody is not."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from asyncua import Client, ua
from scripted_machine import GROUPS, PASSWORD, SERVER_URI, USER, Keys, ScriptedNc, cnc_config

from drivers.clock import SystemClock
from drivers.contract import FatalDriverError, LinkError
from drivers.opcua.cnc import OpcUaCnc
from drivers.sim.wires.opcua_server import SimulatedCncServer

pytestmark = [pytest.mark.wires, pytest.mark.asyncio(loop_scope="module")]

NC = ScriptedNc()


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return Keys(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return Keys(tmp_path_factory.mktemp("strangers"))


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def server(keys: Keys) -> AsyncIterator[SimulatedCncServer]:
    server = SimulatedCncServer(NC, cnc_config(), port=0, security=keys.server_security())
    await server.start()
    yield server
    await server.stop()


def driver(server: SimulatedCncServer, keys: Keys, **changes: Any) -> OpcUaCnc:
    NC.reset()
    return OpcUaCnc(cnc_config(server.endpoint, security=keys.client_config(**changes)), SystemClock())


async def test_reads_and_writes_encrypted_with_a_user(server: SimulatedCncServer, keys: Keys) -> None:
    cnc = driver(server, keys)
    assert cnc.security == "encrypted"
    await cnc.connect()
    assert cnc.identity == SERVER_URI
    await cnc.write_macros(GROUPS)
    assert NC.macros.written == [pair for group in GROUPS for pair in group]
    assert (await cnc.read([503])).macros == {503: 0.0105}
    before = asyncio.all_tasks()
    await cnc.close()
    assert asyncio.all_tasks() <= before


async def test_wrong_password_is_fatal(server: SimulatedCncServer, keys: Keys, tmp_path: Path) -> None:
    wrong = tmp_path / "password"
    wrong.write_text(PASSWORD.strip())
    wrong.chmod(0o400)
    with pytest.raises(FatalDriverError, match="refuses the user name or password"):
        await driver(server, keys, password_file=wrong).connect()


async def test_untrusted_client_certificate_is_fatal(server: SimulatedCncServer, keys: Keys, strangers: Keys) -> None:
    cnc = driver(server, keys, certificate=strangers.client, private_key=strangers.client_key)
    with pytest.raises(FatalDriverError, match="does not trust the daemon's certificate"):
        await cnc.connect()


async def test_a_renewed_certificate_without_its_key_is_named_and_not_the_cnc(
    server: SimulatedCncServer, keys: Keys, strangers: Keys
) -> None:
    cnc = driver(server, keys, private_key=strangers.client_key)
    with pytest.raises(FatalDriverError, match=r"client.key does not belong to the certificate .*client.der"):
        await cnc.connect()


async def test_another_server_certificate_is_fatal(server: SimulatedCncServer, keys: Keys, strangers: Keys) -> None:
    cnc = driver(server, keys, server_certificate=strangers.server)
    with pytest.raises(FatalDriverError, match=r"another certificate than the one that is trusted.* [0-9A-F]{64}"):
        await cnc.connect()


async def test_an_impostor_with_the_right_certificate_but_another_key_gets_no_password(
    keys: Keys, strangers: Keys
) -> None:
    """The certificate is public: only its key proves who the server is."""
    security = keys.server_security(private_key=strangers.server_key, trusted_clients=())
    impostor = SimulatedCncServer(NC, cnc_config(), port=0, security=security)
    await impostor.start()
    config = cnc_config(impostor.endpoint, security=keys.client_config(), timeout_s=1.0)
    with pytest.raises(LinkError, match=r"while connecting \(in the secure handshake"):
        await OpcUaCnc(config, SystemClock()).connect()
    await impostor.stop()


@pytest.mark.parametrize("which", ["password_file", "private_key"])
async def test_secrets_open_to_everybody_are_refused(
    server: SimulatedCncServer, keys: Keys, tmp_path: Path, which: str
) -> None:
    source = keys.password if which == "password_file" else keys.client_key
    copy = tmp_path / "secret"
    copy.write_bytes(source.read_bytes())
    copy.chmod(0o644)
    with pytest.raises(FatalDriverError, match=rf"\(mode 644\); run: chmod o-rwx {copy}"):
        await driver(server, keys, **{which: copy}).connect()
    copy.chmod(0o640)
    cnc = driver(server, keys, **{which: copy})
    await cnc.connect()
    await cnc.close()


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        ("password_file", None, r"cannot read the password file .*: No such file"),
        ("password_file", b"\n", r"password file .* is empty"),
        ("password_file", b"\xff\n", r"password file .* is not UTF-8 text \(byte 0\)"),
        ("certificate", b"nonsense", r"is not a certificate in PEM or DER form"),
        ("server_certificate", None, r"cannot read the certificate"),
        ("private_key", b"nonsense", r"is not an unencrypted private key"),
    ],
)
async def test_unusable_files_are_fatal_and_named(
    server: SimulatedCncServer, keys: Keys, tmp_path: Path, which: str, content: bytes | None, message: str
) -> None:
    path = tmp_path / "file"
    if content is not None:
        path.write_bytes(content)
        path.chmod(0o600)
    with pytest.raises(FatalDriverError, match=message) as raised:
        await driver(server, keys, **{which: path}).connect()
    assert str(path) in str(raised.value)


async def test_nobody_is_admitted_without_encryption(server: SimulatedCncServer) -> None:
    """Not even a client that ignores the list of endpoints and sends user and password in the clear."""
    client = Client(server.endpoint, timeout=10)
    await client.connect_socket()
    await client.send_hello()
    await client.open_secure_channel()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Client, "find_endpoint", staticmethod(lambda endpoints, *_: endpoints[0]))
        await client.create_session()
    with pytest.raises(ua.uaerrors.BadUserAccessDenied):
        await client.activate_session(username=USER, password=PASSWORD)
    client.disconnect_socket()
