"""The simulated machine as a daemon on virtual time sees it: bytes on lines, answers of a CNC, the hour.

The machine lives in another process, which owns time. The two exchange messages in turn over a socket pair: the
daemon's side asks, the machine's side answers. Every answer says until when nothing will happen by
itself, so that the daemon's side need not ask before.
"""

import asyncio
import marshal
import math
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from config.schema.temperatures import LineConfig
from daemon.simulation.faults.virtual_time import VirtualClock
from drivers.contract import LinkError
from drivers.latsis.reader import ByteInbox

LONGEST_MESSAGE = 1 << 17


class Channel:
    """One end of the pair; messages are tuples of plain values."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * LONGEST_MESSAGE)

    def send(self, message: tuple[Any, ...]) -> None:
        """Send one message; raises OSError when the other side is gone."""
        self._end.send(marshal.dumps(message))

    def receive(self) -> tuple[Any, ...] | None:
        """Wait for one message; None when the other side is gone."""
        try:
            data = self._end.recv(LONGEST_MESSAGE)
        except ConnectionResetError:
            return None
        if not data:
            return None
        message: tuple[Any, ...] = marshal.loads(data)
        return message

    def close(self) -> None:
        self._end.close()


def channel_pair() -> tuple[Channel, socket.socket]:
    """Return the machine's end, and the socket that the daemon's process inherits."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return Channel(near), far


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What the CNC's side says to a call."""

    verdict: str
    """ok, lost, silent or refused."""
    delay_s: float
    content: Any


class VirtualWorld:
    """The daemon's side of the pair; implements `daemon.simulation.faults.virtual_time.World`."""

    def __init__(
        self,
        channel: Channel,
        clock: VirtualClock,
        *,
        claims: Callable[[], tuple[Any, ...]],
        hold: Callable[[], bool] = lambda: False,
    ) -> None:
        """Prepare; `claims` returns what the daemon says of itself, which goes along with every message."""
        self._channel = channel
        self._clock = clock
        self._claims = claims
        self._hold = hold
        self._quiet_until_s = -math.inf
        self._readers: dict[str, VirtualReader] = {}
        self._connected = False

    def hold(self) -> bool:
        """Tell whether time must wait for the computer."""
        return self._hold()

    def enter(self) -> None:
        """Say that the daemon is there; time is from now on the machine's."""
        self._exchange("enter")

    def pass_time(self, timeout_s: float | None) -> None:
        """Move on to the next timer, or to the next event of the machine if that comes first."""
        until_s = math.inf if timeout_s is None else self._clock.monotonic_s + timeout_s
        if until_s < self._quiet_until_s:
            self._clock.monotonic_s = until_s
        else:
            self._exchange("advance", until_s)

    def call(self, name: str, *arguments: Any) -> Answer:
        """Ask the CNC something."""
        verdict, delay_s, content = self._exchange(name, *arguments)
        return Answer(verdict=verdict, delay_s=delay_s, content=content)

    def listen(self, line: str, reader: "VirtualReader") -> bool:
        """Open a line for a reader; False when its port is not there."""
        if not self._exchange("listen", line):
            return False
        self._readers[line] = reader
        return True

    def leave(self, line: str, reader: "VirtualReader") -> None:
        if self._readers.get(line) is reader:
            del self._readers[line]
            self._exchange("leave", line)

    def _exchange(self, name: str, *arguments: Any) -> Any:
        self._channel.send((name, self._clock.monotonic_s, self._claims(), arguments))
        answer = self._channel.receive()
        if answer is None:
            raise SystemExit("the simulated machine is gone")
        self._clock.monotonic_s, self._quiet_until_s, self._clock.utc_step_s, arrivals, content = answer
        for at_s, line, data in arrivals:
            if at_s <= self._clock.monotonic_s:
                self._deliver(line, data)
            else:
                asyncio.get_running_loop().call_at(at_s, self._deliver, line, data)
        return content

    def _deliver(self, line: str, data: bytes | None) -> None:
        reader = self._readers.get(line)
        if reader is not None:
            reader.deliver(data)


class VirtualReader:
    """Brings the bytes of a simulated line; implements `drivers.latsis.reader.LineReader`."""

    def __init__(self, world: VirtualWorld, line: LineConfig, clock: VirtualClock) -> None:
        self._world = world
        self._line = line
        self._clock = clock
        self._inbox: ByteInbox | None = None

    def start(self, inbox: ByteInbox) -> None:
        self._inbox = inbox
        if not self._world.listen(self._line.name, self):
            inbox.fail(LinkError(f"line {self._line.name}: port {self._line.port} does not exist: plug the adapter in"))
            inbox.wake()

    async def stop(self) -> None:
        self._world.leave(self._line.name, self)

    def deliver(self, data: bytes | None) -> None:
        """Take bytes that have just arrived; None when the adapter was pulled out."""
        inbox = self._inbox
        if inbox is None:
            return
        if data is None:
            inbox.fail(LinkError(f"line {self._line.name}: port {self._line.port} went away (unplugged?)"))
        else:
            inbox.put(data, self._clock.now())
        inbox.wake()
