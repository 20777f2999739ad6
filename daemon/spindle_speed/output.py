"""The spindle speed as the daemon sees it: where its section is not configured, none of its code is loaded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from config.schema import Configuration
from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks
from daemon.cnc.session import CncSession
from daemon.messages import TemperaturesTrusted
from daemon.snapshots import SpindleSpeedSnapshot
from drivers.clock import Clock
from models.records import CncSample, MachineTemperatures, Phase

if TYPE_CHECKING:
    from daemon.spindle_speed.messages import OpenedModel, Planner
    from daemon.spindle_speed.planner_process import PlannerProcess
    from daemon.spindle_speed.task import Follower


def open_planner(
    command: Sequence[str], configuration: Configuration, on_opened: Callable[[OpenedModel], None]
) -> PlannerProcess | None:
    """Return the process that plans the speed, not started; None where it is not configured."""
    if configuration.spindle_speed is None:
        return None
    from daemon.spindle_speed import planner_process

    return planner_process.PlannerProcess(command, configuration, on_opened)


class SpindleSpeedOutput:
    """Follows one CNC's operations; does nothing without the section `spindle_speed`."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        journal: Journal,
        interlocks: Interlocks,
        planner: Planner | None,
        tell_thermal: Callable[[TemperaturesTrusted], None],
    ) -> None:
        self._tell_thermal = tell_thermal
        self.follower: Follower | None = None
        if (tuning := configuration.spindle_speed) is not None:
            from daemon.spindle_speed import planner_process, task

            worker = planner_process.SpeedWorker(planner)
            self.follower = task.Follower(configuration, tuning, clock, journal, interlocks, worker)

    @property
    def due(self) -> bool:
        """A value waits to be written; never before it is time to read again."""
        return False

    def on_temperatures(self, temperatures: MachineTemperatures) -> None:
        """Take what is believed of a cycle of the sensors."""
        if self.follower is not None and temperatures.believed_degc is not None:
            time = temperatures.trace.cleansed or temperatures.trace.last_byte
            self.follower.worker.take(time.monotonic_s, temperatures.believed_degc, temperatures.doubted)

    async def serve(self, session: CncSession | None, phase: Phase, sample: CncSample | None, tool: int | None) -> None:
        """Read the operation when it is time, decide, and write what is due; `sample` is the latest poll."""
        if self.follower is not None:
            await self.follower.follow(session, phase, sample, tool)

    def turn(self, *, on: bool, person: str) -> str:
        """Switch the tuning on, as the temperatures are, or off; return why that is refused, '' when it is taken."""
        if self.follower is None:
            return "there is no section spindle_speed in the configuration, so there is nothing to switch"
        self.follower.switch.turn(on=on, person=person)
        if on:
            self._tell_thermal(TemperaturesTrusted(person=person))
        return ""

    @property
    def stands_off(self) -> bool:
        """It is switched off, and the block in the CNC says so or has run out."""
        follower = self.follower
        return follower is None or (bool(follower.switch.inhibit) and not follower.followed)

    def close(self) -> None:
        if self.follower is not None:
            self.follower.writer.close()

    def snapshot(self) -> SpindleSpeedSnapshot | None:
        """Return what status shows; None where the tuning is off."""
        return None if self.follower is None else self.follower.snapshot(stands_off=self.stands_off)
