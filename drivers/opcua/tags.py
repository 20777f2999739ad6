"""Numbers that stand as tags in an OPC UA server, beside the CNC or in a gateway."""

import asyncio
import contextlib
from typing import Any

from asyncua import ua
from asyncua.client.client import Client
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.uaerrors import UaError

from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import OpcUaServer
from drivers.clock import Clock
from drivers.contract import FatalDriverError, LinkError
from drivers.json_fields import number_of
from drivers.opcua.bounded import bounded_client
from drivers.opcua.certificates import load_credentials
from drivers.opcua.cnc import abort, cancelled_plainly, secure
from drivers.opcua.log import limit_library_log
from drivers.opcua.services import UNREADABLE
from drivers.polling import PolledSource
from drivers.readings import NoReading, Readings
from models.quality import Reason

NOT_MEASURED = 0xFFFF_0300
"""Bits of a status that say more than good: severity and subcode, as of a value that a person has put in place of the
sensor's (GoodLocalOverride), and that the value stands at a limit (OPC 10000-4, 7.39)."""


class TagSession:
    """One session with a server whose tags are read, to be used once."""

    def __init__(self, config: OpcUaServer, where: str) -> None:
        limit_library_log()
        self._config = config
        self._where = where
        self._client: Client | None = None

    @property
    def client(self) -> Client:
        """The library's client, while connected."""
        assert self._client is not None
        return self._client

    async def connect(self) -> tuple[Client, list[str]]:
        """Connect; return the library's client and the namespaces. Raises LinkError or FatalDriverError."""
        security = self._config.security
        credentials = load_credentials(security) if security else None
        client = self._client = bounded_client(self._config.endpoint, self._config.timeout_s)
        client.name, client.product_uri = "Toolpoint", "urn:toolpoint"
        if credentials:
            secure(client, credentials)
            client.set_user(credentials.user_name)
            client.set_password(credentials.password)
        await self.call("connecting", client.connect())
        return client, await self.call("reading its namespaces", client.get_namespace_array())

    async def call(self, what: str, call: Any, keeps: tuple[type[UaError], ...] = ()) -> Any:
        """Return what a call brings within the time-out; raises LinkError, and those errors that `keeps` names."""
        try:
            async with asyncio.timeout(self._config.timeout_s):
                return await cancelled_plainly(call)
        except keeps:
            raise
        except TimeoutError as error:
            words = f"{self._where} did not answer within {self._config.timeout_s:g} s while {what}"
            raise LinkError(f"{words}: check address, network, and that the server runs") from error
        except (OSError, UaError, UnicodeError) as error:  # the last of a host's name that is none
            raise LinkError(f"{self._where} was lost while {what}: {error or type(error).__name__}") from error
        except UNREADABLE as error:
            words = f"{self._where} answers what cannot be read while {what} ({type(error).__name__})"
            raise LinkError(words) from error

    async def close(self) -> None:
        """Close the session and the socket; never waits longer than the time-out."""
        client, self._client = self._client, None
        if client is None:
            return
        with contextlib.suppress(Exception):
            async with asyncio.timeout(self._config.timeout_s):
                await cancelled_plainly(client.disconnect())
        with contextlib.suppress(Exception):
            abort(client)


class OpcUaTagSource(PolledSource):
    """Reads all tags in one request; a tag whose status is not good has no value."""

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        super().__init__(source, clock)
        assert isinstance(source.connection, OpcUaServer)
        self._config = source.connection
        self._where = f"source {source.name}: {self._config.endpoint}"
        self._session = TagSession(self._config, self._where)
        self._nodes: list[Any] = []

    async def open(self) -> None:
        """Connect and find the namespace; raises LinkError or FatalDriverError."""
        client, namespaces = await self._session.connect()
        uri = self._config.namespace_uri
        if uri not in namespaces:
            raise FatalDriverError(
                f"{self._where} has no namespace {uri!r} (`namespace_uri`); it has {', '.join(namespaces)}"
            )
        index = namespaces.index(uri)
        self._nodes = [client.get_node(self._node_id(each.node, index)) for each in self._config.every_input]

    def _node_id(self, text: str, namespace_index: int) -> ua.NodeId:
        try:
            node_id = ua.NodeId.from_string(f"ns={namespace_index};{text}")
        except (UaError, ValueError) as error:
            raise FatalDriverError(
                f"{self._where}: {text!r} is no node id such as s=Temperature.1 or i=1001"
            ) from error
        assert isinstance(node_id, ua.NodeId)
        return node_id

    async def read(self) -> Readings:
        """Return the number of each tag; raises LinkError when the server is lost."""
        reading = self._session.client.read_attributes(self._nodes, AttributeIds.Value)
        answers = await self._session.call("reading", reading)
        if len(answers) != len(self._nodes):
            raise LinkError(f"{self._where} answered {len(answers)} values to a request for {len(self._nodes)}")
        return {
            each.key: reading_of(answer, each.node)
            for each, answer in zip(self._config.every_input, answers, strict=True)
        }

    async def release(self) -> None:
        """Close the session and the socket; never waits longer than the time-out."""
        await self._session.close()


def reading_of(answer: ua.DataValue, node: str) -> float | NoReading:
    """Return the number of a tag."""
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
    return number_of(value)
