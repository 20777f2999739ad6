"""One LATSIS line on a serial port: a reader and the assembler of its cycles."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.clock import Clock
from drivers.contract import LinkError
from drivers.latsis.cycle import MIN_SILENCE_REAL_S, SILENCE_PERIODS, CycleAssembler
from drivers.latsis.reader import BITS_PER_BYTE, LineReader, PortReader
from models.records import Instant, TemperatureCycle

DEAD_LINE_PERIODS = 3.0
"""Without a frame for so many cycle periods the line is given up, to be opened anew."""
MIN_DEAD_LINE_REAL_S = 2.0
"""But never sooner than this, even on a fast simulated clock."""
CHECK_MARGIN_REAL_S = 0.001
"""A check for silence comes this much after the silence is long enough."""
MIN_CHECK_REAL_S = 0.02
"""Checks never follow each other faster than this."""
MAX_BACKLOG_BYTES = 1 << 18
"""Bytes that may wait for the consumer (20 s at 115200 baud); what comes beyond is dropped and told."""
TORN = b"\x00"
"""Stands for the last byte that was dropped: no grammar has it, so no frame is put together across the gap."""


class LatsisSerialSource:
    """A LATSIS line (`drivers.contract.TemperatureSource`), to be used once.

    Time-outs of the protocol are seconds of the given clock. The reader alone touches the port: it opens
    it, stamps the bytes as soon as they are read, and closes it.
    """

    def __init__(
        self, line: LineConfig, sensors: Sequence[SensorConfig], clock: Clock, *, reader: LineReader | None = None
    ) -> None:
        """Prepare the source; `reader` brings the bytes, by default from the line's port."""
        self.name = line.name
        self._line = line
        self._clock = clock
        self._dead_line_s = DEAD_LINE_PERIODS * line.cycle_period_s
        self._assembler = CycleAssembler(line, sensors)
        self._inbox: deque[tuple[bytes, Instant] | Exception] = deque()
        self._bytes_put = self._bytes_taken = 0
        self._dropped = 0
        self._dropped_told = 0
        self._torn = False
        self.earliest_end = 0
        """Byte of the stream before which the cycle under way, or the next one, cannot be complete."""
        self._last_frame = self._last_bytes = clock.now()
        self._wake = asyncio.Event()
        self._check_due = False
        self._pass_check: asyncio.TimerHandle | None = None
        self._line_check: asyncio.TimerHandle | None = None
        self._reader = PortReader(line, clock) if reader is None else reader
        self._started = False
        self._closed = False

    async def cycles(self) -> AsyncIterator[TemperatureCycle]:
        """Open the line and yield each cycle as it completes; raises LinkError when the line is lost."""
        self._start()
        try:
            while not self._closed:
                while self._inbox:
                    for cycle in self._take(self._inbox.popleft()):
                        yield self._with_dropped(cycle)
                    if self._inbox:
                        await asyncio.sleep(0)  # a line that brings much leaves the loop to the others
                for cycle in self._check():
                    yield cycle
                self._watch_pass()
                await self._wake.wait()
                self._wake.clear()
        finally:
            await self.close()

    async def close(self) -> None:
        """Release the port and end the reader thread. May be called in any state, more than once."""
        self._closed = True
        self._wake.set()
        for timer in (self._pass_check, self._line_check):
            if timer is not None:
                timer.cancel()
        if self._started:
            await self._reader.stop()

    # --- what the reader calls, from its own thread ---------------------------

    def put(self, data: bytes, arrived: Instant) -> bool:
        """Queue bytes; return False when they were dropped because too many wait."""
        if self._bytes_put - self._bytes_taken > MAX_BACKLOG_BYTES:
            self._dropped += len(data)
            self._torn = True
            return False
        if self._torn:
            data, self._torn = TORN + data[1:], False
            self._dropped += 1
        self._bytes_put += len(data)
        self._inbox.append((data, arrived))
        return True

    def fail(self, error: Exception) -> None:
        """Queue what went wrong: it is raised again in `cycles`, after the bytes before it."""
        self._inbox.append(error)

    def wake(self) -> None:
        """Have the queue looked at; to be called in the event loop."""
        self._wake.set()

    def _start(self) -> None:
        if self._closed or self._started:
            raise RuntimeError(f"line {self.name}: a source is used once; build a new one to open the line again")
        loop = asyncio.get_running_loop()
        self._last_frame = self._last_bytes = self._clock.now()
        self._started = True
        self._reader.start(self)
        self._on_line_timer(loop)

    def _on_line_timer(self, loop: asyncio.AbstractEventLoop) -> None:
        """Have the line checked, and again after a cycle period, or when it is silent for too long before that."""
        self._check_due = True
        self._wake.set()
        now = self._clock.now()
        left_s = self._dead_line_s - (now.monotonic_s - self._last_frame.monotonic_s)
        left_real_s = max(left_s / self._clock.speed, MIN_DEAD_LINE_REAL_S - (now.real_s - self._last_frame.real_s))
        delay_s = self._line.cycle_period_s / self._clock.speed
        delay_s = min(delay_s, left_real_s + CHECK_MARGIN_REAL_S) if left_real_s > 0 else delay_s
        self._line_check = loop.call_later(max(delay_s, MIN_CHECK_REAL_S), self._on_line_timer, loop)

    def _on_pass_timer(self) -> None:
        """Have the pass under way checked."""
        self._pass_check = None
        self._check_due = True
        self._wake.set()

    def _watch_pass(self) -> None:
        """See to it that a pass is checked once the line has been silent for long enough."""
        quiet_since = self._assembler.quiet_since
        if quiet_since is None or self._pass_check is not None or self._closed:
            return
        now = self._clock.now()
        left_s = SILENCE_PERIODS * self._line.cycle_period_s - (now.monotonic_s - quiet_since.monotonic_s)
        left_real_s = max(left_s / self._clock.speed, MIN_SILENCE_REAL_S - (now.real_s - quiet_since.real_s))
        delay_s = max(left_real_s + CHECK_MARGIN_REAL_S, MIN_CHECK_REAL_S)
        self._pass_check = asyncio.get_running_loop().call_later(delay_s, self._on_pass_timer)

    def _take(self, item: tuple[bytes, Instant] | Exception) -> list[TemperatureCycle]:
        if isinstance(item, Exception):
            # What had arrived is delivered first; the error follows when the consumer comes back.
            if cycles := self._assembler.finish():
                self._inbox.appendleft(item)
                return cycles
            raise item
        data, arrived = item
        if stood_s := self._overdue_s(arrived):  # the timer has given up a line that was silent for so long already
            if arrived.monotonic_s - self._last_bytes.monotonic_s <= self._dead_line_s:
                raise LinkError(self._why_dead(arrived, stood_s))
            raise LinkError(
                f"line {self.name}: this computer stood still for up to {stood_s:.0f} s, and nobody knows how old "
                "is what came meanwhile: see what stopped the daemon (a debugger, memory, a paused virtual machine)"
            )
        self._bytes_taken += len(data)
        frames = self._assembler.frames
        cycles = self._assembler.feed(data, arrived)
        self.earliest_end = self._assembler.earliest_end
        self._last_bytes = arrived
        if self._assembler.frames > frames:
            self._last_frame = arrived
        return cycles

    def _with_dropped(self, cycle: TemperatureCycle) -> TemperatureCycle:
        """Return a cycle that says how many bytes were dropped since the one before it."""
        dropped = self._dropped
        lost, self._dropped_told = dropped - self._dropped_told, dropped
        if not lost:
            return cycle
        words = (
            f"line {self.name}: {lost} bytes dropped, it brings more than can be taken "
            f"(at {self._line.baud} baud at most {self._line.baud // BITS_PER_BYTE} a second): "
            "check what is connected to the port, and the load of this computer"
        )
        return replace(cycle, faults=(words, *cycle.faults))

    def _check(self) -> list[TemperatureCycle]:
        """Look for silence: the end of a pass, or of the line."""
        if not self._check_due:
            return []
        self._check_due = False
        now = self._clock.now()
        if quiet_s := self._overdue_s(now):
            self._inbox.append(LinkError(self._why_dead(now, quiet_s)))
            self._wake.set()
        return self._assembler.poll(now)

    def _overdue_s(self, now: Instant) -> float:
        """Return for how long no frame has come, where that is too long [s]; else 0."""
        quiet_s = now.monotonic_s - self._last_frame.monotonic_s
        real_s = now.real_s - self._last_frame.real_s
        return quiet_s if quiet_s > self._dead_line_s and real_s > MIN_DEAD_LINE_REAL_S else 0.0

    def _why_dead(self, now: Instant, quiet_s: float) -> str:
        where = f"line {self.name}: port {self._line.port}"
        if now.monotonic_s - self._last_bytes.monotonic_s > self._dead_line_s:
            return (
                f"{where} has been silent for {quiet_s:.0f} s: check the cable and the power of the nodes "
                f"(a pass is expected every {self._line.cycle_period_s:g} s)"
            )
        return (
            f"{where} has delivered bytes but no frame for {quiet_s:.0f} s "
            f"({self._assembler.last_error or 'no line end'}): check `baud` ({self._line.baud}) "
            f"and the frame grammar (profile {self._line.profile})"
        )
