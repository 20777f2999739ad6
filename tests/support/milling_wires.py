"""A machine that mills as a test says, its sensors on pseudo-terminals and its CNC over OPC UA, and a daemon on it."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from control_rig import record_for
from loop_clock import LoopClock
from speed_machine import MACROS, bearing_model, speed_machine

from config.records.commissioning_file import save_commissioning
from config.schema import Configuration
from daemon.app import Daemon
from drivers.guard.speed_text import SpeedStatus, speed_program
from drivers.sim.contract import AxisTruth
from drivers.sim.nc.custom_macro import Interpreter, compile_programs
from drivers.sim.nc.nc import NumericalControl, RunCode
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.wires.latsis_wire import LatsisWires
from drivers.sim.wires.opcua_server import SimulatedCncServer
from drivers.sim.wires.tcp_relay import TcpRelay
from models.thermomechanics.artifact import model_to_json

CUT, SAFE = 200, 900
SPEED = 20.0
FOREVER_S = 600.0
DEGC_PER_CODE = 0.0625


class MillingMachine:
    """An NC in automatic operation, and sensors that all read the same; a test is its part program."""

    def __init__(self, configuration: Configuration) -> None:
        self.time_s = 0.0
        self.degc = 28.0
        self.nc = NumericalControl(program=1000, clock_s=5000.0, clock_ppm=0.0, power_on_count=7, tool_number=1)
        self.nc.run, self.nc.sequence_number = RunCode.START, CUT
        self.guard = SafePointApplication(configuration.cnc.macros, configuration.compensation.axes)
        self.guard.initialise(self.nc.macros, self.nc.clock_s)
        for number in MACROS.ours:
            self.nc.macros.set(number, None if number == MACROS.valid_until else 0.0)
        self.control = self.guard.control
        self.program = Interpreter(compile_programs(speed_program(configuration)), self.control)

    def advance(self, to_s: float) -> None:
        self.time_s = max(self.time_s, to_s)
        self.nc.clock_s = self.nc.clock_at(self.time_s)

    def register_codes(self, sensor_ids: Sequence[int]) -> list[int]:
        return [round(self.degc / DEGC_PER_CODE)] * len(sensor_ids)

    def displacement_um(self) -> dict[str, float]:
        return {}

    def truth(self) -> dict[str, AxisTruth]:
        return {}

    def call(self, **arguments: float) -> tuple[float, float, SpeedStatus]:
        """Call the speed program; return what the NC turns at then, and what the program did."""
        self.control.common, self.control.clock_s = self.nc.macros, self.nc.clock_s
        self.control.tool_number = self.nc.tool_number
        self.program.run(9020, **arguments)
        self.nc.spindle_speed_rpm = self.control.spindle_rpm
        status = SpeedStatus(round(self.nc.macros.get(MACROS.echo_status) or 0.0))
        return self.control.spindle_rpm, self.control.feed_mm_min, status


class MillingWires:
    """Machine, wires and daemon."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        (folder / "bearings.json").write_text(model_to_json(bearing_model()), encoding="utf-8")
        self.folder = folder
        self.configuration = speed_machine(folder, **changes)
        self.machine = MillingMachine(self.configuration)
        self.clock = LoopClock(SPEED)
        self.server = SimulatedCncServer(self.machine.nc, self.configuration.cnc, port=0, readable=MACROS.numbers)
        self.relay = TcpRelay(port=0, target_port=0)
        self.wires = LatsisWires(self.machine, self.configuration.temperatures, folder)
        self.daemon: Daemon | None = None

    async def start(self) -> None:
        """Serve the machine and complete the configuration with where it is served."""
        await self.server.start()
        self.relay = TcpRelay(port=0, target_port=self.server.port)
        await self.relay.start()
        record = self.folder / "commissioning.json"
        save_commissioning(record_for(self.configuration), record)
        content = self.configuration.model_dump()
        content["cnc"]["opcua"]["endpoint"] = f"opc.tcp://127.0.0.1:{self.relay.port}/cnc"
        content["cnc"] |= {"timeout_s": 10.0, "stale_after_s": 600.0}
        content["compensation"]["commissioning_file"] = record
        self.configuration = Configuration.model_validate(content)
        self.wires.open()

    async def run(self) -> None:
        """Move the machine and its wires on until cancelled."""
        origin_s = self.clock.now().monotonic_s
        while True:
            self.machine.advance(self.clock.now().monotonic_s - origin_s)
            self.wires.step(self.machine.time_s, None)
            await self.clock.turn()

    async def stop(self) -> None:
        self.wires.close()
        await self.relay.stop()
        await self.server.stop()

    def picture(self) -> dict[str, Any]:
        assert self.daemon is not None
        snapshot = self.daemon.spindle_speed.snapshot()
        assert snapshot is not None
        return asdict(snapshot)

    def macro(self, number: int) -> float | None:
        return self.machine.nc.macros.get(number)

    async def until(self, what: str, condition: Callable[[], bool]) -> None:
        """Return when the condition holds."""
        end_s = self.clock.elapsed_s + FOREVER_S
        while not condition():
            assert self.clock.elapsed_s < end_s, f"waited in vain for {what}: {self.picture()}"
            await self.clock.sleep(0.1)

    async def operation(self, **arguments: float) -> tuple[float, float, SpeedStatus]:
        """Call at a safe block, wait for the daemon's answer, and call again."""
        self.machine.nc.sequence_number = SAFE
        self.machine.call(**arguments)
        said = f"T{self.machine.nc.tool_number} S{arguments['S']:g} F{arguments['F']:g} D{arguments['D']:g}"
        await self.until(f"an answer to {said}", lambda: self._answered(said))
        return self.machine.call(**arguments)

    def _answered(self, said: str) -> bool:
        picture = self.picture()
        return picture["operation"] == said and picture["state"] == "TUNED" and picture["commanded_rpm"] is not None


@contextlib.asynccontextmanager
async def milling(folder: Path, **changes: Any) -> AsyncIterator[MillingWires]:
    """Run machine and wires."""
    wires = MillingWires(folder, **changes)
    await wires.start()
    moving = asyncio.create_task(wires.run())
    try:
        yield wires
    finally:
        moving.cancel()
        await asyncio.gather(moving, return_exceptions=True)
        await wires.stop()


@contextlib.asynccontextmanager
async def tuned(wires: MillingWires) -> AsyncIterator[Daemon]:
    """Run the daemon."""
    wires.daemon = Daemon(wires.configuration, wires.clock)
    running = asyncio.create_task(wires.daemon.run())
    try:
        yield wires.daemon
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
