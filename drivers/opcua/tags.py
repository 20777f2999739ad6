"""Numbers that stand as tags in an OPC UA server, beside the CNC or in a gateway."""

import asyncio
import contextlib
from collections.abc import Sequence
from typing import Any, Protocol

from asyncua import ua
from asyncua.client.client import Client
from asyncua.common.node import Node
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.uaerrors import UaError
from cryptography.exceptions import InvalidSignature

from config.schema.cnc_drivers import OpcUaSecurityConfig
from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import OpcUaServer
from drivers.clock import Clock
from drivers.contract import FatalDriverError, LinkError, what_broke
from drivers.json_fields import QUOTED, number_of
from drivers.opcua.bounded import bounded_client
from drivers.opcua.certificates import REFUSALS, load_credentials
from drivers.opcua.cnc import (
    CONNECTING,
    NOT_TRUSTED,
    SESSION_TIMEOUT_MS,
    TOO_MUCH,
    abort,
    cancelled_plainly,
    check_offer,
)
from drivers.opcua.log import limit_library_log
from drivers.opcua.services import UNREADABLE
from drivers.polling import PolledSource
from drivers.readings import NoReading, Readings
from models.quality import Reason

AT_ONCE = 1000
NOT_MEASURED = 0xFFFF_0300
"""Bits of a status that say more than good: severity and subcode, as of a value that a person has put in place of the
sensor's (GoodLocalOverride), and that the value stands at a limit (OPC 10000-4, 7.39)."""


class Place(Protocol):
    """Where a server is, and as whom it is asked."""

    @property
    def endpoint(self) -> str: ...

    @property
    def security(self) -> OpcUaSecurityConfig | None: ...

    @property
    def timeout_s(self) -> float: ...


class TagSession:
    """One session with a server whose variables are read, to be used once."""

    def __init__(self, place: Place, where: str, at_once: int = AT_ONCE) -> None:
        """`at_once`: so many values are asked for in one request, fewer once the server has refused so many."""
        limit_library_log()
        self._place = place
        self._where = where
        self._at_once = at_once
        self._client: Client | None = None
        self.namespaces: list[str] = []

    @property
    def client(self) -> Client:
        """The library's client, while connected."""
        assert self._client is not None
        return self._client

    async def connect(self) -> None:
        """Connect, and read the server's namespaces. Raises LinkError or FatalDriverError."""
        security = self._place.security
        credentials = load_credentials(security) if security else None
        asking = bounded_client(self._place.endpoint, self._place.timeout_s)
        offered = await self.call(CONNECTING, asking.connect_and_get_server_endpoints())
        check_offer(self._where, offered, credentials, "opcua.security")
        client = self._client = bounded_client(self._place.endpoint, self._place.timeout_s)
        client.name, client.product_uri = "Toolpoint", "urn:toolpoint"
        client.session_timeout = SESSION_TIMEOUT_MS
        if credentials:
            credentials.secure(client)
            client.set_user(credentials.user_name)
            client.set_password(credentials.password)
        await self.call(CONNECTING, client.connect())
        if (renewing := client._renew_channel_task) is not None:  # nobody takes its error, and asyncio would log it
            renewing.add_done_callback(lambda _: renewing.cancelled() or renewing.exception())
        self.namespaces = await self.call("reading its namespaces", _namespaces(client))

    async def values(self, nodes: Sequence[Node]) -> list[ua.DataValue]:
        """Return what nodes hold, in as many requests as the server needs; raises LinkError."""
        found: list[ua.DataValue] = []
        while len(found) < len(nodes):
            asked = list(nodes[len(found) : len(found) + self._at_once])
            reading = self.client.read_attributes(asked, AttributeIds.Value)
            try:
                answers = await self.call("reading", reading, keeps=TOO_MUCH if len(asked) > 1 else ())
            except TOO_MUCH:
                self._at_once = (len(asked) + 1) // 2
                continue
            if len(answers or ()) != len(asked):
                raise LinkError(f"{self._where} answered {len(answers or ())} values to a request for {len(asked)}")
            found += answers
        return found

    async def call(self, what: str, call: Any, keeps: tuple[type[UaError], ...] = ()) -> Any:
        """Return what a call brings within the time-out; raises LinkError, and those errors that `keeps` names."""
        try:
            async with asyncio.timeout(self._place.timeout_s):
                return await cancelled_plainly(call)
        except keeps:
            raise
        except TimeoutError as error:
            words = f"{self._where} did not answer within {self._place.timeout_s:g} s while {what}"
            raise LinkError(f"{words}: check address, network, and that the server runs") from error
        except (OSError, UaError, UnicodeError, InvalidSignature) as error:  # the last of a host's name that is none
            code = getattr(error, "code", None)
            if what == CONNECTING and code in REFUSALS:
                raise FatalDriverError(f"{self._where} {REFUSALS[code]} ({type(error).__name__})") from error
            secured = what == CONNECTING and self._client and self._place.security
            unsure = NOT_TRUSTED if secured and code is None else ""
            raise LinkError(f"{self._where} was lost while {what}: {what_broke(error)}{unsure}") from error
        except UNREADABLE as error:
            words = f"{self._where} answers what cannot be read while {what} ({type(error).__name__})"
            raise LinkError(words) from error

    async def close(self) -> None:
        """Close the session and the socket; never waits longer than the time-out."""
        client, self._client = self._client, None
        if client is None:
            return
        with contextlib.suppress(Exception):
            async with asyncio.timeout(self._place.timeout_s):
                await cancelled_plainly(client.disconnect())
        with contextlib.suppress(Exception):
            abort(client)


async def _namespaces(client: Client) -> list[str]:
    """Return the server's namespaces; raises TypeError where it tells something else."""
    told = await client.get_namespace_array()
    if not isinstance(told, list):
        raise TypeError(f"{told!r} is no list")
    return [uri if isinstance(uri, str) else "" for uri in told]


class OpcUaTagSource(PolledSource):
    """Reads all tags at once; a tag whose status is not good has no value."""

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        super().__init__(source, clock)
        assert isinstance(source.connection, OpcUaServer)
        self._config = source.connection
        self._where = f"source {source.name}: {self._config.endpoint}"
        self._session = TagSession(self._config, self._where)
        self._nodes: list[Any] = []

    async def open(self) -> None:
        """Connect and find the namespace; raises LinkError or FatalDriverError."""
        await self._session.connect()
        uri, namespaces = self._config.namespace_uri, self._session.namespaces
        if uri not in namespaces:
            raise FatalDriverError(
                f"{self._where} has no namespace {uri!r} (`namespace_uri`); it has {', '.join(namespaces)}"
            )
        index = namespaces.index(uri)
        self._nodes = [
            self._session.client.get_node(self._node_id(each.node, index)) for each in self._config.every_input
        ]

    def _node_id(self, text: str, namespace_index: int) -> ua.NodeId:
        try:
            node_id = ua.NodeId.from_string(f"ns={namespace_index};{text}" if text[1:2] == "=" else "")
        except (UaError, ValueError) as error:
            raise FatalDriverError(
                f"{self._where}: {text!r} is no node id such as s=Temperature.1 or i=1001, without ns="
            ) from error
        assert isinstance(node_id, ua.NodeId)
        return node_id

    async def read(self) -> Readings:
        """Return the number of each tag; raises LinkError when the server is lost."""
        answers = await self._session.values(self._nodes)
        return {
            each.key: reading_of(answer, each.node, each.element)
            for each, answer in zip(self._config.every_input, answers, strict=True)
        }

    async def release(self) -> None:
        """Close the session and the socket; never waits longer than the time-out."""
        await self._session.close()


def reading_of(answer: ua.DataValue, node: str, element: int | None = None) -> float | NoReading:
    """Return the number of a tag, of an array that of one element, or why there is none."""
    status = answer.StatusCode
    if status is not None and int(status.value) & NOT_MEASURED:
        if status.name in ("BadNodeIdUnknown", "BadNodeIdInvalid"):
            why = f"has no tag {node!r} in the server: correct `node`"
            return NoReading(reason=Reason.NOT_RECEIVED, why=why)
        why = f"has a tag {node!r} whose status is {status.name} ({int(status.value):08X})"
        return NoReading(reason=Reason.DEVICE_ERROR, why=why)
    value = None if answer.Value is None else answer.Value.Value
    if value is None:
        return NoReading(reason=Reason.NOT_RECEIVED, why=f"has a tag {node!r} without a value")
    if element is None:
        return number_of(value, "element" if isinstance(value, list) else "node")
    if not isinstance(value, list):
        return NoReading(reason=Reason.UNREADABLE, why=f"holds no array but {str(value)[:QUOTED]!r}: correct `element`")
    return number_of(value[element] if element < len(value) else f"{len(value)} elements", "element")
