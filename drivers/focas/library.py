"""The CNC through FANUC's own FOCAS2 library, at a path that the configuration gives: never loaded into the daemon.

A child process loads it and answers the same blocks as a control does, so everything above them is the other client's.
A library that crashes or hangs ends its process: that is a lost link.
"""

import sys
from collections.abc import Sequence
from importlib.resources import files
from typing import ClassVar

from config.schema.cnc import CncConfig
from drivers.bridge_link import BridgeError, BridgeLink
from drivers.clock import Clock
from drivers.contract import Capability, FatalDriverError, LinkError
from drivers.focas.cnc import FocasCnc
from drivers.focas.codec import Answer, Ask
from drivers.linked_cnc import LinkedCnc

NOT_ASKED = "FANUC's library is not asked for {}: leave cnc.focas.library out to read it"
WHEN_IT_ENDS = "if it happens again, cnc.focas.library does not fit this computer: leave it out"


class LibraryFocasCnc(FocasCnc):
    """Implements `drivers.contract.Cnc` over the library; the bridge matches its answers, so they need no tag."""

    wrong_answers: ClassVar[tuple[type[Exception], ...]] = (
        *FocasCnc.wrong_answers,
        BridgeError,
        KeyError,
        TypeError,
        ValueError,
    )
    tag_bits = 0
    _link: BridgeLink | None  # type: ignore[assignment]

    def __init__(self, config: CncConfig, clock: Clock) -> None:
        super().__init__(config, clock)
        self._doubles = False

    async def close(self) -> None:
        """End the process; never raises, never waits longer than the time-out."""
        await LinkedCnc.close(self)

    async def _connect(self) -> None:
        text = files("drivers.focas").joinpath("library_bridge.py").read_text(encoding="utf-8")
        command = [sys.executable, "-I"]
        self._link = await BridgeLink.start(command, text, self._name, WHEN_IT_ENDS)
        first = await self._link.ask(
            library=str(self._focas.library),
            host=self._focas.host,
            port=self._focas.port,
            path=self._focas.path,
            timeout_s=self._config.timeout_s,
        )
        if "fatal" in first:
            raise FatalDriverError(f"cnc.focas.library: {self._focas.library} {first['fatal']}")
        await self._introduced()
        assert self._state is not None
        self._state.cannot[Capability.MOTOR_TEMPERATURE] = NOT_ASKED.format("a diagnosis")
        if self._config.axis_positions:
            self._state.cannot[Capability.AXIS_POSITION] = NOT_ASKED.format("axis positions")

    async def _exchange(self, asks: Sequence[Ask]) -> list[Answer]:
        if self._link is None:
            raise LinkError(f"{self._name}: not connected")
        blocks = [[int(ask.function), list(ask.arguments), ask.extra.hex()] for ask in asks]
        found = (await self._link.ask(asks=blocks))["answers"]
        if len(found) != len(asks):
            raise BridgeError(f"{len(asks)} blocks were asked for and {len(found)} answered")
        return [Answer(int(error), bytes.fromhex(data)) for error, data in found]
