"""What a program measured with a sensor that is found wrong later: the tool stands at the truth, or the output holds.

A sensor of the spindle drifts. Before the watch finds it, a tool is set, a probe is taken, or another model is
released: all of them count from an estimate that holds the drift.
"""

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from nc_requests import PROBE, REFERENCE, Z_AXIS, answer, ask
from small_model import model as small_model
from whole_loop import WholeLoop

from models.control.state import OperatorRequest
from models.recordings.dataset import Recording
from models.records import CncRun, FloatArray, OutputState
from models.thermal.linear import LinearModel
from models.thermal.sensor_watch import SensorWatch
from models.thermal.training.train_family import train_family

MINUTES = 180
WARM, WRONG, MEASURED = 30, 40, 48
"""Minutes: the work is positioned, a sensor begins to drift, something is counted from the estimate."""
DRIFT_K_PER_MIN = 0.2
RIGHT, JUDGED, END = 2, 4, 9
"""Minutes after the watch has found it: the sensor is right again, the tool is judged, the hold has not ended yet."""
Z_UM_PER_K = float(len(SENSOR_IDS))


def alike(seed: int) -> FloatArray:
    """Five sensors that go up and down together, each a little noisy, once a minute."""
    rng = np.random.default_rng(seed)
    time_min = np.arange(float(MINUTES))
    swing = 3.0 * np.sin(time_min / 25.0 + seed) + 2.0 * np.sin(time_min / 60.0)
    return np.asarray(22.0 + swing[:, None] + rng.normal(0.0, 0.02, (MINUTES, len(SENSOR_IDS))))


@pytest.fixture(scope="module")
def watch() -> SensorWatch:
    recordings = [
        Recording(
            name=f"day {seed}",
            time_s=60.0 * np.arange(float(MINUTES)),
            speed_rpm=None,
            temperature_names=tuple(f"t{i}" for i in SENSOR_IDS),
            temperatures_degc=(table := alike(seed)),
            displacement_names=("Z1",),
            displacements_um=table.sum(axis=1, keepdims=True),
        )
        for seed in (1, 2)
    ]
    made = train_family(recordings, "lags", sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    assert isinstance(made, LinearModel) and made.watch is not None
    return made.watch


class Shop:
    """A loop whose machine goes its way, with a sensor that drifts until somebody sees to it."""

    def __init__(self, directory: Path, watch: SensorWatch) -> None:
        self.models = {name: replace(small_model(name), watch=watch) for name in ("first", "second")}
        self.loop = WholeLoop(directory, self.models["first"])
        compensation = self.loop.configuration.compensation
        output = compensation.output.model_copy(update={"full_confidence": 0.75})  # four of five count whole
        changes = {"compensation": compensation.model_copy(update={"output": output})}
        self.loop.configuration = self.loop.configuration.model_copy(update=changes)
        self.table = alike(7)
        self.found: int | None = None
        self.counter = 0

    async def minute(self, minute: int) -> None:
        loop = self.loop
        loop.degc = self.table[minute]
        until = minute if self.found is None else min(minute, self.found)
        right = self.found is not None and minute >= self.found + RIGHT
        loop.offset_k = np.zeros(len(SENSOR_IDS))
        loop.offset_k[0] = 0.0 if right else DRIFT_K_PER_MIN * max(until - WRONG, 0)
        for _ in range(6):
            await loop.moment()
            if loop.nc.sequence_number == 900:
                loop.nc.safe_point()
        estimate = loop.thermal.latest_estimate
        if self.found is None and estimate is not None and estimate.imputed:
            self.found = minute

    async def follow(self) -> None:
        """Position the work and follow until the sensor has drifted for a while."""
        loop = self.loop
        await loop.start()
        for minute in range(MEASURED):
            if minute == WARM - 5:
                loop.rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
            if minute == WARM:
                loop.nc.run, loop.nc.sequence_number = CncRun.START, 100
                await loop.moment()
                await loop.moment()
                loop.nc.run, loop.nc.sequence_number = CncRun.STOP, 900
            await self.minute(minute)
        assert self.found is None and self.state is OutputState.ACTIVE

    async def measure(self, kind: int, value_um: float = 0.0) -> None:
        """Ask as the program does, and wait for the answer."""
        self.counter += 1
        ask(self.loop, self.counter, kind, Z_AXIS, value_um * 1e-3)
        await self.loop.moment()
        await self.loop.moment()
        assert answer(self.loop) == self.counter

    @property
    def state(self) -> OutputState:
        memory = self.loop.rig.control.memory
        assert memory is not None
        return memory.state

    @property
    def z_um(self) -> float:
        return float(self.loop.applied_um[2])

    def off_um(self, then_um: float, then: int, now: int) -> float:
        """How far z stands from where what was right then has gone since [um]."""
        gone_um = float((self.table[now] - self.table[then]).mean()) * Z_UM_PER_K
        return abs(self.z_um - (then_um - gone_um))


async def measured(shop: Shop, what: str) -> tuple[float, int]:
    """Count something from the estimate of now; return what is right from then on, and since when."""
    now = MEASURED - 1
    if what == "tool":
        await shop.measure(REFERENCE)
        return shop.z_um, now
    if what == "probe":
        drift_um = DRIFT_K_PER_MIN * (now - WRONG)
        await shop.measure(PROBE, -drift_um)  # what is really there: the drift has moved z by as much
        return shop.z_um + drift_um, now
    wrong_um = shop.z_um
    await shop.loop.use_model(shop.models["second"])
    return wrong_um + DRIFT_K_PER_MIN * (now - WRONG), now


@pytest.mark.parametrize("what", ["tool", "probe", "model"])
async def test_what_was_measured_with_a_sensor_that_is_found_wrong_later_holds(
    tmp_path: Path, watch: SensorWatch, what: str
) -> None:
    shop = Shop(tmp_path, watch)
    await shop.follow()
    then_um, then = await measured(shop, what)
    minute = MEASURED
    while shop.found is None or minute < shop.found + END:
        await shop.minute(minute)
        if shop.found is not None and minute > shop.found + JUDGED and shop.state is OutputState.ACTIVE:
            assert shop.off_um(then_um, then, minute) <= 1.3
        minute += 1
    assert shop.state is OutputState.HOLD
    await shop.loop.end()


async def test_a_tool_that_is_set_again_and_a_probe_taken_again_are_followed(
    tmp_path: Path, watch: SensorWatch
) -> None:
    shop = Shop(tmp_path, watch)
    await shop.follow()
    await measured(shop, "tool")
    await measured(shop, "probe")
    minute = MEASURED
    while shop.found is None:
        await shop.minute(minute)
        minute += 1
    await shop.minute(minute)
    assert shop.state is OutputState.HOLD
    await shop.measure(REFERENCE)
    right_um = shop.z_um
    for later in range(minute + 1, minute + 8):
        await shop.minute(later)
    assert shop.state is OutputState.ACTIVE
    assert shop.off_um(right_um, minute, minute + 7) <= 1.3
    await shop.loop.end()


async def test_what_is_in_doubt_is_in_doubt_after_a_restart(tmp_path: Path, watch: SensorWatch) -> None:
    shop = Shop(tmp_path, watch)
    await shop.follow()
    await measured(shop, "tool")
    minute = MEASURED
    while shop.found is None:
        await shop.minute(minute)
        minute += 1
    await shop.loop.rig.history.flushed()
    await shop.loop.end()
    await shop.loop.start()
    await asyncio.sleep(0)
    for later in range(minute, minute + 5):
        await shop.minute(later)
    assert shop.loop.rig.control.reference is not None, "it is taken up again"
    assert shop.state is OutputState.HOLD
    assert "found wrong later" in shop.loop.rig.control.memory.reason
    await shop.loop.end()
