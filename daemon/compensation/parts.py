"""The parts of the control task, which the composition root hands in."""

import asyncio
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from config.schema import Configuration
from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks
from daemon.cnc.session import CncLink, CncSession
from daemon.compensation.references import ToThermal
from daemon.compensation.restart import ResumePoint
from daemon.estimation.inputs import Delivery
from daemon.history.writer import HistoryWriter
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from models.control.state import OutputLimits
from models.records import CncSample, DisplacementSample, MachineTemperatures, Phase

Message = Delivery | DisplacementSample | Callable[[], None]
"""A callable is a person's word, carried out in the control task's stack."""


class Inbox:
    """Messages in the order in which they came; putting one in wakes the control task."""

    def __init__(self) -> None:
        self._waiting: deque[Message] = deque()
        self._event = asyncio.Event()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, message: Message) -> None:
        """Let a message wait, and wake the control task."""
        self._waiting.append(message)
        self._event.set()

    def take(self) -> Message:
        """Return the oldest message; it waits no longer, whatever becomes of it."""
        return self._waiting.popleft()

    def wake(self) -> None:
        """Wake the control task without a message."""
        self._event.set()

    async def woken(self, within_s: float) -> None:
        """Return when something comes or the time is over [s of the wall clock]."""
        self._event.clear()
        if within_s > 0:
            over = asyncio.get_running_loop().call_later(within_s, self._event.set)
            try:
                await self._event.wait()
            finally:
                over.cancel()


class MacroClient(Protocol):
    """Writes macros of its own beside the block, in the control task's stack."""

    @property
    def due(self) -> bool:
        """A value waits to be written."""

    def on_temperatures(self, temperatures: MachineTemperatures) -> None:
        """Take a cycle of the sensors."""

    async def serve(self, session: CncSession | None, phase: Phase, sample: CncSample | None, tool: int | None) -> None:
        """Write what is due after the latest poll, of the part program's block; `tool`: None where it is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlParts:
    """Everything that the control task uses and does not own alone."""

    configuration: Configuration
    clock: Clock
    link: CncLink
    history: HistoryWriter
    telemetry: Telemetry
    journal: Journal
    interlocks: Interlocks
    limits: OutputLimits
    resume: ResumePoint
    um_per_unit: Mapping[str, float]
    """Movement per unit of the macro value by axis [um]."""
    model_id: str | None
    """The model at the start."""
    tell_thermal: Callable[[ToThermal], None]
    on_tick: Callable[[], None]
    on_sample: Callable[[CncSample], None]
    on_change: Callable[[], None]
    macro_clients: tuple[MacroClient, ...] = ()

    @property
    def validity_s(self) -> float:
        """How far valid_until lies ahead of the CNC's clock [s]."""
        return self.configuration.compensation.output.validity_s

    @property
    def max_outage_s(self) -> float:
        """After a longer outage nothing is resumed [s]."""
        return self.configuration.compensation.reference.max_outage_s
