"""The address space: objects, variables and methods that are served. Nothing in it can be written by a client."""

import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from typing import Any

from asyncua.ua.status_codes import StatusCodes

from drivers.opcua.server.encoding import (
    NULL,
    Encoded,
    Kind,
    NodeKey,
    data_value,
    localized_text,
    node_id,
    qualified_name,
    time_100ns,
    variant,
)

OBJECT, VARIABLE, METHOD = 1, 2, 4
ORGANIZES, HAS_TYPE, PROPERTY, COMPONENT = 35, 40, 46, 47
SUBTYPES: dict[int, frozenset[int]] = {
    31: frozenset({31, 32, 33, 34, 35, 40, 44, 46, 47}),
    32: frozenset({32, 40}),
    33: frozenset({33, 34, 35, 44, 46, 47}),
    34: frozenset({34, 44, 46, 47}),
    44: frozenset({44, 46, 47}),
}
"""Reference type -> itself and those of ours that are below it (OPC 10000-3, 7)."""
FOLDER, BASE_OBJECT, BASE_VARIABLE, PROPERTY_TYPE, ANALOG = 61, 58, 63, 68, 17497


class Node:
    """One node; its references are named by those who add it."""

    __slots__ = ("description", "key", "name", "node_class", "references", "type_number")

    def __init__(
        self, key: NodeKey, name: str, node_class: int, type_number: int | None, description: str = ""
    ) -> None:
        """`type_number`: its type definition in namespace 0; None: it has none."""
        self.key, self.name, self.node_class = key, name, node_class
        self.type_number, self.description = type_number, description
        self.references: list[tuple[int, bool, Node]] = []
        """Type, whether it points forward, and where."""

    def attribute(self, number: int, *, may_call: bool) -> Encoded | None:
        """Return an attribute other than the value (OPC 10000-6, A.1), None where the node has none of this number."""
        match number:
            case 1:
                return Encoded(b"\x11" + node_id(self.key))
            case 2:
                return variant(Kind.INT32, self.node_class)
            case 3:
                return Encoded(b"\x14" + qualified_name(self.key[0], self.name))
            case 4:
                return Encoded(b"\x15" + localized_text(self.name))
            case 5:
                return Encoded(b"\x15" + localized_text(self.description))
            case 6 | 7:
                return variant(Kind.UINT32, 0)
            case 12 if self.node_class == OBJECT:
                return Encoded(b"\x03\x00")
            case 21 if self.node_class == METHOD:
                return variant(Kind.BOOLEAN, True)
            case 22 if self.node_class == METHOD:
                return variant(Kind.BOOLEAN, may_call)
        return None

    def described(self, kind: int, *, forward: bool) -> bytes:
        """Return it as a reference of a browse (OPC 10000-4, 7.30)."""
        type_definition = b"\x00\x00" if self.type_number is None else node_id((0, self.type_number))
        return b"".join(
            (
                node_id((0, kind)),
                b"\x01" if forward else b"\x00",
                node_id(self.key),
                qualified_name(self.key[0], self.name),
                localized_text(self.name),
                self.node_class.to_bytes(4, "little"),
                type_definition,
            )
        )


class Variable(Node):
    """A value with its quality and the time of its source; encoded once for all who read it."""

    __slots__ = ("_encoded", "changed", "kind", "rank", "server_100ns", "source_100ns", "stamped", "status", "value")
    runs = False
    """It holds the time, so it is another one whenever it is looked at."""

    def __init__(
        self,
        key: NodeKey,
        name: str,
        kind: Kind,
        value: Encoded = NULL,
        *,
        type_number: int = BASE_VARIABLE,
        array: bool = False,
        data_type: int | None = None,
        description: str = "",
    ) -> None:
        """`data_type` of a structure: its number in namespace 0."""
        super().__init__(key, name, VARIABLE, type_number, description)
        self.kind, self.rank = (kind if data_type is None else data_type), 1 if array else -1
        self.value, self.status, self.source_100ns = value, int(StatusCodes.Good), 0
        self.server_100ns = 0
        self.changed = self.stamped = 1
        """Count of the changes of value or status; and of the time too."""
        self._encoded: dict[int, bytes] = {}

    def set(self, value: Encoded, status: int, source_utc_s: float) -> None:
        """Take a new value; one that is like the last is no change."""
        source = time_100ns(source_utc_s) if source_utc_s > 0.0 else 0  # none
        if value != self.value or status != self.status:
            self.changed += 1
        elif source == self.source_100ns:
            return
        self.stamped += 1
        self.value, self.status, self.source_100ns = value, status, source
        self.server_100ns = time_100ns(time.time())
        self._encoded.clear()

    def read(self, stamps: int) -> bytes:
        """Return the value as it is read, with the wanted time stamps."""
        found = self._encoded.get(stamps)
        if found is None:
            server = self.server_100ns or time_100ns(time.time())
            found = self._encoded[stamps] = data_value(self.value, self.status, self.source_100ns, server, stamps)
        return found

    def attribute(self, number: int, *, may_call: bool) -> Encoded | None:
        match number:
            case 14:
                return Encoded(b"\x11" + node_id((0, self.kind)))
            case 15:
                return variant(Kind.INT32, self.rank)
            case 17 | 18:
                return Encoded(b"\x03\x01")
            case 19:
                return variant(Kind.DOUBLE, 0.0)
            case 20:
                return variant(Kind.BOOLEAN, False)
        return super().attribute(number, may_call=may_call)


class Clock(Variable):
    """The server's time: read anew each time."""

    __slots__ = ()
    runs = True

    def read(self, stamps: int) -> bytes:
        now = time_100ns(time.time())
        return data_value(variant(Kind.TIME, now), 0, now, now, stamps)


class CallRefusedError(Exception):
    """A method was not carried out: the status that the client gets, and a sentence for the person."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


Call = Callable[[Any, Sequence[Any]], Awaitable[list[Encoded]]]
"""Takes the person and the arguments, returns the results; raises CallRefusedError."""


class Method(Node):
    """Something that a person may have done."""

    __slots__ = ("call", "inputs", "may")

    def __init__(
        self,
        key: NodeKey,
        name: str,
        description: str,
        call: Call,
        *,
        inputs: Sequence[type],
        may: Callable[[Any], bool],
    ) -> None:
        """`inputs` are the types of its arguments, a list being one of texts; `may`: whether a person is allowed."""
        super().__init__(key, name, METHOD, None, description)
        self.call, self.inputs, self.may = call, inputs, may


class Space:
    """All nodes, by their key."""

    def __init__(self) -> None:
        self.nodes: dict[NodeKey, Node] = {}

    def add(self, node: Node, parent: Node | None, reference: int) -> Node:
        assert node.key not in self.nodes, node.key
        self.nodes[node.key] = node
        if parent is not None:
            parent.references.append((reference, True, node))
            node.references.append((reference, False, parent))
        return node

    def variables(self) -> Iterator[Variable]:
        return (node for node in self.nodes.values() if isinstance(node, Variable))

    def browsed(self, node: Node, direction: int, kind: NodeKey, *, subtypes: bool, classes: int) -> Iterable[bytes]:
        """Yield the references of a node as a browse describes them; `kind` (0, 0) means all."""
        wanted = _wanted(kind, subtypes=subtypes)
        for reference, forward, other in node.references:
            if (
                direction in (0 if forward else 1, 2)
                and reference in wanted
                and (not classes or other.node_class & classes)
            ):
                yield other.described(reference, forward=forward)
        if direction != 1 and HAS_TYPE in wanted and node.type_number is not None and (not classes or classes & 24):
            yield _type_of(node)

    def followed(
        self, node: Node, kind: NodeKey, *, inverse: bool, subtypes: bool, name: tuple[int, str]
    ) -> Node | None:
        """Return where a step of a browse path leads, None where to nothing."""
        wanted = _wanted(kind, subtypes=subtypes)
        for reference, forward, other in node.references:
            if reference in wanted and forward is not inverse and (other.key[0], other.name) == name:
                return other
        return None


def _wanted(kind: NodeKey, *, subtypes: bool) -> frozenset[int]:
    if kind == (0, 0):
        return SUBTYPES[31]
    number = kind[1] if kind[0] == 0 and isinstance(kind[1], int) else -1
    return SUBTYPES.get(number, frozenset({number})) if subtypes else frozenset({number})


def _type_of(node: Node) -> bytes:
    """Return the reference to a node's type; the types themselves are not served."""
    assert node.type_number is not None
    name = {FOLDER: "FolderType", BASE_OBJECT: "BaseObjectType", BASE_VARIABLE: "BaseDataVariableType"}
    name |= {PROPERTY_TYPE: "PropertyType", ANALOG: "AnalogUnitType", 2004: "ServerType"}
    words = name.get(node.type_number, "")
    node_class = 16 if node.node_class == VARIABLE else 8
    parts = (node_id((0, HAS_TYPE)), b"\x01", node_id((0, node.type_number)), qualified_name(0, words))
    return b"".join((*parts, localized_text(words), node_class.to_bytes(4, "little"), b"\x00\x00"))
