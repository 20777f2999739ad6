"""A simulated Modbus box on a pseudo-terminal, for tests of RTU over a serial port."""

import asyncio
import contextlib
import os
from pathlib import Path

from drivers.sim.wires.latsis_wire import PtyPort
from drivers.sim.wires.modbus_box import LONGEST_FRAME, RTU_REQUEST_BYTES, Contents, Way, at_once, rtu_answer


class ModbusPtyBox:
    """Answers on a pseudo-terminal."""

    def __init__(self, contents: Contents, link: Path, *, way: Way = at_once, echo: bool = False) -> None:
        """`echo`: the master hears its own requests too, as with many adapters for two wires."""
        self._contents, self._echo = contents, echo
        self.way = way
        self._port = PtyPort(link)
        self._master: int | None = None
        self._received = bytearray()
        self.requests = 0

    def start(self) -> None:
        """Make the port appear and answer on it."""
        self._port.plug()
        self._master = self._port.descriptor
        asyncio.get_running_loop().add_reader(self._master, self._on_bytes)

    def stop(self) -> None:
        """Make the port vanish."""
        if self._master is not None:
            asyncio.get_running_loop().remove_reader(self._master)
            self._master = None
            self._port.unplug()

    def send(self, data: bytes) -> None:
        """Put bytes on the line."""
        if self._master is not None:
            with contextlib.suppress(OSError):
                os.write(self._master, data)

    def _on_bytes(self) -> None:
        assert self._master is not None
        try:
            received = os.read(self._master, LONGEST_FRAME)
        except OSError:  # nobody has it open: look again when somebody does
            asyncio.get_running_loop().remove_reader(self._master)
            asyncio.get_running_loop().call_later(0.01, self._listen_again)
            return
        self._received += received
        if self._echo:
            self.send(received)
        while len(self._received) >= RTU_REQUEST_BYTES:
            frame = bytes(self._received[:RTU_REQUEST_BYTES])
            if answer := rtu_answer(frame, self._contents):
                del self._received[:RTU_REQUEST_BYTES]
                self.requests += 1
                self.way(answer, self.send)
            else:
                del self._received[:1]

    def _listen_again(self) -> None:
        if self._master is not None:
            asyncio.get_running_loop().add_reader(self._master, self._on_bytes)
