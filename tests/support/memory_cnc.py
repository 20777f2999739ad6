"""A CNC in this process: macro table and safe points of the simulated NC behind the drivers' contract."""

import math
from collections.abc import Callable, Sequence

from config.schema import Configuration
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY, FatalDriverError, LinkError, Security
from drivers.sim.nc.custom_macro import MacroControl
from drivers.sim.nc.nc import MacroTable
from drivers.sim.nc.safe_point import GuardStatus, SafePointApplication
from models.records import CncMode, CncRun, CncSample


class MemoryNc:
    """The control itself: outlives every client that is opened on it."""

    def __init__(self, configuration: Configuration, clock: Clock) -> None:
        self.clock = clock
        self.macros = MacroTable()
        guard = configuration.cnc.guard if configuration.cnc.is_sinumerik else None
        self.guard = SafePointApplication(configuration.cnc.macros, configuration.compensation.outputs, guard)
        self.guard.initialise(self.macros, self.clock_s)
        if guard is not None:
            self.guard.control.start_timer(guard.timer, self.clock_s)
        self.identity = SIMULATED_CNC_IDENTITY
        self.security: Security = "insecure"
        self.cannot: dict[str, str] = {}
        self.program, self.sequence_number, self.work_offset = 1000, 0, 54
        self.tool_number = 1
        self.spindle_speed_rpm = 5000.0
        self.run = CncRun.START
        self.positions_mm: dict[str, float] = {}
        """What a poll tells, by the names of the configuration."""
        self.power_on_count = 7
        self.clock_zero_s = 500.0
        self.reachable = True
        self.groups_until_lost: int | None = None
        """Groups that are still taken before the connection is lost in a write."""
        self.refuses: int | None = None
        """Macro variable whose writing is refused for good."""
        self.forgets: int | None = None
        """Macro variable that takes a write and keeps its old value."""
        self.breaks: BaseException | None = None
        """What the next call raises."""
        self.after_read: Callable[[Sequence[int]], None] | None = None
        """Called with what was asked for when a read of macros has been answered."""
        self.written: list[tuple[int, float]] = []
        self.opened: list[MemoryCnc] = []

    @property
    def clock_s(self) -> float:
        return getattr(self, "clock_zero_s", 500.0) + self.clock.now().monotonic_s

    def open(self) -> "MemoryCnc":
        client = MemoryCnc(self)
        self.opened.append(client)
        return client

    def variable(self, number: int) -> float | None:
        """Return a common variable, or of a control with custom macros a system variable."""
        system = number >= 1000 and isinstance(self.guard.control, MacroControl)
        return self.guard.control.get(number) if system else self.macros.get(number)

    def safe_point(self) -> GuardStatus:
        """Let the guard run once."""
        return self.guard.run(self.macros, self.clock_s)

    def power_cycle(self) -> None:
        self.macros.power_off()
        self.power_on_count += 1
        self.clock_zero_s = -self.clock.now().monotonic_s


class MemoryCnc:
    """One client of a MemoryNc; implements `drivers.contract.Cnc`."""

    def __init__(self, nc: MemoryNc) -> None:
        self._nc = nc
        self.identity = nc.identity
        self.security = nc.security
        self.cannot = nc.cannot
        self.connected = False
        self.closed = False

    async def connect(self) -> None:
        if not self._nc.reachable:
            raise LinkError("the CNC cannot be reached")
        self.connected = True

    async def read(self, macros: Sequence[int]) -> CncSample:
        found = await self.read_macros(macros)
        nc = self._nc
        return CncSample(
            time=nc.clock.now(),
            mode=CncMode.MEMORY,
            run=nc.run,
            alarm=False,
            program=nc.program,
            sequence_number=nc.sequence_number,
            spindle_speed_rpm=nc.spindle_speed_rpm,
            motor_temperature_degc=30.0,
            clock_s=nc.clock_s,
            power_on_count=nc.power_on_count,
            work_offset=nc.work_offset,
            tool_number=nc.tool_number,
            macros=found,
            positions_mm=dict(nc.positions_mm),
        )

    async def read_macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        self._answer()
        found = {number: _known(self._nc.variable(number)) for number in macros}
        if self._nc.after_read is not None:
            self._nc.after_read(macros)
        return found

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        self._answer()
        nc = self._nc
        for group in groups:
            if nc.groups_until_lost is not None:
                if nc.groups_until_lost == 0:
                    nc.groups_until_lost = None
                    raise LinkError("the connection was lost while writing")
                nc.groups_until_lost -= 1
            for number, value in group:
                if number == nc.refuses:
                    raise FatalDriverError(f"the CNC refuses #{number}")
                nc.written.append((number, value))
                if number != nc.forgets:
                    nc.macros.set(number, value)

    async def close(self) -> None:
        self.closed = True

    def _answer(self) -> None:
        if self.closed or not self._nc.reachable:
            raise LinkError("the connection is lost")
        if self._nc.breaks is not None:
            error, self._nc.breaks = self._nc.breaks, None
            raise error


def _known(value: float | None) -> float | None:
    """Return a value as every driver does: what is not a number is vacant."""
    return None if value is None or math.isnan(value) else value
