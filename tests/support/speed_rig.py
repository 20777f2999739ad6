"""The tuning of the spindle speed on a CNC in this process that runs the shipped speed program."""

import asyncio
from collections.abc import AsyncIterator
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import HandClock, Rig, record_for, running
from memory_cnc import MemoryNc
from speed_machine import MACROS, bearing_model, speed_machine

from config.schema import Configuration
from daemon.model_release.bearings import OpenedPlanning, open_planning
from daemon.model_release.file_access import own_account
from daemon.spindle_speed.messages import PlannedSpeed, Planner, PlanRequest
from daemon.spindle_speed.output import SpindleSpeedOutput
from daemon.spindle_speed.planning import SpeedPlanning
from drivers.guard.speed_text import SpeedStatus, speed_program
from drivers.sim.nc.custom_macro import Interpreter, compile_programs
from models.records import MachineTemperatures, Trace
from models.thermomechanics.artifact import model_to_json

CUT, SAFE = 200, 900
CYCLE_S = 5


_opened: dict[tuple[str, ...], OpenedPlanning] = {}
"""What was read of a section, a model and cases, before anything was planned with it."""


class ThreadPlanner:
    """What the planning process computes, in a thread of this one: a process for each of many rigs takes too long."""

    def __init__(self, configuration: Configuration) -> None:
        tuning = configuration.spindle_speed
        assert tuning is not None
        folder = tuning.thermomechanical_model.parent
        texts = [
            path.read_text("utf-8") for path in (tuning.thermomechanical_model, *(o.case for o in tuning.operations))
        ]
        key = (tuning.model_dump_json().replace(str(folder), ""), str(configuration.temperatures.labels), *texts)
        if key not in _opened:
            _opened[key] = open_planning(configuration, own_account())
        self.inhibit = _opened[key].inhibit
        self._planning = SpeedPlanning(deepcopy(_opened[key].operations), tuning.sensor_step_k)

    async def plan(self, request: PlanRequest) -> PlannedSpeed | None:
        return await asyncio.to_thread(self._planning.answer, request)


class SpeedRig:
    """A rig with the speed program on its NC."""

    def __init__(self, folder: Path, *, model: Any = None, **changes: Any) -> None:
        (folder / "bearings.json").write_text(model_to_json(model or bearing_model()), encoding="utf-8")
        self.folder = folder
        configuration, clock = speed_machine(folder, **changes), HandClock()
        self.configuration, self.clock = configuration, clock
        self.nc = MemoryNc(configuration, clock)
        for number in MACROS.ours:
            self.nc.macros.set(number, None if number == MACROS.valid_until else 0.0)
        self.control = self.nc.guard.control
        self.program = Interpreter(compile_programs(speed_program(configuration)), self.control)
        self.degc = 28.0
        self.rig = self.new_rig()

    def new_rig(self, planner: Planner | None = None, **record: Any) -> Rig:
        """Another run of the daemon on the same control."""
        planner = ThreadPlanner(self.configuration) if planner is None else planner
        self.rig = Rig(
            self.configuration, self.nc, self.clock, record=record_for(self.configuration, **record), planner=planner
        )
        return self.rig

    @property
    def speed(self) -> SpindleSpeedOutput:
        return self.rig.speed

    async def pass_by(self, seconds: float, sequence_number: int, *, temperatures: bool = True) -> None:
        """Let time pass in a block of the part program, second by second; a lost link comes back where it can."""
        self.nc.sequence_number = sequence_number
        for _ in range(round(seconds)):
            if temperatures and round(self.clock.monotonic_s) % CYCLE_S == 0:
                self.rig.control.deliver(self.cycle())
            await self.rig.turn(after_s=1.0, safe=False)
            await self.rig.serve()
            if (planning := self.speed.follower.worker._task) is not None:
                await asyncio.wait([planning])
            if self.nc.reachable:
                await self.rig.connected()

    def call(self, **arguments: float) -> tuple[float, float, SpeedStatus]:
        """Let the part program call the speed program at a safe block; return what the NC then turns at."""
        self.control.common, self.control.clock_s = self.nc.macros, self.nc.clock_s
        self.control.tool_number = self.nc.tool_number
        self.program.run(9020, **({"S": 9000.0, "F": 1800.0, "D": 2.0} | arguments))
        self.nc.spindle_speed_rpm = self.control.spindle_rpm
        status = SpeedStatus(round(self.nc.macros.get(MACROS.echo_status) or 0.0))
        return self.control.spindle_rpm, self.control.feed_mm_min, status

    async def operation(self, **arguments: float) -> tuple[float, float, SpeedStatus]:
        """Call, wait at the safe block until the daemon has decided, and call again."""
        self.nc.sequence_number = SAFE
        self.call(**arguments)
        await self.pass_by(8.0, SAFE)
        return self.call(**arguments)

    def cycle(self) -> MachineTemperatures:
        now, codes = self.clock.now(), np.zeros(5, dtype=np.uint8)
        return MachineTemperatures(
            line="spindle",
            measured_degc=np.full(5, self.degc),
            degc=np.full(5, self.degc),
            quality=codes,
            reason=codes.copy(),
            age_s=np.zeros(5),
            believed_degc=np.full(5, self.degc),
            trace=Trace(first_byte=now, last_byte=now, cleansed=now),
        )

    def written(self) -> list[float]:
        return [value for number, value in self.nc.written if number == MACROS.speed]

    def picture(self) -> dict[str, Any]:
        snapshot = self.speed.snapshot()
        assert snapshot is not None
        return asdict(snapshot)


@pytest.fixture
async def turned(tmp_path: Path) -> AsyncIterator[SpeedRig]:
    """A rig whose daemon has looked at the control once; a file of tests names it as its bench."""
    bench = SpeedRig(tmp_path)
    async with running(bench.rig):
        await bench.rig.turn()
        yield bench


async def acknowledge(bench: SpeedRig) -> None:
    """Let a person have seen what is wrong."""
    assert bench.rig.acknowledge("a person") == ""
    await bench.rig.turn(safe=False)
