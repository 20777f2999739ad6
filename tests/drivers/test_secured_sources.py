"""MQTT over TLS and OPC UA tags with security, on real wires: what is let in, and what is said when it is not."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import aclosing
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
import pytest_asyncio
from asyncua import Server, ua
from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
from asyncua.crypto.uacrypto import pem_from_key
from asyncua.server.user_managers import UserManager
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from mosquitto import mosquitto
from scripted_machine import PASSWORD, SERVER_URI, USER, Keys

from config.schema.source_drivers import SourceConfig
from daemon.simulation.processes import free_port
from daemon.sinks.vouching import tls_context
from drivers.clock import SystemClock
from drivers.contract import DriverError, FatalDriverError, LinkError
from drivers.mqtt import MqttSource
from drivers.opcua.certificates import load_certificate, load_private_key
from drivers.opcua.tags import OpcUaTagSource
from drivers.readings import Row, RowSource

pytestmark = pytest.mark.wires

PATIENCE_S = 30.0
SENSOR = {"id": 7, "component": "Column"}


async def first(source: RowSource) -> Row:
    async with asyncio.timeout(PATIENCE_S), aclosing(source.rows()) as rows:
        return await anext(rows)


# --- MQTT over TLS ----------------------------------------------------------------------


def certificates(folder: Path) -> None:
    """Make an authority below another one and, by it, the broker's certificate for 127.0.0.1."""
    names_of = ("root", "ca", "broker")
    now, keys = datetime.now(UTC), {name: ec.generate_private_key(ec.SECP256R1()) for name in names_of}
    names = {name: x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, f"test {name}")]) for name in keys}
    for by, name in (("root", "root"), ("root", "ca"), ("ca", "broker")):
        key = keys[name]
        made = (
            x509.CertificateBuilder()
            .subject_name(names[name])
            .issuer_name(names[by])
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - timedelta(days=1))
            .not_valid_after(now + timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=name != "broker", path_length=None), critical=True)
        )
        if name == "broker":
            address = x509.IPAddress(ip_address("127.0.0.1"))
            made = made.add_extension(x509.SubjectAlternativeName([address]), critical=False)
        signed = made.sign(keys[by], hashes.SHA256())
        (folder / f"{name}.pem").write_bytes(signed.public_bytes(serialization.Encoding.PEM))
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        (folder / f"{name}.key").write_bytes(private)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[int]:
    certificates(tmp_path)
    tls = [f"certfile {tmp_path / 'broker.pem'}", f"keyfile {tmp_path / 'broker.key'}"]
    with mosquitto(tmp_path, "allow_anonymous true", *tls) as port:
        yield port


def subscribed(port: int, **section: Any) -> MqttSource:
    mqtt = {"host": "127.0.0.1", "port": port, "sensors": [{**SENSOR, "topic": "m/7"}], **section}
    content = {"name": "s", "driver": "mqtt", "cycle_period_s": 0.05, "mqtt": mqtt}
    return MqttSource(SourceConfig.model_validate(content), SystemClock())


async def test_messages_come_over_tls_and_only_from_a_broker_that_is_vouched_for(broker: int, tmp_path: Path) -> None:
    authority = tmp_path / "ca.pem"
    source = subscribed(broker, tls=True, ca_certificate=authority)
    waiting = asyncio.ensure_future(first(source))
    async with aiomqtt.Client("127.0.0.1", broker, tls_context=tls_context(authority)) as device:
        async with asyncio.timeout(PATIENCE_S):
            while not waiting.done():
                await device.publish("m/7", "21.5")
                await asyncio.sleep(0.02)
    assert list((await waiting).values) == [21.5]
    with pytest.raises(LinkError, match=r"broker 127\.0\.0\.1:\d+: shows no certificate that `ca_certificate`"):
        await first(subscribed(broker, tls=True))
    with pytest.raises(LinkError, match=r"source s: broker 127\.0\.0\.1:\d+: .*check address, `port`, `tls`"):
        await first(subscribed(broker, timeout_s=1.0))
    no_certificate = tmp_path / "m.conf"
    with pytest.raises(FatalDriverError, match=r"ca_certificate .* cannot be used"):
        await first(subscribed(broker, tls=True, ca_certificate=no_certificate))


async def test_a_broker_without_tls_is_told_by_the_key_to_correct() -> None:
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(4096)
        writer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    with pytest.raises(LinkError, match=r"\[SSL: WRONG_VERSION_NUMBER\].*: check address, `port`, `tls`"):
        await first(subscribed(server.sockets[0].getsockname()[1], tls=True))
    server.close()


# --- OPC UA with security ---------------------------------------------------------------


class OneUser(UserManager):
    def get_user(self, iserver: Any, username: Any = None, password: Any = None, certificate: Any = None) -> Any:
        return User(role=UserRole.User) if (username, password) == (USER, PASSWORD) else None


@pytest_asyncio.fixture
async def gateway(tmp_path: Path) -> AsyncIterator[tuple[str, Keys]]:
    keys = Keys(tmp_path)
    server = Server(user_manager=OneUser())
    await server.init()
    await server.set_application_uri(SERVER_URI)
    endpoint = f"opc.tcp://127.0.0.1:{free_port()}/gateway"
    server.set_endpoint(endpoint)
    server.set_security_policy(
        [ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt], permission_ruleset=SimpleRoleRuleset()
    )
    server.set_identity_tokens([ua.UserNameIdentityToken])
    await server.load_certificate(load_certificate(keys.server).public_bytes(serialization.Encoding.DER))
    await server.load_private_key(pem_from_key(load_private_key(keys.server_key)), format="pem")
    index = await server.register_namespace("urn:gateway")
    await server.nodes.objects.add_variable(ua.NodeId("T", index), "T", 21.5)
    await server.start()
    yield endpoint, keys
    await server.stop()


def tags(endpoint: str, security: Any, node: str = "s=T") -> OpcUaTagSource:
    opcua = {
        "endpoint": endpoint,
        "namespace_uri": "urn:gateway",
        "security": security,
        "sensors": [{**SENSOR, "node": node}],
        "timeout_s": 20.0,
    }
    content = {"name": "s", "driver": "opcua", "cycle_period_s": 0.05, "opcua": opcua}
    return OpcUaTagSource(SourceConfig.model_validate(content), SystemClock())


async def test_tags_are_read_encrypted_with_a_user_and_not_otherwise(gateway: tuple[str, Keys], tmp_path: Path) -> None:
    endpoint, keys = gateway
    secured = tags(endpoint, keys.client_config())
    assert secured._config.exposed == ""
    assert list((await first(secured)).values) == [21.5]
    for node in ("ns=1;s=T", "nsu=urn:gateway;s=T", "T"):  # numbers of namespaces change with a restart of the server
        with pytest.raises(FatalDriverError, match=f"{node!r} is no node id such as .* without ns="):
            await first(tags(endpoint, keys.client_config(), node))
    wrong = tmp_path / "wrong"
    wrong.write_text("not the password\n")
    wrong.chmod(0o600)
    for refused in (tags(endpoint, keys.client_config(password_file=wrong)), tags(endpoint, None)):
        with pytest.raises(DriverError, match=r"source s: opc\.tcp"):
            await first(refused)
