"""A daemon that dies at a chosen call to the CNC, and the next one on what it has left."""

import asyncio
import shutil
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from control_rig import SENSOR_IDS
from memory_cnc import MemoryCnc, MemoryNc
from small_model import model
from whole_loop import WholeLoop

from drivers.contract import LinkError
from models.control.state import OperatorRequest
from models.records import CncRun, FloatArray, OutputState

ACTS, ENDS = 20, 32
"""Moments: what the daemon dies in begins, and the end."""
RISE_K = 0.2


class DyingCnc(MemoryCnc):
    """A client whose calls may never come to an end."""

    async def read_macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        await self._nc.call()
        return await super().read_macros(macros)

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        for group in groups:
            await self._nc.call()
            await super().write_macros([group])
        await self._nc.call()  # all of it has arrived, and nobody hears so


class DyingNc(MemoryNc):
    """A control whose clients are counted calls; at one of them `dies` is called, and no call returns any more."""

    left: int | None = None
    """Calls until then; None: nothing dies."""
    calls = 0
    dead = False
    dies: Callable[[], None]

    def open(self) -> DyingCnc:
        client = DyingCnc(self)
        self.opened.append(client)
        return client

    async def call(self) -> None:
        if self.dead:
            raise LinkError("nobody lives who could ask")
        self.calls += 1
        if self.left is None:
            return
        self.left -= 1
        if self.left < 0:
            self.dead = True
            self.dies()
            await asyncio.Event().wait()


class DyingLoop:
    """One history, in which `act` happens in moment `ACTS`, and the daemon may die in that moment or the next.

    `killed`: only what the operating system has is left; otherwise the daemon was told to end and had to break off.
    """

    def __init__(
        self, directory: Path, act: Callable[[WholeLoop], Any], *, killed: bool = False, by_person: bool = False
    ) -> None:
        directory.mkdir()
        self.loop = WholeLoop(directory, model("first"))
        self.loop.nc.__class__ = DyingNc
        self.nc: DyingNc = self.loop.nc  # type: ignore[assignment]
        self.act, self.killed, self.by_person = act, killed, by_person
        self.died = asyncio.Event()
        self.told: asyncio.Future[None] | None = None
        """Whether a person who asked was told that it is done; who was not asks again."""
        self.asks_again = False
        self.nc.dies = self._dies
        self.store = self.loop.configuration.history.path
        self.kept = directory / "kept"
        self.applied_um: list[FloatArray] = []
        self.states: list[OutputState] = []
        self.reasons: list[str] = []

    def _dies(self) -> None:
        if self.killed:
            self.kept.mkdir()
            for path in self.store.parent.glob(f"{self.store.name}*"):
                if not path.name.endswith("-shm"):
                    shutil.copy(path, self.kept)
        self.died.set()

    async def run(self, after: int | None) -> None:
        """Warm up, follow, act; die after so many calls of the moment of the act, None: live."""
        loop = self.loop
        await self._start()
        try:
            for moment in range(ENDS):
                loop.rise_k = np.full(len(SENSOR_IDS), RISE_K if moment < ACTS else 0.0)
                if moment == 8:
                    loop.rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
                if moment in (10, 12):
                    loop.nc.run = CncRun.START if moment == 10 else CncRun.STOP
                    loop.nc.sequence_number = 100 if moment == 10 else 900
                loop.rig.alive()
                if moment == ACTS:
                    await loop.rig.history.flushed()
                    self.nc.left, self.nc.calls = after, 0
                    coming = self.act(loop)
                    self.told = asyncio.ensure_future(loop.rig.control.requests.carried_out())
                    if coming is not None:
                        await self._lived(coming)
                await self._lived(loop.moment())
                loop.nc.safe_point()
                if self.asks_again and self.by_person and loop.rig.control.memory is not None:
                    self.asks_again = False
                    self.act(loop)
                memory = loop.rig.control.memory
                self.applied_um.append(loop.applied_um.copy())
                self.states.append(OutputState.OFF if memory is None else memory.state)
                self.reasons.append("" if memory is None else str(memory.reason))
        finally:
            if self.told is not None:
                self.told.cancel()
            await loop.end()

    async def _lived(self, coming: Coroutine[Any, Any, None]) -> None:
        """Do something, or die in it and begin anew."""
        doing = asyncio.create_task(coming)
        dying = asyncio.ensure_future(self.died.wait())
        await asyncio.wait([doing, dying], return_when=asyncio.FIRST_COMPLETED)
        dying.cancel()
        if not self.died.is_set():
            await doing
            return
        doing.cancel()
        await asyncio.gather(doing, return_exceptions=True)
        await self.loop.end()
        if self.killed:
            for path in self.store.parent.glob(f"{self.store.name}*"):
                path.unlink()
            for path in self.kept.iterdir():
                shutil.copy(path, self.store.parent)
        self.died.clear()
        self.nc.left, self.nc.dead = None, False
        await self._start()
        if self.told is not None and not self.told.done():
            self.told.cancel()
            self.asks_again = True

    async def _start(self) -> None:
        """Start the daemon as `ThermalTask.run` does."""
        await self.loop.start()
        await self.loop.thermal.begin()
