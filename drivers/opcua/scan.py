"""Which variables of an OPC UA server hold numbers, and which of them look like temperatures or lengths. Reads only."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from asyncua import ua
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.uaerrors import UaStatusCodeError

from drivers.json_fields import number_of
from drivers.opcua.browsing import VARIABLE, children
from drivers.opcua.tags import TagSession

MOST_NODES = 20_000
"""Nodes that are looked at before the rest is left."""
MOST_TAGS = 500
PROPERTY = ua.NodeId(ua.Int32(ObjectIds.HasProperty))
"""How a variable refers to what describes it, which is nothing measured."""
UNITS = {"°c": "degC", "degc": "degC", "c": "degC", "°f": "degF", "degf": "degF", "k": "K"}
LENGTHS = {"mm": "mm", "µm": "um", "μm": "um", "um": "um", "micron": "um"}
"""How engineering units are written -> how the configuration writes them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundTag:
    """One variable that holds a number, or one number of a variable that is an array."""

    namespace_uri: str
    node: str
    """Identifier in its namespace, as the configuration writes it."""
    name: str
    element: int | None
    """Place in the array; None: the variable is a number."""
    number: float
    unit: str
    """As the configuration writes it; '' where the server gives none or another."""
    given_unit: str
    """As the server writes it."""


async def analog_variables(session: TagSession) -> tuple[list[FoundTag], bool]:
    """Return the numbers below the server's objects, its own (namespace 0) left out, and whether there are more."""
    await session.connect()
    client = session.client
    waiting, seen, found = deque([client.nodes.objects]), {client.nodes.objects.nodeid}, list[FoundTag]()
    while waiting and len(seen) < MOST_NODES and len(found) < MOST_TAGS:
        node = waiting.popleft()
        variables = []
        for child in await children(session, node) or ():
            node_id = child.NodeId
            is_property = child.ReferenceTypeId == PROPERTY
            if is_property or node_id in seen or node_id.NamespaceIndex == 0:
                continue
            seen.add(node_id)
            waiting.append(client.get_node(node_id))
            if child.NodeClass == VARIABLE:
                variables.append((client.get_node(node_id), child.BrowseName.Name or ""))
        found += await _numbers(session, variables, MOST_TAGS + 1 - len(found))
    return found[:MOST_TAGS], bool(waiting) or len(found) > MOST_TAGS


async def _numbers(session: TagSession, variables: Sequence[tuple[Any, str]], most: int) -> list[FoundTag]:
    """Return those of the variables that hold a number now, at most so many."""
    answers = await session.values([node for node, _ in variables])
    found: list[FoundTag] = []
    for (node, name), answer in zip(variables, answers, strict=True):
        if len(found) >= most:
            break
        if answer.StatusCode is not None and not answer.StatusCode.is_good():
            continue
        value = None if answer.Value is None else answer.Value.Value
        each = list(enumerate(value[:most])) if isinstance(value, list) else [(None, value)]
        numbers = [(place, number) for place, one in each if isinstance(number := number_of(one), float)]
        given = await _unit(session, node) if numbers else ""
        found += (
            FoundTag(
                namespace_uri=session.namespaces[node.nodeid.NamespaceIndex],
                node=node.nodeid.to_string().partition(";")[2] or node.nodeid.to_string(),
                name=name if place is None else f"{name}_{place}",
                element=place,
                number=number,
                unit=(UNITS | LENGTHS).get(given.strip().lower(), ""),
                given_unit=given,
            )
            for place, number in numbers
            if math.isfinite(number)
        )
    return found


async def _unit(session: TagSession, node: Any) -> str:
    """Return the engineering unit of an analog variable (OPC 10000-8, 5.6.3), '' where it has none."""
    try:
        about = await session.call("reading a unit", node.get_child("0:EngineeringUnits"), keeps=(UaStatusCodeError,))
        value = await session.call("reading a unit", about.read_value(), keeps=(UaStatusCodeError,))
    except UaStatusCodeError:
        return ""
    return str(getattr(getattr(value, "DisplayName", None), "Text", "") or "")
