"""Browsing, reading and calling (OPC 10000-4, 5.9, 5.11 and 5.12). Writing is answered, and never done."""

from collections.abc import Callable
from typing import Any

from asyncua import ua
from asyncua.ua.status_codes import StatusCodes

from drivers.opcua.server.encoding import node_id
from drivers.opcua.server.requests import Request, ServiceError, key_of, listed, results, status_bytes
from drivers.opcua.server.space import CallRefusedError, Method, Node, Space, Variable
from drivers.opcua.server.standard import CONTINUATION_POINTS, MOST_CALLS

VALUE = 13
MOST_REFERENCES = 1000
"""So many references of a node are sent at a time; the rest waits behind a continuation point."""
NO_TEXT = b"\xff\xff\xff\xff"
WITH_STATUS = 2


class Views:
    """What one session looks at; it holds the continuation points of its browses."""

    def __init__(self, space: Space, refresh: Callable[[], None]) -> None:
        """`refresh` brings the variables up to date."""
        self._space, self._refresh = space, refresh
        self._points: dict[bytes, tuple[list[bytes], int]] = {}
        self._made = 0

    async def read(self, request: Request, person: Any) -> bytes:
        _, stamps = request.unpacked("<di")
        if stamps not in range(4):
            raise ServiceError(StatusCodes.BadTimestampsToReturnInvalid)
        self._refresh()
        return results([self._read(each, stamps, person) async for each in request.each(ua.ReadValueId)])

    def _read(self, wanted: Any, stamps: int, person: Any) -> bytes:
        node = self._space.nodes.get(key_of(wanted.NodeId))
        if node is None:
            return _no_value(StatusCodes.BadNodeIdUnknown)
        if wanted.IndexRange:
            return _no_value(StatusCodes.BadIndexRangeInvalid)
        if wanted.AttributeId == VALUE and isinstance(node, Variable):
            return node.read(stamps)
        may = isinstance(node, Method) and node.may(person)
        found = node.attribute(int(wanted.AttributeId), may_call=may)
        return _no_value(StatusCodes.BadAttributeIdInvalid) if found is None else b"\x01" + found

    async def write(self, request: Request) -> bytes:
        """Answer Write: nothing that is served can be written, so nothing of it is decoded."""
        return results([status_bytes(StatusCodes.BadNotWritable)] * request.count())

    async def browse(self, request: Request) -> bytes:
        view = request.structure(ua.ViewDescription)
        (most,) = request.unpacked("<I")
        if not view.ViewId.is_null():
            raise ServiceError(StatusCodes.BadViewIdUnknown)
        most = min(most or MOST_REFERENCES, MOST_REFERENCES)
        return results([self._browse(each, most) async for each in request.each(ua.BrowseDescription)])

    def _browse(self, wanted: Any, most: int) -> bytes:
        node = self._space.nodes.get(key_of(wanted.NodeId))
        if node is None:
            return _browsed(StatusCodes.BadNodeIdUnknown)
        kind, direction = key_of(wanted.ReferenceTypeId), int(wanted.BrowseDirection)
        if direction not in range(3):
            return _browsed(StatusCodes.BadBrowseDirectionInvalid)
        found = list(
            self._space.browsed(
                node, direction, kind, subtypes=bool(wanted.IncludeSubtypes), classes=int(wanted.NodeClassMask)
            )
        )
        return self._part(found, most)

    def _part(self, found: list[bytes], most: int) -> bytes:
        if len(found) <= most:
            return _browsed(StatusCodes.Good, b"", found)
        if len(self._points) >= CONTINUATION_POINTS:
            return _browsed(StatusCodes.BadNoContinuationPoints)
        self._made += 1
        point = self._made.to_bytes(8, "little")
        self._points[point] = found[most:], most
        return _browsed(StatusCodes.Good, point, found[:most])

    async def browse_next(self, request: Request) -> bytes:
        (release,) = request.unpacked("<?")
        entries = []
        async for point in request.texts(CONTINUATION_POINTS):
            found = self._points.pop(point, None)
            if found is None:
                entries.append(_browsed(StatusCodes.BadContinuationPointInvalid))
            else:
                entries.append(_browsed(StatusCodes.Good) if release else self._part(*found))
        return results(entries)

    async def translate(self, request: Request) -> bytes:
        """Answer TranslateBrowsePathsToNodeIds."""
        return results([self._translated(each) async for each in request.each(ua.BrowsePath)])

    def _translated(self, path: Any) -> bytes:
        node: Node | None = self._space.nodes.get(key_of(path.StartingNode))
        if node is None:
            return status_bytes(StatusCodes.BadNodeIdUnknown) + listed([])
        for step in path.RelativePath.Elements or ():
            name = step.TargetName.NamespaceIndex, step.TargetName.Name
            kind, inverse, subtypes = key_of(step.ReferenceTypeId), bool(step.IsInverse), bool(step.IncludeSubtypes)
            node = self._space.followed(node, kind, inverse=inverse, subtypes=subtypes, name=name)
            if node is None:
                return status_bytes(StatusCodes.BadNoMatch) + listed([])
        return status_bytes(StatusCodes.Good) + listed([node_id(node.key) + status_bytes(0xFFFF_FFFF)])

    async def call(self, request: Request, person: Any) -> bytes:
        """Answer Call: one method after the other."""
        entries, words = [], []
        async for wanted in request.each(ua.CallMethodRequest, MOST_CALLS):
            entry, sentence = await self._called(wanted, person)
            entries.append(entry)
            words.append(sentence)
        return results(entries, words if request.wants_words else None)

    async def _called(self, wanted: Any, person: Any) -> tuple[bytes, str]:
        method = self._space.nodes.get(key_of(wanted.MethodId))
        if not isinstance(method, Method):
            return _not_called(StatusCodes.BadMethodInvalid), ""
        if not any(key_of(wanted.ObjectId) == node.key for _, forward, node in method.references if not forward):
            return _not_called(StatusCodes.BadNodeIdUnknown), ""
        values = [argument.Value for argument in wanted.InputArguments or ()]
        if len(values) != len(method.inputs):
            missing = len(values) < len(method.inputs)
            return _not_called(StatusCodes.BadArgumentsMissing if missing else StatusCodes.BadTooManyArguments), ""
        fits = [_fits(value, kind) for value, kind in zip(values, method.inputs, strict=True)]
        if not all(fits):
            checks = [status_bytes(StatusCodes.Good if fit else StatusCodes.BadTypeMismatch) for fit in fits]
            return _not_called(StatusCodes.BadInvalidArgument, checks), ""
        try:
            outputs = await method.call(person, values)
        except CallRefusedError as refusal:
            return _not_called(refusal.status), str(refusal)
        good = listed([status_bytes(StatusCodes.Good)] * len(values))
        return status_bytes(StatusCodes.Good) + good + listed([]) + listed(list(outputs)), ""

    async def registered(self, request: Request) -> bytes:
        """Answer RegisterNodes: nothing becomes faster by it."""
        keys = [key_of(each) async for each in request.nodes()]
        return listed([node_id(key) for key in keys])


def _fits(value: Any, kind: type) -> bool:
    """Return whether an argument is of this type; an empty or absent list is a list."""
    if kind is list:
        return value is None or (isinstance(value, list) and all(isinstance(each, str) for each in value))
    return isinstance(value, kind)


def _no_value(status: int) -> bytes:
    return bytes((WITH_STATUS,)) + status_bytes(status)


def _browsed(status: int, point: bytes = b"", found: list[bytes] | None = None) -> bytes:
    points = len(point).to_bytes(4, "little") + point if point else NO_TEXT
    return status_bytes(status) + points + listed(found or [])


def _not_called(status: int, checks: list[bytes] | None = None) -> bytes:
    return status_bytes(status) + listed(checks or []) + listed([]) + listed([])
