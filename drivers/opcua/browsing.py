"""Looks through an OPC UA server for its variables; reads only."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from asyncua import ua
from asyncua.common.node import Node
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.uaerrors import UaStatusCodeError

from drivers.opcua.tags import TagSession

MOST_NODES = 20_000
"""So many nodes are looked at; a control may have hundreds of thousands."""
DEEPEST = 12
HIERARCHICAL = ua.NodeId(ua.Int32(ObjectIds.HierarchicalReferences))
OBJECT, VARIABLE = ua.NodeClass.Object, ua.NodeClass.Variable
KINDS: Any = OBJECT | VARIABLE
"""A mask, which the library declares as one kind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable:
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
        return self.path.rpartition("/")[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Browsed:
    """What a server shows."""

    namespaces: tuple[str, ...]
    variables: tuple[Variable, ...]
    complete: bool
    """False where there are more nodes than are looked at, or some are not for everybody."""


async def browse(session: TagSession) -> Browsed:
    """Return every variable below the folder of objects, but for the server's own; raises LinkError."""
    start = session.client.nodes.objects.nodeid
    seen = {start, ua.NodeId(ua.Int32(ObjectIds.Server))}
    waiting: deque[tuple[ua.NodeId, str, int]] = deque([(start, "", 0)])
    found: list[tuple[ua.NodeId, str]] = []
    complete = True
    while waiting and len(seen) <= MOST_NODES:
        node_id, path, depth = waiting.popleft()
        if depth == DEEPEST:
            break
        below = await children(session, session.client.get_node(node_id))
        complete &= below is not None
        for child in below or ():
            if child.NodeId not in seen and len(seen) <= MOST_NODES:
                seen.add(child.NodeId)
                waiting.append((child.NodeId, f"{path}/{child.BrowseName.Name}".lstrip("/"), depth + 1))
                if child.NodeClass == VARIABLE:
                    found.append(waiting[-1][:2])
    values = await values_of(session, [node_id for node_id, _ in found])
    variables = tuple(
        Variable(namespace=session.namespaces[node_id.NamespaceIndex], node=_text(node_id), path=path, value=value)
        for (node_id, path), value in zip(found, values, strict=True)
    )
    complete &= not waiting and len(seen) <= MOST_NODES
    return Browsed(namespaces=tuple(session.namespaces), variables=variables, complete=complete)


async def values_of(session: TagSession, nodes: Sequence[ua.NodeId]) -> list[Any]:
    """Return what nodes hold, None where they cannot be read; they need not be browsable. Raises LinkError."""
    return [_value(answer) for answer in await session.values([session.client.get_node(node) for node in nodes])]


async def children(session: TagSession, node: Node) -> list[ua.ReferenceDescription] | None:
    """Return the objects and variables below a node, None where it is not for everybody; raises LinkError."""
    browsing = node.get_references(HIERARCHICAL, ua.BrowseDirection.Forward, nodeclassmask=KINDS)
    try:
        found = await session.call("browsing", browsing, keeps=(UaStatusCodeError,))
    except UaStatusCodeError:
        return None
    known = range(len(session.namespaces))
    return [each for each in found if each.NodeClass in (OBJECT, VARIABLE) and each.NodeId.NamespaceIndex in known]


def _text(node_id: ua.NodeId) -> str:
    whole = str(node_id.to_string())
    return whole.partition(";")[2] if whole.startswith("ns=") else whole


def _value(answer: ua.DataValue) -> Any:
    if answer.StatusCode is not None and not answer.StatusCode.is_good():
        return None
    return None if answer.Value is None else answer.Value.Value
