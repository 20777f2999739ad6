"""The LATSIS lines of a simulated machine on pseudo-terminals; the owner moves them on by `step`, nothing sleeps."""

import contextlib
import math
import os
import pty
import select
import termios
import tty
from collections.abc import Callable, Sequence
from pathlib import Path

from config.schema.temperatures import TemperaturesConfig
from drivers.sim.contract import SimulatedMachine
from drivers.sim.faults import Fault
from drivers.sim.wires.latsis_encoding import LineTransmitter

PHASE_STEP = 0.381966
"""Share of the period by which each line starts after the one before it: never in step, never far apart."""
Passed = Callable[[str, float, float], None]


MAX_BACKLOG_BYTES = 1 << 18
"""More than this waiting for a slow reader is an overrun: it is dropped."""


class PtyPort:
    """The far end of a simulated serial port; the near end is opened under the name `link`."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.bytes_dropped = 0
        """Bytes lost to a reader that was absent or too slow."""
        self._master: int | None = None
        self._device = ""
        self._backlog = bytearray()
        self._poll = select.poll()

    @property
    def plugged(self) -> bool:
        return self._master is not None

    @property
    def descriptor(self) -> int:
        """The far end, while the port exists."""
        assert self._master is not None
        return self._master

    def plug(self) -> None:
        """Make the port appear under its name."""
        if self._master is not None:
            return
        self._master, near = pty.openpty()
        tty.setraw(near)
        self._device = os.ttyname(near)
        os.close(near)
        os.set_blocking(self._master, False)
        self._poll.register(self._master, select.POLLOUT)
        fresh = self.link.with_name(f".{self.link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._device)
        fresh.replace(self.link)

    def unplug(self) -> None:
        """Make the port vanish; a reader gets a hang-up. Does nothing when it is not there."""
        if self._master is None:
            return
        with contextlib.suppress(OSError):
            if self.link.readlink() == Path(self._device):
                self.link.unlink()
        self._poll.unregister(self._master)
        os.close(self._master)
        self._master = None
        self._drop()

    def write(self, data: bytes) -> None:
        """Send bytes without ever waiting; what a present reader cannot take yet is kept for the next call."""
        self._backlog += data
        if self._master is None:
            self._drop()
        elif any((events & select.POLLHUP for _, events in self._poll.poll(0))):
            termios.tcflush(self._master, termios.TCOFLUSH)
            self._drop()
        elif self._backlog:
            self._send(self._master)

    def _send(self, master: int) -> None:
        with contextlib.suppress(BlockingIOError):
            del self._backlog[: os.write(master, self._backlog)]
        if len(self._backlog) > MAX_BACKLOG_BYTES:
            self._drop()

    def _drop(self) -> None:
        self.bytes_dropped += len(self._backlog)
        self._backlog.clear()


class LatsisWires:
    """All lines of one machine."""

    def __init__(
        self,
        machine: SimulatedMachine,
        config: TemperaturesConfig,
        directory: Path,
        *,
        first_pass_s: float | None = None,
        until_s: float = math.inf,
        faults: Sequence[Fault] = (),
        seed: int = 0,
    ) -> None:
        first_s = machine.time_s if first_pass_s is None else first_pass_s
        devices: dict[int, str] = {sensor.id: sensor.device for sensor in config.sensors}
        self._lines = {
            line.name: (
                LineTransmitter(
                    line,
                    devices,
                    machine.register_codes,
                    phase_s=first_s + index * PHASE_STEP % 1 * line.cycle_period_s,
                    until_s=until_s,
                    faults=faults,
                    seed=seed,
                ),
                PtyPort(directory / f"{line.name}.tty"),
            )
            for index, line in enumerate(config.lines)
        }

    @property
    def cycles_sent(self) -> dict[str, int]:
        """Passes that went out whole, by line."""
        return {name: transmitter.cycles_sent for name, (transmitter, _) in self._lines.items()}

    @property
    def cycles_disturbed(self) -> dict[str, int]:
        """Passes that a fault touched, by line."""
        return {name: transmitter.cycles_disturbed for name, (transmitter, _) in self._lines.items()}

    @property
    def idle(self) -> bool:
        """No line has a pass under way."""
        return all(transmitter.idle for transmitter, _ in self._lines.values())

    @property
    def bytes_dropped(self) -> dict[str, int]:
        """Bytes lost to an absent or slow reader, by line."""
        return {name: port.bytes_dropped for name, (_, port) in self._lines.items()}

    def link(self, line: str) -> Path:
        """Return the name under which a line's port appears."""
        return self._lines[line][1].link

    def open(self) -> None:
        """Make all ports appear, and their directory."""
        for _, port in self._lines.values():
            port.link.parent.mkdir(parents=True, exist_ok=True)
            port.plug()

    @property
    def next_start_s(self) -> float:
        """When the next pass of any line reads its registers [s of the machine]."""
        return min((transmitter.next_start_s for transmitter, _ in self._lines.values()), default=math.inf)

    def step(self, now_s: float, passed: Passed | None = None) -> None:
        """Send what is due at a simulated time [s], adapters pulled and plugged; `passed` hears of each pass."""
        for name, (transmitter, port) in self._lines.items():
            before = transmitter.last_pass_s
            due = transmitter.advance(now_s)
            if passed is not None and transmitter.last_pass_s not in (None, before):
                passed(name, *transmitter.last_pass_s)
            if not transmitter.plugged(now_s):
                port.unplug()
                continue
            port.plug()
            port.write(due)

    def close(self) -> None:
        """Make all ports vanish. May be called more than once."""
        for _, port in self._lines.values():
            port.unplug()
