"""Serves temperatures, estimate, compensation and state to an MTConnect agent, as an SHDR adapter (text over TCP).

The agent connects, gets everything, then every second what has changed since. It is never read from, but for its PING.
"""

import asyncio
import math
import socket
from collections.abc import Callable
from datetime import UTC, datetime

import structlog

from config.schema import Configuration
from daemon.monitor.arrival import too_old
from daemon.monitor.connections import BoundedConnections, Conversation
from daemon.monitor.listening import in_url, listening
from daemon.snapshots import SnapshotBoard
from models.quality import Quality
from models.records import OutputState

log = structlog.get_logger(__name__)
MOST_CONNECTIONS = 4
PERIOD_S = 1.0
"""What has changed is sent this often [s]."""
HEARTBEAT_MS = 10_000
"""The agent shall ask this often whether we live [ms]."""
SILENT_S = 60.0
"""An agent that has asked once, and then does not for so long, is gone [s]."""
PATIENCE_S = 10.0
"""What is sent must be taken within this [s]."""
MOST_UNSENT = 65_536
LONGEST_LINE = 1024
UNAVAILABLE = "UNAVAILABLE"
NUMBERS = ("estimated", "requested", "written", "applied")


class ShdrAdapter:
    """Makes the lines from the snapshots."""

    def __init__(self, configuration: Configuration, board: SnapshotBoard) -> None:
        self._configuration, self._board = configuration, board
        self._slopes = {*configuration.compensation.slopes, *configuration.compensation.slope_channels}

    async def serve(self, on_serving: Callable[[], None] = lambda: None) -> None:
        """Serve until cancelled; raises OSError when the port is taken."""
        section = self._configuration.shdr
        assert section is not None
        with listening(section.host, section.port, MOST_CONNECTIONS) as listener:
            log.info("shdr.serving", address=in_url(section.host, listener.getsockname()[1]))
            on_serving()
            await BoundedConnections("SHDR adapter", self._converse, most=MOST_CONNECTIONS).run(listener)

    async def _converse(self, connection: socket.socket, conversation: Conversation) -> None:
        reader, writer = await asyncio.open_connection(sock=connection, limit=LONGEST_LINE)
        asked = asyncio.create_task(_answer(reader, writer, conversation))
        told = asyncio.create_task(self._tell(writer))
        try:
            await asyncio.wait([asked, told], return_when=asyncio.FIRST_COMPLETED)
            for task in (asked, told):
                if task.done():
                    task.result()
        finally:
            for task in (asked, told):
                task.cancel()
            await asyncio.gather(asked, told, return_exceptions=True)
            writer.transport.abort()

    async def _tell(self, writer: asyncio.StreamWriter) -> None:
        """Send what has changed; while the agent does not take it, the newest waits, and nothing is queued."""
        known: dict[str, str] = {}
        while True:
            if writer.transport.get_write_buffer_size() < MOST_UNSENT:
                present = self.present()
                for gone in known.keys() - present.keys():  # such as the channel of a model that is no more in use
                    present[gone] = (_time(math.nan), UNAVAILABLE)
                lines = [f"{time}|{key}|{text}\n" for key, (time, text) in present.items() if known.get(key) != text]
                known = {key: text for key, (_, text) in present.items()}
                writer.write("".join(lines).encode())
            async with asyncio.timeout(PATIENCE_S):
                await writer.drain()
            await asyncio.sleep(PERIOD_S)

    def present(self) -> dict[str, tuple[str, str]]:
        """Return key -> time and text of everything; a value that may not be used is UNAVAILABLE."""
        thermal, control = self._board.thermal, self._board.control
        found: dict[str, tuple[str, str]] = {}
        latest, old = thermal.temperatures, too_old(thermal, self._configuration)
        for i, sensor in enumerate(self._configuration.temperatures.every_sensor):
            usable = latest is not None and latest.quality[i] == Quality.GOOD and not old
            time_s = math.nan if latest is None else latest.trace.last_byte.utc_s - float(latest.age_s[i])
            degc = float(latest.degc[i]) if latest is not None and usable else math.nan
            found[f"temperature_{sensor.id}"] = (_time(time_s), _number(degc))
        estimate = thermal.estimate
        if estimate is not None:
            at = _time(estimate.trace.last_byte.utc_s)
            for i, channel in enumerate(estimate.channels):
                found[f"estimate_{_key(channel)}{self._unit(channel)}"] = (
                    at,
                    _number(math.nan if old else float(estimate.thermal_error_um[i])),
                )
            found["confidence"] = (at, _number(math.nan if old else estimate.confidence))
        now = _time(math.nan)
        columns = (control.thermal_error_um, control.requested_um, control.written_um, control.applied_um)
        for name, column in zip(NUMBERS, columns, strict=True):
            for i, axis in enumerate(control.axes):
                found[f"{axis}_{name}{self._unit(axis)}"] = (now, _number(float(column[i])))
        found["avail"] = (now, "AVAILABLE")
        found["output_state"] = (now, control.state.value)
        found["output_reason"] = (now, _text(control.reason))
        found["compensation"] = (now, _condition(control.state, control.alarm))
        return found

    def _unit(self, name: str) -> str:
        """Return how the key of an axis or channel ends."""
        return "_um_per_m" if name in self._slopes else "_um"


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, conversation: Conversation) -> None:
    """Answer the agent's PING until it goes; who has asked once must go on asking."""
    patience_s: float | None = None
    while True:
        async with asyncio.timeout(patience_s):
            line = await reader.readline()
        if not line:
            return
        if line.strip() == b"* PING":
            patience_s = SILENT_S
            with conversation.request():
                writer.write(f"* PONG {HEARTBEAT_MS}\n".encode())


def _time(utc_s: float) -> str:
    when = datetime.fromtimestamp(utc_s, UTC) if math.isfinite(utc_s) else datetime.now(UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _number(value: float) -> str:
    return f"{value:.4g}" if abs(value) < 1.0 else f"{value:.3f}" if math.isfinite(value) else UNAVAILABLE


def _text(text: str) -> str:
    """Return a text on one line, without the character that ends a field."""
    return " ".join(text.replace("|", "/").split()) or UNAVAILABLE


def _key(name: str) -> str:
    return "".join(each if each.isalnum() else "_" for each in name)


def _condition(state: OutputState, alarm: str) -> str:
    """Return the state of the condition: level, code (an agent adds another to those that are active), text."""
    if state is not OutputState.FAULT and not alarm:
        return "NORMAL||||"
    level = "FAULT" if state is OutputState.FAULT else "WARNING"
    return f"{level}|OUTPUT|||{_text(alarm) if alarm else state.value}"
