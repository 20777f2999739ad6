"""The OPC UA face of a simulated CNC, a FANUC's or a SINUMERIK's.

Every read is answered from the NC's present state, and every accepted write reaches the NC's macro
variables at once and in the order of the request; nothing is copied in between. A vacant macro
variable is answered with status BadNoData and no value. A SINUMERIK has no vacant R parameters, so the number that
stands for one is answered, and R parameters cannot be browsed.
"""

import asyncio
import gc
import hmac
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.uacrypto import pem_from_key
from asyncua.server.address_space import AddressSpace, AttributeService
from asyncua.server.internal_server import InternalServer
from asyncua.server.server import Server
from asyncua.server.user_managers import UserManager
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.status_codes import StatusCodes
from cryptography import x509
from cryptography.hazmat.primitives import serialization

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import OpcUaConfig
from config.schema.guard import SHOWN, VACANT_R
from drivers.opcua.certificates import load_certificate, load_private_key
from drivers.opcua.cnc import node_map
from drivers.opcua.log import limit_library_log
from drivers.sim.contract import SimulatedNc

APPLICATION_URI = "urn:toolpoint:simulated-cnc"
PUBLISH_PERIOD_S = 0.1
"""How often subscribed values are looked at [s of the wall clock]."""

Shown = Callable[[SimulatedNc], float | int | str]


def _of(attribute: str) -> Shown:
    return lambda nc: getattr(nc, attribute)


INT, DOUBLE, TEXT = ua.VariantType.Int32, ua.VariantType.Double, ua.VariantType.String
STATE: dict[str, tuple[ua.VariantType, Shown]] = {
    "mode": (INT, _of("mode")),
    "run": (INT, _of("run")),
    "alarm": (INT, _of("alarm")),
    "program": (INT, _of("program")),
    "sequence_number": (INT, _of("sequence_number")),
    "spindle_speed": (DOUBLE, _of("spindle_speed_rpm")),
    "motor_temperature": (DOUBLE, _of("motor_temperature_degc")),
    "clock": (DOUBLE, _of("clock_s")),
    "power_on_count": (INT, _of("power_on_count")),
    "work_offset": (INT, _of("work_offset")),
    "tool_number": (INT, _of("tool_number")),
}
"""Type on the wire and value of the NC's state, by key of the nodes."""
SINUMERIK_MODES = {0: 1, 1: 2, 5: 0}
"""opMode (JOG 0, MDA 1, AUTO 2) of the NC's mode; AUTO for every other one."""
SINUMERIK_RUNS = {0: 5, 1: 2, 2: 1, 3: 3, 4: 3}
"""progStatus (interrupted 1, stopped 2, running 3, aborted 5) of the NC's run state."""
SINUMERIK_STATE: dict[str, tuple[ua.VariantType, Shown]] = {
    "mode": (ua.VariantType.UInt16, lambda nc: SINUMERIK_MODES.get(nc.mode, 2)),
    "run": (ua.VariantType.UInt16, lambda nc: SINUMERIK_RUNS.get(nc.run, 0)),
    "alarm": (ua.VariantType.UInt16, lambda nc: 2 if nc.alarm else 0),
    "program": (TEXT, lambda nc: f"/_N_MPF_DIR/_N_O{nc.program}_MPF"),
    "sequence_number": (TEXT, lambda nc: f"N{nc.sequence_number}"),
    "spindle_speed": (DOUBLE, _of("spindle_speed_rpm")),
    "motor_temperature": (DOUBLE, _of("motor_temperature_degc")),
    "work_offset": (TEXT, lambda nc: f"G{nc.work_offset}"),
    "tool_number": (ua.VariantType.UInt16, _of("tool_number")),
}
"""The same of a SINUMERIK; clock and count of power-ons are R parameters there."""
EMPTY: dict[ua.VariantType, float | int | str] = {DOUBLE: 0.0, TEXT: ""}


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerSecurity:
    """Basic256Sha256 (sign and encrypt) with one user; without it the server is open and anonymous."""

    user_name: str
    password: str
    certificate: Path
    private_key: Path
    trusted_clients: tuple[Path, ...] = ()
    """Certificates of the clients that may connect; none: any."""


class SimulatedCncServer:
    """An OPC UA server on 127.0.0.1 for one simulated NC."""

    def __init__(
        self,
        nc: SimulatedNc,
        config: CncConfig,
        *,
        port: int | None = None,
        security: ServerSecurity | None = None,
        readable: Iterable[int] = (),
    ) -> None:
        """Prepare the server on a port (None: the configured one), with these macro variables beside the map's."""
        limit_library_log()
        self._nc = nc
        self._config = config
        self._opcua = config.connection_as(OpcUaConfig)
        url = urlparse(self._opcua.endpoint)
        self._path = url.path
        self._port = (url.port or 4840) if port is None else port
        self._security = security
        shown = range(config.guard.shown, config.guard.shown + SHOWN) if config.is_sinumerik else ()
        self._readable = frozenset([*readable, *shown])
        self._vacant = VACANT_R if config.is_sinumerik else None
        self._server: Server | None = None
        self._publisher: asyncio.Task[None] | None = None

    @property
    def port(self) -> int:
        """The port that is listened on (known after start)."""
        return self._port

    @property
    def endpoint(self) -> str:
        """The URL for clients (known after start)."""
        return f"opc.tcp://127.0.0.1:{self._port}{self._path}"

    async def start(self) -> None:
        """Load the standard address space (most of a second), add the NC's variables, listen."""
        server = Server(iserver=InternalServer(user_manager=_OneUser(self._security)))
        server.set_server_name("Toolpoint simulated CNC")
        server.disable_clock()
        await _load_standard_nodes(server)
        await server.set_application_uri(APPLICATION_URI)
        server.iserver.aspace.set_attribute_value_callback(
            ua.NodeId(ua.Int32(ObjectIds.Server_ServerStatus_CurrentTime)), AttributeIds.Value, _current_time
        )
        added = await self._add_variables(server)
        await self._secure(server)
        server.set_endpoint(self.endpoint)
        await server.start()
        assert server.bserver is not None
        self._port = int(server.bserver.port)
        self._server = server
        self._publisher = asyncio.create_task(_publish(server.iserver.aspace, added), name="simulated CNC publisher")

    async def stop(self) -> None:
        """Close all connections and stop listening. May be called more than once."""
        publisher, self._publisher = self._publisher, None
        server, self._server = self._server, None
        if publisher is not None:
            publisher.cancel()
            await asyncio.wait([publisher])
        if server is not None:
            await server.stop()

    async def _secure(self, server: Server) -> None:
        if self._security is None:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
            server.set_identity_tokens([ua.AnonymousIdentityToken])
            return
        certificate = load_certificate(self._security.certificate)
        await server.load_certificate(certificate.public_bytes(serialization.Encoding.DER))
        await server.load_private_key(pem_from_key(load_private_key(self._security.private_key)), format="pem")
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        server.set_identity_tokens([ua.UserNameIdentityToken])
        if self._security.trusted_clients:
            server.set_certificate_validator(_Trust(self._security.trusted_clients))

    async def _add_variables(self, server: Server) -> list[ua.NodeId]:
        """Add the NC's variables at the configured node ids and return them."""
        namespace = await server.register_namespace(self._opcua.namespace)
        folder = await server.nodes.objects.add_object(
            ua.NodeId.from_string(f"ns={namespace};s=CNC"), f"{namespace}:CNC"
        )
        nodes, macros, nc = node_map(self._config).nodes, self._config.macros, self._nc
        added: list[ua.NodeId] = []

        async def add(text: str, name: str, kind: ua.VariantType, read: Callable[[], ua.DataValue]) -> ua.NodeId:
            node_id = ua.NodeId.from_string(f"ns={namespace};{text}")
            await folder.add_variable(node_id, f"{namespace}:{name}", ua.Variant(EMPTY.get(kind, 0), kind))
            server.set_attribute_value_callback(node_id, lambda *_: read())
            added.append(node_id)
            return node_id

        for key, (kind, shown) in (SINUMERIK_STATE if self._config.is_sinumerik else STATE).items():
            if key in nodes:
                await add(nodes[key], key, kind, _state_reader(nc, shown, kind))
        if pattern := nodes.get("axis_position"):
            for place, axis in enumerate(nc.positions_mm, start=1):
                text = pattern.replace("{axis}", axis).replace("{number}", str(place))
                await add(text, f"AxisPosition{axis}", DOUBLE, _position_reader(nc, axis))
        echo = {*macros.echo_applied.values(), macros.echo_time, macros.echo_status, macros.echo_guard_version}
        writable: dict[ua.NodeId, int] = {}
        for number in sorted(macros.allowed.union(macros.block, self._readable)):
            text = nodes["macro"].replace("{number}", str(number))
            node_id = await add(text, f"Macro{number}", DOUBLE, _macro_reader(nc, number, self._vacant))
            if self._config.is_sinumerik:
                await folder.delete_reference(node_id, ObjectIds.HasComponent)
            if number in macros.allowed and number not in echo:
                await server.get_node(node_id).set_writable()
                writable[node_id] = number
        server.iserver.attribute_service = _MacroWrites(server.iserver.aspace, nc, writable, self._vacant)
        return added


class _MacroWrites(AttributeService):
    """Brings accepted writes to the NC, in the order of the request, and answers each with its own status."""

    def __init__(
        self, space: AddressSpace, nc: SimulatedNc, writable: dict[ua.NodeId, int], vacant: float | None
    ) -> None:
        super().__init__(space)
        self._vacant = vacant
        self._nc = nc
        self._writable = writable

    async def write(self, params: ua.WriteParameters, user: User = User(role=UserRole.Admin)) -> list[ua.StatusCode]:  # noqa: B008
        statuses: list[ua.StatusCode] = []
        for item in params.NodesToWrite:
            number = self._writable.get(item.NodeId)
            if number is None or item.AttributeId != AttributeIds.Value:
                statuses += await super().write(ua.WriteParameters(NodesToWrite=[item]), user)
            else:
                statuses.append(ua.StatusCode(ua.UInt32(self._set(number, item.Value))))
        return statuses

    def _set(self, number: int, sent: ua.DataValue) -> int:
        if sent.Value is None or sent.Value.VariantType != ua.VariantType.Double or sent.Value.is_array:
            return StatusCodes.BadTypeMismatch
        if not math.isfinite(sent.Value.Value):
            return StatusCodes.BadOutOfRange
        try:
            value = sent.Value.Value
            self._nc.macros.set(number, None if value == self._vacant else value)
        except KeyError:
            return StatusCodes.BadNotWritable
        return StatusCodes.Good


class _OneUser(UserManager):
    """Admits the configured user over an encrypted channel, or anybody on an open server; never as administrator."""

    def __init__(self, security: ServerSecurity | None) -> None:
        self._security = security

    def get_user(
        self, iserver: InternalServer, username: str | None = None, password: str | None = None, certificate: Any = None
    ) -> User | None:
        if self._security is None:
            return User(role=UserRole.User)
        known = hmac.compare_digest((username or "").encode(), self._security.user_name.encode())
        right = hmac.compare_digest((password or "").encode(), self._security.password.encode())
        return User(role=UserRole.User, name=username) if known and right and certificate else None


class _Trust:
    """Refuses clients whose certificate is not one of the given files."""

    def __init__(self, certificates: Iterable[Path]) -> None:
        self._trusted = [load_certificate(path) for path in certificates]

    async def __call__(self, certificate: x509.Certificate, application: ua.ApplicationDescription) -> None:
        if certificate not in self._trusted:
            raise ServiceError(StatusCodes.BadCertificateUntrusted)


def _state_reader(nc: SimulatedNc, shown: Shown, kind: ua.VariantType) -> Callable[[], ua.DataValue]:
    convert = {DOUBLE: float, TEXT: str}.get(kind, int)
    return lambda: ua.DataValue(ua.Variant(convert(shown(nc)), kind))


def _position_reader(nc: SimulatedNc, axis: str) -> Callable[[], ua.DataValue]:
    return lambda: ua.DataValue(ua.Variant(float(nc.positions_mm[axis]), DOUBLE))


def _macro_reader(nc: SimulatedNc, number: int, vacant: float | None) -> Callable[[], ua.DataValue]:
    def read() -> ua.DataValue:
        value = nc.macros.get(number)
        if value is None and vacant is None:
            return ua.DataValue(StatusCode=ua.StatusCode(ua.UInt32(StatusCodes.BadNoData)))
        return ua.DataValue(ua.Variant(vacant if value is None else float(value), ua.VariantType.Double))

    return read


def _current_time(node_id: ua.NodeId, attribute: AttributeIds) -> ua.DataValue:
    return ua.DataValue(ua.Variant(datetime.now(UTC), ua.VariantType.DateTime))


async def _load_standard_nodes(server: Server) -> None:
    """Load the standard address space; garbage collection would add half to the time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        await server.init()
    finally:
        if collecting:
            gc.enable()


async def _publish(space: AddressSpace, nodes: Iterable[ua.NodeId]) -> None:
    """Tell subscribers about changed values; costs nothing without subscribers."""
    attributes = {node: space[node].attributes[AttributeIds.Value] for node in nodes}
    told: dict[ua.NodeId, ua.DataValue] = {}
    while True:
        await asyncio.sleep(PUBLISH_PERIOD_S)
        for node, attribute in attributes.items():
            if not attribute.datachange_callbacks:
                continue
            value = space.read_attribute_value(node, AttributeIds.Value)
            if told.get(node) != value:
                told[node] = value
                for handle, callback in list(attribute.datachange_callbacks.items()):
                    await callback(handle, value)
