"""The simulated machine as a daemon on virtual time sees it: bytes on lines, answers of a CNC, the hour.

The machine lives in another process, which owns time: this side asks, that side answers and says until when nothing
will happen by itself. The loop's clock stands still while callbacks, sockets or threads have work.
"""

import asyncio
import marshal
import math
import selectors
import socket
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from config.schema.temperatures import LineConfig
from drivers.contract import LinkError
from drivers.latsis.reader import ByteInbox
from models.records import Instant

LONGEST_MESSAGE = 1 << 17


THREAD_PATIENCE_S = 0.05
"""While a thread works, sockets are looked at this often [s of the wall clock]; its end wakes the loop at once."""

ROUNDS_PER_LOOK = 8
"""While callbacks wait for their turn, sockets are looked at once in so many rounds of the loop."""

T = TypeVar("T")


class VirtualClock:
    """Implements `drivers.clock.Clock`; moved on by the world, and its calendar may be set both ways."""

    speed = 1.0

    def __init__(self, *, epoch_utc_s: float, monotonic_s: float = 0.0) -> None:
        self.epoch_utc_s = epoch_utc_s
        self.monotonic_s = monotonic_s
        self.utc_step_s = 0.0
        """By how much the calendar clock was set forward [s]."""
        self._now = Instant(monotonic_s=math.nan, utc_s=math.nan, real_s=math.nan)

    def now(self) -> Instant:
        """Return the moment; what would be the computer's own monotonic clock is virtual too."""
        utc_s = self.epoch_utc_s + self.utc_step_s + self.monotonic_s
        if self._now.monotonic_s != self.monotonic_s or self._now.utc_s != utc_s:  # asked many times a moment
            self._now = Instant(monotonic_s=self.monotonic_s, utc_s=utc_s, real_s=self.monotonic_s)
        return self._now

    async def sleep(self, duration_s: float) -> None:
        await asyncio.sleep(max(0.0, duration_s))


class World(Protocol):
    """What moves time on."""

    def pass_time(self, timeout_s: float | None) -> None:
        """Move the clock on by at most `timeout_s` (None: to whatever comes next) and deliver what happens then."""

    def hold(self) -> bool:
        """Tell whether time must wait for the computer (a disk that is behind, for instance)."""


class _VirtualSelector(selectors.DefaultSelector):
    """Looks at sockets without waiting; where a loop would wait, virtual time passes."""

    def __init__(self) -> None:
        super().__init__()
        self.world: World | None = None
        self.threads_busy = 0
        self._rounds = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return sockets that are ready; pass time when none is and nothing else is to be done."""
        if timeout is not None and timeout <= 0:
            self._rounds = (self._rounds + 1) % ROUNDS_PER_LOOK
            return [] if self._rounds else super().select(0)
        if ready := super().select(0):
            return ready
        if self.world is None or self.threads_busy:
            return super().select(THREAD_PATIENCE_S)
        if self.world.hold():
            return super().select(THREAD_PATIENCE_S / 10)
        self.world.pass_time(timeout)
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop on a virtual clock. Work given to threads stops time until it is done."""

    def __init__(self, clock: VirtualClock) -> None:
        self._virtual_clock = clock
        self._virtual_selector = _VirtualSelector()
        super().__init__(self._virtual_selector)

    def inhabit(self, world: World | None) -> None:
        """Let time be moved on by this world; without one none passes."""
        self._virtual_selector.world = world

    def time(self) -> float:
        """Return the loop's time [s]: the clock's monotonic one."""
        return self._virtual_clock.monotonic_s

    def run_in_executor(  # type: ignore[override]
        self, executor: Executor | None, func: Callable[..., T], *args: Any
    ) -> asyncio.Future[T]:
        """Run a function in a thread; no time passes meanwhile."""
        self._virtual_selector.threads_busy += 1
        future: asyncio.Future[T] = super().run_in_executor(executor, func, *args)
        future.add_done_callback(self._on_thread_done)
        return future

    def _on_thread_done(self, _: object) -> None:
        self._virtual_selector.threads_busy -= 1


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
    """The daemon's side of the pair; implements `daemon.simulation.faults.virtual_world.World`."""

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
