"""Macros beside the block of the compensation: one temperature, and the spindle speed."""

from config.schema import Configuration
from daemon.output.cnc_session import CncSession
from daemon.output.journal import Journal
from daemon.output.permission import Permission
from daemon.output.references import References
from daemon.output.spindle_speed import SpindleSpeedOutput
from daemon.output.temperature_macro import TemperatureMacro
from daemon.telemetry import Telemetry
from drivers.clock import Clock
from models.records import MachineTemperatures


class SideMacros:
    """Serves both in turn; owned by the control task, which alone talks to the CNC."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        telemetry: Telemetry,
        journal: Journal,
        permission: Permission,
        references: References,
    ) -> None:
        self._temperature = TemperatureMacro(configuration, telemetry, journal, permission)
        self.speed = SpindleSpeedOutput(configuration, clock, journal, permission)
        self._references = references

    @property
    def due(self) -> bool:
        """A value waits to be written."""
        return self._temperature.due

    def take(self, temperatures: MachineTemperatures) -> None:
        """Take a cycle of the sensors."""
        self._temperature.take(temperatures)
        self.speed.take(temperatures)

    async def show(self, session: CncSession | None) -> None:
        """Write what is due; returns soon when nothing is."""
        await self._temperature.show(session)
        await self.speed.follow(session, self._references.phase, self._references.sample)

    def close(self) -> None:
        """Release what is open."""
        self.speed.close()
