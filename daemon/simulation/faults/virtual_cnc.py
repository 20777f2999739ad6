"""The CNC of a simulated machine in another process, on virtual time; implements `drivers.contract.Cnc`."""

import asyncio
import math
from collections.abc import Sequence
from typing import Any, NoReturn

from config.schema.cnc import CncConfig
from daemon.simulation.faults.virtual_world import VirtualClock, VirtualWorld
from drivers.contract import SIMULATED_CNC_IDENTITY, FatalDriverError, LinkError, NotSentError, Security
from drivers.sim.nc.nc import ModeCode, RunCode
from models.records import CncMode, CncRun, CncSample

MODES = {
    ModeCode.MDI: CncMode.MDI,
    ModeCode.MEM: CncMode.MEMORY,
    ModeCode.EDIT: CncMode.EDIT,
    ModeCode.HANDLE: CncMode.HANDLE,
    ModeCode.JOG: CncMode.JOG,
    ModeCode.REMOTE: CncMode.REMOTE,
}
RUNS = {RunCode.RESET: CncRun.RESET, RunCode.STOP: CncRun.STOP, RunCode.HOLD: CncRun.HOLD, RunCode.START: CncRun.START}


class VirtualCnc:
    """One connection, used up when it is lost."""

    def __init__(self, config: CncConfig, world: VirtualWorld, clock: VirtualClock) -> None:
        self.identity = SIMULATED_CNC_IDENTITY
        self.security: Security = "insecure"
        self.cannot: dict[str, str] = {}
        self._config = config
        self._world = world
        self._clock = clock
        self._open = False
        self._read_back: tuple[float, dict[int, float | None]] = (-math.inf, {})
        """What the CNC has shown along with its answer to a write, and when: good for that moment only."""
        self._nc_clock_s = math.nan
        self._nc_clock_moved_s = 0.0

    async def connect(self) -> None:
        await self._answer("connect")
        self._open = True
        self._nc_clock_moved_s = self._clock.monotonic_s

    async def read(self, macros: Sequence[int]) -> CncSample:
        """Read the machine's state and macro variables."""
        state, values = await self._ask("read", tuple(macros))
        mode, run, alarm, program, sequence_number, speed_rpm, motor_degc, clock_s, power_on, offset, tool = state
        self._watch_clock(clock_s)
        return CncSample(
            time=self._clock.now(),
            mode=MODES.get(mode, CncMode.UNKNOWN),
            run=RUNS.get(run, CncRun.UNKNOWN),
            alarm=bool(alarm),
            program=program,
            sequence_number=sequence_number,
            spindle_speed_rpm=speed_rpm,
            motor_temperature_degc=motor_degc,
            clock_s=clock_s,
            power_on_count=power_on,
            work_offset=offset,
            tool_number=tool,
            macros=dict(zip(macros, values, strict=True)),
        )

    async def read_macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        """Read macro variables; None where a variable is vacant."""
        at_s, shown = self._read_back
        if at_s == self._clock.monotonic_s and shown.keys() >= set(macros):
            return {number: shown[number] for number in macros}
        values = await self._ask("read_macros", tuple(macros))
        return dict(zip(macros, values, strict=True))

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        """Write groups one after the other; refuses what is not allow-listed before anything is sent."""
        for number, value in (pair for group in groups for pair in group):
            if number not in self._config.macros.allowed or not math.isfinite(value):
                raise NotSentError(f"macro variable #{number} = {value} must not be written; nothing was sent")
        left = [tuple((number, float(value)) for number, value in group) for group in groups if group]
        while left:
            taken, shown = await self._ask("write", tuple(left))
            left = left[taken:]
            self._read_back = self._clock.monotonic_s, shown

    async def close(self) -> None:
        """Close; never raises."""
        self._open = False

    async def _ask(self, name: str, *arguments: Any) -> Any:
        if not self._open:
            raise LinkError("the simulated CNC: not connected")
        return await self._answer(name, *arguments)

    async def _answer(self, name: str, *arguments: Any) -> Any:
        answer = self._world.call(name, *arguments)
        if answer.verdict == "silent":
            await asyncio.sleep(self._config.timeout_s)
            self._lose(f"did not answer within {self._config.timeout_s:g} s")
        if answer.delay_s > 0:
            await asyncio.sleep(answer.delay_s)
        if answer.verdict == "lost":
            self._lose("was lost")
        if answer.verdict == "refused":
            raise FatalDriverError(f"the CNC refused {answer.content}")
        return answer.content

    def _watch_clock(self, clock_s: float) -> None:
        now_s = self._clock.monotonic_s
        if clock_s != self._nc_clock_s:
            self._nc_clock_s, self._nc_clock_moved_s = clock_s, now_s
        elif now_s - self._nc_clock_moved_s > self._config.stale_after_s:
            self._lose(f"answers but its clock stands still at {clock_s:g} s")

    def _lose(self, why: str) -> NoReturn:
        self._open = False
        raise LinkError(f"the simulated CNC {why}")
