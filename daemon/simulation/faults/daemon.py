"""The daemon of a fault campaign: the real one, on virtual time, beside a machine in another process.

`python -P -m daemon.simulation.faults.daemon CONFIGURATION MACHINE_FD ACKNOWLEDGED_FD EPOCH_UTC SEED`
is started, killed and started again by `daemon.simulation.faults.campaign`.
"""

import asyncio
import os
import random
import resource
import socket
import sqlite3
import sys
from collections import deque
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np

from config.loader import load_configuration
from config.schema import Configuration
from config.schema.service import HistoryConfig
from config.schema.temperatures import LineConfig, TemperatureInput
from daemon.app import Daemon
from daemon.compensation.task import ControlTask
from daemon.history.database import HistoryError
from daemon.history.rows import utc_ms
from daemon.history.writer import HistoryWriter
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import load_released
from daemon.registry import Parts
from daemon.simulation.faults.virtual_cnc import VirtualCnc
from daemon.simulation.faults.virtual_world import Channel, VirtualClock, VirtualLoop, VirtualReader, VirtualWorld
from daemon.telemetry.logs import configure_logging
from daemon.telemetry.metrics import give_memory_back
from drivers.clock import Clock
from drivers.contract import DisplacementSource, TemperatureSource
from drivers.displacement.source import DisplacementCsvSource
from drivers.latsis.source import LatsisSerialSource
from drivers.registry import DisplacementInput
from models.control.state import OutputMemory
from models.records import TemperatureCycle, ThermalErrorEstimate

HOUSEKEEPING_S = 6 * 3600.0
"""Time between housekeeping runs [virtual s]."""
COMMIT_EVERY_S = 10.0
"""Records wait for their commit at most this long, so that one carries many: a kill loses more than it would in
truth, where it is some hundredths of a second [virtual s]."""
COMMIT_PATIENCE_S = 10.0
"""A disk that has not taken them after this is one that is behind [s of the wall clock]."""


class Reported(dict[str, int]):
    """What the store has acknowledged, told to the campaign at once: line and UTC of the cycle's first byte."""

    def __init__(self, descriptor: int, cycles: dict[str, deque[TemperatureCycle]]) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._cycles = cycles

    def __setitem__(self, line: str, number: int) -> None:
        """Take the number of a cycle whose commit has returned; called in the store's thread."""
        super().__setitem__(line, number)
        waiting = self._cycles[line]
        while waiting:
            cycle = waiting.popleft()
            if cycle.number == number:
                os.write(self._descriptor, f"{line} {number} {utc_ms(cycle.trace.first_byte)}\n".encode())
                return


class VirtualHousekeeping:
    """Packs and prunes the store now and then, in virtual time."""

    def __init__(self, history: HistoryWriter, config: HistoryConfig) -> None:
        self._history = history
        self._config = config
        self._task: asyncio.Task[None] | None = None

    @property
    def running(self) -> bool:
        return self._task is not None

    def start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._run())

    def shutdown(self, *, wait: bool) -> None:
        if self._task is not None:
            self._task.cancel()

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(HOUSEKEEPING_S)
            await self._history.request_housekeeping(self._config)
            give_memory_back()


class CampaignDaemon:
    def __init__(self, configuration: Configuration, clock: VirtualClock, machine: Channel, acknowledged: int) -> None:
        self._configuration = configuration
        self._clock = clock
        self._world = VirtualWorld(machine, clock, claims=self._claims, hold=self._behind)
        self._daemon: Daemon | None = None
        self._history: HistoryWriter | None = None
        self._cycles: dict[str, deque[TemperatureCycle]] = {
            line.name: deque() for line in configuration.temperatures.lines
        }
        self._acknowledged = acknowledged
        self._committed_s = clock.monotonic_s
        self._judged: tuple[ThermalErrorEstimate | None, tuple[bool, ...], bool] = (None, (), False)

    def run(self) -> None:
        """Run until the campaign ends it."""
        loop = VirtualLoop(self._clock)
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            loop.inhabit(self._world)
            try:
                runner.run(self._live())
            finally:
                loop.inhabit(None)

    async def _live(self) -> None:
        self._world.enter()
        parts = Parts(
            open_temperature_source=self._open_line,
            open_displacement_source=self._open_displacements,
            open_cnc=lambda configuration, _: VirtualCnc(configuration.cnc, self._world, self._clock),
            hold_cnc=lambda _: nullcontext(),
            housekeeping=self._housekeeping,
            load_model=lambda configuration: asyncio.to_thread(load_released, configuration, own_account()),
        )
        self._daemon = Daemon(self._configuration, self._clock, parts)
        self._daemon.acknowledged = Reported(self._acknowledged, self._cycles)
        await self._daemon.run()

    def _open_line(self, configuration: Configuration, line: TemperatureInput, clock: Clock) -> TemperatureSource:
        assert isinstance(line, LineConfig)
        reader = VirtualReader(self._world, line, self._clock)
        return _Noted(LatsisSerialSource(line, configuration.temperatures.sensors, clock, reader=reader), self._cycles)

    def _open_displacements(
        self, configuration: Configuration, _: DisplacementInput, clock: Clock, after_utc_s: float | None
    ) -> DisplacementSource:
        assert configuration.displacements is not None
        return DisplacementCsvSource(configuration.displacements, clock, after_utc_s=after_utc_s, in_thread=False)

    def _housekeeping(self, history: HistoryWriter, config: HistoryConfig, _: object) -> VirtualHousekeeping:
        self._history = history
        return VirtualHousekeeping(history, config)

    def _behind(self) -> bool:
        """Tell whether time must wait for the disk: it works, but is behind, or has not been tried again."""
        if self._history is None:
            return False
        problem, due = self._history.problem, self._clock.monotonic_s - self._committed_s >= COMMIT_EVERY_S
        if not (problem or due) or not self._history.waiting:
            return False
        if resource.getrlimit(resource.RLIMIT_FSIZE)[0] != resource.RLIM_INFINITY:
            return False
        if problem:
            return True
        self._committed_s = self._clock.monotonic_s
        with suppress(OSError, sqlite3.Error, HistoryError):
            self._history.submit(lambda _connection: None).result(COMMIT_PATIENCE_S)
        return False

    def _claims(self) -> tuple[Any, ...]:
        """Return what the daemon says of itself: state, wanted axes, reference, link, estimate's trust."""
        daemon = self._daemon
        if daemon is None or daemon.control.memory is None:
            return ()
        control, estimate = daemon.control, daemon.thermal.latest_estimate
        memory = control.memory
        assert memory is not None
        return (
            memory.state.value,
            tuple(bool(on) for on in memory.wanted),
            control.reference.reference_id if control.reference is not None else None,
            control.session is not None,
            float(estimate.confidence) if estimate is not None else 0.0,
            bool(estimate.in_domain) if estimate is not None else False,
            estimate.reference_id if estimate is not None else None,
            memory.reason,
            self._estimated(control, memory, estimate),
            estimate.model_id if estimate is not None else None,
            bool(daemon.thermal.inhibit()),
            control.skill.inhibit() is not None,
            tuple(map(int, estimate.imputed)) if estimate is not None else (),
            tuple(memory.tools),
            daemon.snapshots.thermal.model_waits,
            control.journal.number,
        )

    def _estimated(self, control: ControlTask, memory: OutputMemory, estimate: ThermalErrorEstimate | None) -> bool:
        """Tell whether every axis that is switched on has an estimate; worked out anew when one of them changes."""
        if estimate is not self._judged[0] or memory.wanted != self._judged[1]:
            found = all(np.isfinite(control.thermal_error_um()[list(memory.wanted)]))
            self._judged = (estimate, memory.wanted, found)
        return self._judged[2]


class _Noted:
    """A temperature source whose cycles are noted, so that acknowledgements can be told apart."""

    def __init__(self, source: LatsisSerialSource, cycles: dict[str, deque[TemperatureCycle]]) -> None:
        self.name = source.name
        self._source = source
        self._waiting = cycles[source.name]

    async def cycles(self) -> Any:
        async for cycle in self._source.cycles():
            self._waiting.append(cycle)
            yield cycle

    async def close(self) -> None:
        await self._source.close()


def main() -> None:
    """Run; called in the daemon's process."""
    path, machine, acknowledged, epoch_utc_s, seed = sys.argv[1:6]
    configuration = load_configuration(Path(path))
    configure_logging(configuration.service.log_level, terminal=False)
    random.seed(seed)
    clock = VirtualClock(epoch_utc_s=float(epoch_utc_s))
    channel = Channel(socket.socket(fileno=int(machine)))
    CampaignDaemon(configuration, clock, channel, int(acknowledged)).run()


if __name__ == "__main__":
    main()
