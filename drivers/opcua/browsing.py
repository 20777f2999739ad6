"""Looks through an OPC UA server for its variables; reads only."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from asyncua import ua
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.uaerrors import UaError

from config.schema.cnc_drivers import OpcUaSecurityConfig
from drivers.contract import LinkError
from drivers.opcua.bounded import bounded_client
from drivers.opcua.certificates import load_credentials
from drivers.opcua.cnc import abort, cancelled_plainly, secure
from drivers.opcua.log import limit_library_log
from drivers.opcua.services import UNREADABLE

MOST_NODES = 20_000
"""So many nodes are looked at; a control may have hundreds of thousands."""
DEEPEST = 12
READ_AT_ONCE = 100
HIERARCHICAL = ua.NodeId(ua.Int32(ObjectIds.HierarchicalReferences))


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable:
    """One variable of the server."""

    namespace: str
    """URI."""
    node: str
    """Identifier in the namespace, as the configuration names it: s=text or i=number."""
    path: str
    """Names of the nodes above it and its own."""
    value: Any
    """What it holds now, None where it cannot be read."""

    @property
    def name(self) -> str:
        """Its own name."""
        return self.path.rpartition("/")[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Browsed:
    """What a server shows."""

    namespaces: tuple[str, ...]
    variables: tuple[Variable, ...]
    complete: bool
    """False where there are more nodes than are looked at."""


class Browser:
    """One session for looking."""

    def __init__(self, endpoint: str, security: OpcUaSecurityConfig | None, timeout_s: float) -> None:
        limit_library_log()
        self._endpoint = endpoint
        self._timeout_s = timeout_s
        credentials = load_credentials(security) if security else None
        self._client = bounded_client(endpoint, timeout_s)
        self._client.name, self._client.product_uri = "Toolpoint", "urn:toolpoint"
        if credentials:
            secure(self._client, credentials)
            self._client.set_user(credentials.user_name)
            self._client.set_password(credentials.password)
        self._namespaces: tuple[str, ...] = ()

    async def __aenter__(self) -> "Browser":
        await self._call("connecting", self._client.connect())
        self._namespaces = tuple(await self._call("reading its namespaces", self._client.get_namespace_array()))
        return self

    async def __aexit__(self, *_: object) -> None:
        try:
            async with asyncio.timeout(self._timeout_s):
                await cancelled_plainly(self._client.disconnect())
        except (OSError, UaError, TimeoutError):
            abort(self._client)

    async def browse(self) -> Browsed:
        """Return every variable below the folder of objects, but for the server's own."""
        start = self._client.nodes.objects.nodeid
        seen = {start, ua.NodeId(ua.Int32(ObjectIds.Server))}
        level: list[tuple[ua.NodeId, str]] = [(start, "")]
        found: list[tuple[ua.NodeId, str]] = []
        complete = True
        for _ in range(DEEPEST):
            below: list[tuple[ua.NodeId, str]] = []
            for node_id, path in level:
                for child, name, is_variable in await self._children(node_id):
                    if child in seen:
                        continue
                    if len(seen) > MOST_NODES:
                        complete = False
                        break
                    seen.add(child)
                    below.append((child, f"{path}/{name}".lstrip("/")))
                    if is_variable:
                        found.append(below[-1])
            level = below
        values = await self.values([node_id for node_id, _ in found])
        variables = tuple(
            Variable(namespace=self._namespaces[node_id.NamespaceIndex], node=_text(node_id), path=path, value=value)
            for (node_id, path), value in zip(found, values, strict=True)
        )
        return Browsed(namespaces=self._namespaces, variables=variables, complete=complete and not level)

    async def values_of(self, namespace: str, nodes: Sequence[str]) -> list[Any]:
        """Return what nodes of a namespace hold, None where they cannot be read; they need not be browsable."""
        index = self._namespaces.index(namespace)
        return await self.values([ua.NodeId.from_string(f"ns={index};{text}") for text in nodes])

    async def values(self, nodes: Sequence[ua.NodeId]) -> list[Any]:
        """Return what nodes hold, None where they cannot be read."""
        found: list[Any] = []
        for first in range(0, len(nodes), READ_AT_ONCE):
            asked = [self._client.get_node(node) for node in nodes[first : first + READ_AT_ONCE]]
            answers = await self._call("reading", self._client.read_attributes(asked, AttributeIds.Value))
            found += [_value(answer) for answer in answers]
        return found

    async def _children(self, node_id: ua.NodeId) -> list[tuple[ua.NodeId, str, bool]]:
        node = self._client.get_node(node_id)
        references = await self._call(
            "looking through it", node.get_references(refs=HIERARCHICAL, direction=ua.BrowseDirection.Forward)
        )
        return [
            (each.NodeId, str(each.BrowseName.Name), each.NodeClass == ua.NodeClass.Variable)
            for each in references
            if each.NodeClass in (ua.NodeClass.Object, ua.NodeClass.Variable)
            and each.NodeId.NamespaceIndex < len(self._namespaces)
        ]

    async def _call(self, what: str, call: Any) -> Any:
        try:
            async with asyncio.timeout(self._timeout_s):
                return await cancelled_plainly(call)
        except TimeoutError as error:
            raise LinkError(f"{self._endpoint} did not answer within {self._timeout_s:g} s while {what}") from error
        except (OSError, UaError, *UNREADABLE) as error:
            words = str(error) or type(error).__name__
            raise LinkError(f"{self._endpoint} was lost while {what}: {words}") from error


def _text(node_id: ua.NodeId) -> str:
    """Return a node id without its namespace."""
    whole = str(node_id.to_string())
    return whole.partition(";")[2] if whole.startswith("ns=") else whole


def _value(answer: ua.DataValue) -> Any:
    if answer.StatusCode is not None and not answer.StatusCode.is_good():
        return None
    return None if answer.Value is None else answer.Value.Value
