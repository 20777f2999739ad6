"""The nodes of namespace 0 that every client looks for: folders, the server with its namespaces, state and limits."""

import time

from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary

from drivers.opcua.server.encoding import Encoded, Kind, extension, strings, time_100ns, variant
from drivers.opcua.server.space import (
    BASE_OBJECT,
    COMPONENT,
    FOLDER,
    OBJECT,
    ORGANIZES,
    PROPERTY,
    PROPERTY_TYPE,
    Clock,
    Node,
    Space,
    Variable,
)

NAMESPACE_ZERO = "http://opcfoundation.org/UA/"
MOST_NODES = 2000
"""Nodes of one request: so many are read, browsed, watched or translated."""
MOST_CALLS = 4
CONTINUATION_POINTS = 4
LEAST_INTERVAL_MS = 250.0
"""Shortest publishing interval that is granted [ms]."""
EU_INFORMATION, EU_ENCODING = 887, 889
STATUS_TYPE, STATUS_ENCODING = 862, 864
UNITS = {"°C": 4408652, "µm": 13384, "1/min": 5394509, "µm/min": 0}
"""Unit -> UN/CEFACT code as OPC UA counts it (OPC 10000-8, 5.6.3), 0 where there is none."""


def standard_space(application_uri: str, namespaces: list[str], product: str, version: str) -> tuple[Space, Node]:
    """Return a space with the nodes of namespace 0, and its folder of objects."""
    space = Space()
    root = space.add(Node((0, 84), "Root", OBJECT, FOLDER), None, ORGANIZES)
    objects = space.add(Node((0, 85), "Objects", OBJECT, FOLDER), root, ORGANIZES)
    space.add(Node((0, 86), "Types", OBJECT, FOLDER), root, ORGANIZES)
    space.add(Node((0, 87), "Views", OBJECT, FOLDER), root, ORGANIZES)
    server = space.add(Node((0, 2253), "Server", OBJECT, 2004), objects, ORGANIZES)

    def texts(number: int, name: str, parent: Node, values: list[str]) -> None:
        space.add(Variable((0, number), name, Kind.STRING, strings(values), array=True), parent, PROPERTY)

    def count(number: int, name: str, parent: Node, value: int) -> None:
        space.add(Variable((0, number), name, Kind.UINT32, variant(Kind.UINT32, value)), parent, PROPERTY)

    texts(2254, "ServerArray", server, [application_uri])
    texts(2255, "NamespaceArray", server, [NAMESPACE_ZERO, *namespaces])
    level = Encoded(b"\x03\xff")
    space.add(Variable((0, 2267), "ServiceLevel", Kind.UINT32, level, data_type=3), server, PROPERTY)
    space.add(Variable((0, 2994), "Auditing", Kind.BOOLEAN, variant(Kind.BOOLEAN, False)), server, PROPERTY)
    status = Status(application_uri, product, version)
    space.add(status, server, COMPONENT)
    started = Variable((0, 2257), "StartTime", Kind.TIME, variant(Kind.TIME, status.started_100ns))
    space.add(started, status, COMPONENT)
    space.add(Clock((0, 2258), "CurrentTime", Kind.TIME), status, COMPONENT)
    state = Variable((0, 2259), "State", Kind.INT32, variant(Kind.INT32, 0), data_type=852)
    space.add(state, status, COMPONENT)
    able = space.add(Node((0, 2268), "ServerCapabilities", OBJECT, 2013), server, COMPONENT)
    texts(2269, "ServerProfileArray", able, ["http://opcfoundation.org/UA-Profile/Server/MicroEmbeddedDevice2017"])
    texts(2271, "LocaleIdArray", able, ["en"])
    rate = Variable((0, 2272), "MinSupportedSampleRate", Kind.DOUBLE, variant(Kind.DOUBLE, LEAST_INTERVAL_MS))
    space.add(rate, able, PROPERTY)
    points = Encoded(b"\x05" + CONTINUATION_POINTS.to_bytes(2, "little"))
    name = "MaxBrowseContinuationPoints"
    space.add(Variable((0, 2735), name, Kind.INT32, points, data_type=5), able, PROPERTY)
    limits = space.add(Node((0, 11704), "OperationLimits", OBJECT, BASE_OBJECT), able, COMPONENT)
    for number, name in (
        (11705, "MaxNodesPerRead"),
        (11707, "MaxNodesPerWrite"),
        (11710, "MaxNodesPerBrowse"),
        (11712, "MaxNodesPerTranslateBrowsePathsToNodeIds"),
        (11714, "MaxMonitoredItemsPerCall"),
    ):
        count(number, name, limits, MOST_NODES)
    count(11709, "MaxNodesPerMethodCall", limits, MOST_CALLS)
    return space, objects


class Status(Variable):
    """State of the server as one structure; it holds the time, so it is made when it is read."""

    __slots__ = ("_build", "started_100ns")
    runs = True

    def __init__(self, application_uri: str, product: str, version: str) -> None:
        super().__init__((0, 2256), "ServerStatus", Kind.EXTENSION, type_number=2138, data_type=STATUS_TYPE)
        self.started_100ns = time_100ns(time.time())
        build = ua.BuildInfo(
            ProductUri=application_uri, ManufacturerName="", ProductName=product, SoftwareVersion=version
        )
        self._build: bytes = struct_to_binary(build)

    def read(self, stamps: int) -> bytes:
        now = time_100ns(time.time())
        times = self.started_100ns.to_bytes(8, "little") + now.to_bytes(8, "little")
        body = times + bytes(4) + self._build + bytes(4) + b"\x00"
        self.value, self.source_100ns, self.server_100ns = extension(STATUS_ENCODING, body), now, now
        self._encoded.clear()
        return super().read(stamps)


def unit_property(key: tuple[int, str], unit: str) -> Variable:
    """Return the property that says in which unit a value is (OPC 10000-8, 5.6.3)."""
    known = ua.EUInformation(
        NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
        UnitId=UNITS[unit],
        DisplayName=ua.LocalizedText(unit),
        Description=ua.LocalizedText(unit),
    )
    value = extension(EU_ENCODING, struct_to_binary(known))
    return Variable(key, "EngineeringUnits", Kind.EXTENSION, value, type_number=PROPERTY_TYPE, data_type=EU_INFORMATION)


def add_arguments(space: Space, method: Node, inputs: list[ua.Argument], outputs: list[ua.Argument]) -> None:
    """Add the properties that describe what a method takes and gives."""
    for name, arguments in (("InputArguments", inputs), ("OutputArguments", outputs)):
        if not arguments:
            continue
        bodies = [extension(298, struct_to_binary(argument)) for argument in arguments]
        content = bytes((Kind.EXTENSION | 0x80,)) + len(bodies).to_bytes(4, "little")
        content += b"".join(body[1:] for body in bodies)
        variable = Variable(
            (method.key[0], f"{method.key[1]}.{name}"),
            name,
            Kind.EXTENSION,
            Encoded(content),
            type_number=PROPERTY_TYPE,
            array=True,
            data_type=296,
        )
        space.add(variable, method, PROPERTY)
