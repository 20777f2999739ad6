"""A machine that warms and cools, its store, and the thermal task with a model of lags on it."""

import asyncio
from dataclasses import replace

import numpy as np
from control_rig import SENSOR_IDS, HandClock, machine

from daemon.estimation.task import ThermalTask
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.messages import ReferenceRequest, ReferenceTakenUp, SensorsSinceReference, SpindleSpeed
from daemon.telemetry.metrics import Telemetry
from models.quality import Quality, Reason
from models.recordings.dataset import Recording
from models.records import CncMode, CncRun, CncSample, Reference, TemperatureCycle, ThermalErrorEstimate, Trace
from models.thermal.training.train_family import train_family

MINUTES = 18 * 60
PAST_MIN = 240.0
STEP_S = 40.0
"""Below the minute after which temperatures count as stale."""
STEPS_AT_ONCE = 60
CHAINS = {"spindle": slice(0, 3), "column": slice(3, 5)}


def day(minutes=MINUTES, seed=3, *, by_load=False):
    """Warm-up and cooling of two parts under a spindle that runs and stands: temperatures, speed, displacement.

    With `by_load` the sensors see what the load warms, and only the speed tells of a third part.
    """
    rng = np.random.default_rng(seed)
    speeds = rng.permutation([0.0, 6000.0, 1500.0, 5000.0, 3000.0])
    rpm = np.resize(np.repeat(speeds, 33), minutes)
    load = np.resize(np.repeat([0.2, 1.0, 0.5, 1.3, 0.0, 0.8, 0.4], 40), minutes)
    fast, slow, unseen = np.zeros(minutes), np.zeros(minutes), np.zeros(minutes)
    for k in range(1, minutes):
        heat = load[k - 1] if by_load else (rpm[k - 1] / 6000.0) ** 2
        unseen[k] = unseen[k - 1] + (by_load * (rpm[k - 1] / 6000.0) ** 2 - unseen[k - 1]) / 30.0
        fast[k] = fast[k - 1] + (heat - fast[k - 1]) / 14.0
        slow[k] = slow[k - 1] + (heat - slow[k - 1]) / 60.0
    places = np.random.default_rng(0).uniform(1.0, 8.0, (2, len(SENSOR_IDS)))
    degc = 22.0 + fast[:, None] * places[0] + slow[:, None] * places[1]
    um = (-30.0 * fast + 12.0 * slow - 20.0 * unseen)[:, None] + rng.normal(0.0, 0.05, (minutes, 1))
    return degc + rng.normal(0.0, 0.02, degc.shape), rpm, um


def trained(table, family="lags"):
    degc, rpm, um = table
    recording = Recording(
        name="day",
        time_s=60.0 * np.arange(float(len(rpm))),
        speed_rpm=rpm,
        temperature_names=tuple(f"t{i}" for i in SENSOR_IDS),
        temperatures_degc=degc,
        displacement_names=("Z1",),
        displacements_um=um,
    )
    made = train_family([recording], family, sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    return replace(made, sensor_ids=SENSOR_IDS)


class Shop:
    """A machine, its store, and one thermal task after the other."""

    def __init__(self, directory, model, *, by_load=False, step_s=STEP_S):
        self.configuration, self.model, self.step_s = machine(directory), model, step_s
        self.clock = HandClock()
        self.degc, self.rpm, _ = day(seed=7, by_load=by_load)
        self.minute = 0.0
        self.delivered = []
        self.begin()

    def taken_up(self, reference):
        """What the control task says of a reference after a restart."""
        return ReferenceTakenUp(reference=reference, sensors=self.sensors)

    def begin(self):
        kept = [item for item in self.delivered if isinstance(item, SensorsSinceReference)]
        self.sensors = kept[-1] if kept else None
        layout = MachineLayout.from_configuration(self.configuration)
        self.history = HistoryWriter(self.configuration.history.path, clock=self.clock, machine=layout)
        self.history.start()
        self.delivered = []
        self.task = ThermalTask(
            self.configuration,
            self.clock,
            self.history,
            Telemetry(),
            self.model,
            asyncio.Queue(),
            self.delivered.append,
        )
        self.numbers = dict.fromkeys(CHAINS, 0)

    async def prepare(self):
        await self.task.begin()

    async def run(self, minutes, *, speed=True):
        for step in range(round(minutes * 60.0 / self.step_s)):
            if step % STEPS_AT_ONCE == 0:
                await self.history.flushed()  # a real hour leaves the store more time than this one
            self.clock.monotonic_s += self.step_s
            self.minute += self.step_s / 60.0
            row = min(int(self.minute), len(self.rpm) - 1)
            now = self.clock.now()
            if speed:
                self.history.cnc_sample(sample(now, self.rpm[row]))
                await self.task._take(SpindleSpeed(monotonic_s=now.monotonic_s, rpm=self.rpm[row]))
            for line, part in CHAINS.items():
                self.numbers[line] += 1
                values = self.degc[row, part]
                await self.task._take(
                    TemperatureCycle(
                        line=line,
                        number=self.numbers[line],
                        degc=values.copy(),
                        quality=np.full(len(values), Quality.GOOD, dtype=np.uint8),
                        reason=np.full(len(values), Reason.NONE, dtype=np.uint8),
                        complete=True,
                        trace=Trace(first_byte=now, last_byte=now),
                    )
                )

    async def refer(self):
        await self.task._take(
            ReferenceRequest(reference_id="r1", source="test", program=1, work_offset=54, power_on_count=1)
        )
        return next(item for item in reversed(self.delivered) if isinstance(item, Reference))

    @property
    def latest(self):
        return next(item for item in reversed(self.delivered) if isinstance(item, ThermalErrorEstimate))

    async def end(self):
        await self.history.flushed()
        await asyncio.to_thread(self.history.close)


def sample(now, rpm):
    return CncSample(
        time=now,
        mode=CncMode.MEMORY,
        run=CncRun.START,
        alarm=False,
        program=1,
        sequence_number=1,
        spindle_speed_rpm=rpm,
        motor_temperature_degc=30.0,
        clock_s=now.monotonic_s,
        power_on_count=1,
        work_offset=54,
        tool_number=1,
    )
