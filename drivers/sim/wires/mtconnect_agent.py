"""An MTConnect agent on 127.0.0.1 for one simulated NC: probe, current, sample, with sequence, buffer and instance."""

import asyncio
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from urllib.parse import parse_qs, urlsplit
from xml.sax.saxutils import escape, quoteattr

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import MtconnectConfig
from drivers.sim.contract import SimulatedNc
from drivers.sim.wires.listener import HOST, Listener

UUID = "toolpoint-simulated"
DEVICE = "SimulatedMachine"
RUNS = {0: "READY", 1: "STOPPED", 2: "FEED_HOLD", 3: "ACTIVE", 4: "ACTIVE"}
MODES = {0: "MANUAL_DATA_INPUT", 1: "AUTOMATIC", 3: "EDIT"}
ITEMS: dict[str, tuple[str, str, str, Callable[[SimulatedNc], str]]] = {
    "avail": ("AVAILABILITY", "", "Event", lambda _: "AVAILABLE"),
    "exec": ("EXECUTION", "", "Event", lambda nc: RUNS.get(nc.run, "READY")),
    "mode": ("CONTROLLER_MODE", "", "Event", lambda nc: MODES.get(nc.mode, "MANUAL")),
    "prog": ("PROGRAM", "MAIN", "Event", lambda nc: f"O{nc.program:04d}"),
    "block": ("BLOCK", "", "Event", lambda nc: f"N{nc.sequence_number} (SIMULATED)"),
    "tool": ("TOOL_NUMBER", "", "Event", lambda nc: str(nc.tool_number)),
    "offset": ("WORK_OFFSET", "", "Event", lambda nc: f"G{nc.work_offset}"),
    "speed": ("ROTARY_VELOCITY", "ACTUAL", "Sample", lambda nc: f"{nc.spindle_speed_rpm:g}"),
    "heat": ("TEMPERATURE", "ACTUAL", "Sample", lambda nc: f"{nc.motor_temperature_degc:g}"),
    "system": ("SYSTEM", "", "Condition", lambda nc: "Fault" if nc.alarm else "Normal"),
    "zact": ("POSITION", "ACTUAL", "Sample", lambda nc: f"{nc.positions_mm['Z']:g}"),
}
"""Data item -> type, subtype, category, and what it shows."""
BUFFER = 64
"""So many observations are remembered."""
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
SCHEMA = "urn:mtconnect.org:{0}:1.8"


class SimulatedMtconnectAgent(Listener[asyncio.WriteTransport]):
    """Looks at the NC whenever it is asked, and remembers what has changed."""

    def __init__(self, nc: SimulatedNc, config: CncConfig, *, port: int | None = None) -> None:
        """`port` None takes the configured one, 0 any free one."""
        self._nc = nc
        section = config.connection_as(MtconnectConfig)
        super().__init__(section.port if port is None else port)
        self.instance = 1
        self.available = True
        """False: its adapter has lost the control."""
        self._next = 1
        self._known: dict[str, str] = {}
        self._buffer: deque[tuple[int, str, str]] = deque(maxlen=BUFFER)

    @property
    def endpoint(self) -> str:
        """Where clients find it (known after start)."""
        return f"http://{super().endpoint}"

    async def _listen(self, port: int) -> asyncio.Server:
        return await asyncio.start_server(self._serve, HOST, port)

    def restart(self) -> None:
        """Begin anew as another instance, with nothing remembered."""
        self.instance += 1
        self._next = 1
        self._known.clear()
        self._buffer.clear()

    def look(self) -> None:
        """Take the NC's state, as an adapter does that is asked now."""
        for item, (_, _, _, shown) in ITEMS.items():
            text = shown(self._nc) if self.available else "UNAVAILABLE"
            if self._known.get(item) != text:
                self._known[item] = text
                self._buffer.append((self._next, item, text))
                self._next += 1

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections.add(writer.transport)
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            self.look()
            body = self._answer(head.split(b" ", 2)[1].decode("ascii", "replace")).encode()
            fields = f"Content-Type: text/xml\r\nContent-Length: {len(body)}\r\nConnection: close\r\n"
            writer.write(f"HTTP/1.1 200 OK\r\n{fields}\r\n".encode() + body)
            await writer.drain()
            writer.close()
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, ConnectionError, IndexError):
            writer.transport.abort()
        finally:
            self.connections.discard(writer.transport)

    def _answer(self, target: str) -> str:
        url = urlsplit(target)
        asked = url.path.rpartition("/")[2]
        if asked == "probe":
            return self._probe()
        if asked == "current":
            return self._streams([(self._next - 1, item, text) for item, text in self._known.items()], self._next)
        if asked == "sample":
            return self._sample(parse_qs(url.query))
        return self._error("UNSUPPORTED", f"nothing lies at {target}")

    def _sample(self, query: dict[str, list[str]]) -> str:
        begin, count = int(query.get("from", ["0"])[0]), int(query.get("count", ["100"])[0])
        first = self._buffer[0][0] if self._buffer else self._next
        if not first <= begin <= self._next:
            return self._error("OUT_OF_RANGE", f"'from' must be between {first} and {self._next}")
        found = [each for each in self._buffer if each[0] >= begin][:count]
        return self._streams(found, found[-1][0] + 1 if found else begin)

    def _header(self, following: int) -> str:
        first, last = (self._buffer[0][0], self._buffer[-1][0]) if self._buffer else (0, 0)
        now = datetime.now(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
        numbers = f'firstSequence="{first}" lastSequence="{last}" nextSequence="{following}"'
        return (
            f'<Header creationTime="{now}" sender="simulated" instanceId="{self.instance}" version="1.8.0" '
            f'bufferSize="{BUFFER}" {numbers}/>'
        )

    def _probe(self) -> str:
        items = "".join(
            f'<DataItem id="{item}" type="{kind}" category="{category.upper()}"'
            + (f' subType="{subtype}"' if subtype else "")
            + (' units="MILLIMETER" coordinateSystem="MACHINE"' if kind == "POSITION" else "")
            + "/>"
            for item, (kind, subtype, category, _) in ITEMS.items()
        )
        device = f'<Device id="d" name="{DEVICE}" uuid="{UUID}"><DataItems>{items}</DataItems></Device>'
        schema = SCHEMA.format("MTConnectDevices")
        content = f"{self._header(self._next)}<Devices>{device}</Devices>"
        return f'{HEAD}<MTConnectDevices xmlns="{schema}">{content}</MTConnectDevices>'

    def _streams(self, observations: list[tuple[int, str, str]], following: int) -> str:
        parts: dict[str, list[str]] = {"Event": [], "Sample": [], "Condition": []}
        for sequence, item, shown in observations:
            text = shown
            kind, _, category, _ = ITEMS[item]
            name = "".join(word.capitalize() for word in kind.split("_"))
            fields = f'dataItemId="{item}" sequence="{sequence}" timestamp="2026-11-22T00:00:00Z"'
            if category == "Condition":
                name, text = (text.capitalize(), "")
                fields += f" type={quoteattr(kind)}"
            parts[category].append(f"<{name} {fields}>{escape(text)}</{name}>")
        groups = zip(("Events", "Samples", "Condition"), ("Event", "Sample", "Condition"), strict=True)
        content = "".join(f"<{name}>{''.join(parts[part])}</{name}>" for name, part in groups if parts[part])
        component = f'<ComponentStream component="Path" componentId="p">{content}</ComponentStream>'
        device = f'<DeviceStream name="{DEVICE}" uuid="{UUID}">{component}</DeviceStream>'
        schema = SCHEMA.format("MTConnectStreams")
        whole = f"{self._header(following)}<Streams>{device}</Streams>"
        return f'{HEAD}<MTConnectStreams xmlns="{schema}">{whole}</MTConnectStreams>'

    def _error(self, code: str, words: str) -> str:
        schema = SCHEMA.format("MTConnectError")
        error = f'<Errors><Error errorCode="{code}">{escape(words)}</Error></Errors>'
        return f'{HEAD}<MTConnectError xmlns="{schema}">{self._header(self._next)}{error}</MTConnectError>'
