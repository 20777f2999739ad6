"""A model with a slope is released while one without is in force, and the other way round: nothing moves, or it waits.

Thermal task, control task and the guard's text on the simulated SINUMERIK, whose Z takes an offset and a slope.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from sloped_machine import PIVOT_MM, configured, content, proved
from small_model import model
from whole_loop import MOMENT_S, WholeLoop

from config.schema import Configuration
from models.control.state import OperatorRequest
from models.records import CncRun, FloatArray, OutputState
from models.thermal.family import ThermalModel

pytestmark = pytest.mark.quiet

CHANNELS = ("Y1", "Z1", "Z1_per_m")
"""Um/K of every sensor: 0.5, 1 and 4, the last of them um/m."""


def sloping(name: str, z1: float = 1.0, channels: tuple[str, ...] = CHANNELS) -> ThermalModel:
    um_per_k = {"Y1": 0.5, "Z1": z1, "Z1_per_m": 4.0}
    count = len(model().sensor_ids)
    return model(
        name,
        channels=channels,
        coefficients_um_per_k=np.vstack([np.full(count, um_per_k[channel]) for channel in channels]),
        pivots_mm={"Z1_per_m": PIVOT_MM} if "Z1_per_m" in channels else {},
    )


RISE_K = 1.6
ROUNDED_UM = 1.1
"""The control takes whole micrometres, and the output has a dead band."""
WITH, WITHOUT = sloping("with"), sloping("without", 1.5, ("Y1", "Z1"))


def machine(directory: Path, *, slope: bool) -> Configuration:
    """The sloped machine; `slope`: its slope follows a channel, else it follows none."""
    given = content(directory)
    given["compensation"]["reference"]["positioning_dwell_s"] = 2.5 * MOMENT_S
    given["compensation"]["output"]["hold_limit_s"] = 600.0
    given["service"] |= {"retry_min_s": 0.001, "retry_max_s": 0.002}
    if not slope:
        del given["compensation"]["axes"]["z_slope"]["estimate"]
    return configured(given)


class Sloped(WholeLoop):
    """The loop with what is applied in each moment [um, um/m]."""

    def __init__(self, directory: Path, first: ThermalModel, *, slope: bool = True) -> None:
        super().__init__(directory, first, configuration=machine(directory, slope=slope), proved=proved())
        self.applied: list[FloatArray] = []

    async def moments(self, count: int, rise_k: float = 0.0) -> None:
        self.rise_k = np.full(len(self.degc), rise_k)
        for _ in range(count):
            await self.moment()
            self.nc.safe_point()
            self.applied.append(self.applied_um)

    @property
    def state(self) -> OutputState:
        memory = self.rig.control.memory
        assert memory is not None
        return memory.state

    async def positioned(self) -> None:
        """Let the program pass its positioning."""
        self.nc.run, self.nc.sequence_number = CncRun.START, 100
        await self.moments(2)
        self.nc.run, self.nc.sequence_number = CncRun.STOP, 900

    async def follows(self, *axes: str) -> None:
        """Switch axes on, position the work, and let the machine warm."""
        await self.moments(8)
        assert self.rig.control.request(OperatorRequest(enable=frozenset(axes)), "a person") == ""
        await self.positioned()
        await self.moments(16, RISE_K / 16)
        await self.moments(12)
        assert self.state is OutputState.ACTIVE


@asynccontextmanager
async def playing(directory: Path, first: ThermalModel, *, slope: bool) -> AsyncIterator[Sloped]:
    loop = Sloped(directory, first, slope=slope)
    await loop.start()
    try:
        yield loop
    finally:
        await loop.end()


RELEASES = pytest.mark.parametrize(
    ("first", "second"), [(WITH, WITHOUT), (WITHOUT, WITH)], ids=["to without", "to with"]
)


def z1_um_per_k(used: ThermalModel) -> float:
    return len(model().sensor_ids) * (1.5 if used is WITHOUT else 1.0)


@RELEASES
async def test_where_nothing_follows_the_slope_the_offset_goes_on_without_a_step(
    tmp_path: Path, first: ThermalModel, second: ThermalModel
) -> None:
    async with playing(tmp_path, first, slope=False) as loop:
        await loop.follows("z")
        before = loop.applied[-1]
        assert before == pytest.approx([-RISE_K * z1_um_per_k(first), 0.0], abs=ROUNDED_UM)
        await loop.use_model(second)
        await loop.moments(12)
        estimate = loop.thermal.latest_estimate
        assert estimate is not None and estimate.model_id == second.model_id and loop.state is OutputState.ACTIVE
        assert (np.array(loop.applied[-12:]) == before).all()
        await loop.moments(5, 0.1)
        await loop.moments(12)
        assert loop.applied[-1] - before == pytest.approx([-0.5 * z1_um_per_k(second), 0.0], abs=ROUNDED_UM)


async def test_an_axis_whose_slope_no_model_tells_any_more_holds_and_goes_on_from_where_it_stood(
    tmp_path: Path,
) -> None:
    async with playing(tmp_path, WITH, slope=True) as loop:
        await loop.follows("z", "z_slope")
        before = loop.applied[-1]
        assert before == pytest.approx([-RISE_K * 5.0, -RISE_K * 20.0], abs=ROUNDED_UM)
        await loop.use_model(WITHOUT)
        await loop.moments(12)
        memory = loop.rig.control.memory
        assert memory is not None and loop.state is OutputState.HOLD and "no estimate for axis z_slope" in memory.reason
        await loop.use_model(sloping("with again", 2.0))
        await loop.moments(12)
        assert loop.state is OutputState.ACTIVE
        assert (np.array(loop.applied[-24:]) == before).all(), "what the slopes of two models differ by moves nothing"
        await loop.moments(5, 0.1)
        await loop.moments(12)
        assert loop.applied[-1] - before == pytest.approx([-5.0, -10.0], abs=ROUNDED_UM)


@RELEASES
async def test_a_restart_with_another_configuration_of_the_slope_moves_nothing(
    tmp_path: Path, first: ThermalModel, second: ThermalModel
) -> None:
    async with playing(tmp_path, first, slope=first is WITH) as loop:
        await loop.follows("z", *(["z_slope"] if first is WITH else []))
        before = loop.applied[-1]
        await loop.rig.history.flushed()
        await loop.end()
        loop.configuration, loop.model = machine(tmp_path, slope=second is WITH), second
        await loop.start()
        await loop.thermal.recall()
        await loop.moments(12)
        memory = loop.rig.control.memory
        assert memory is not None and loop.state is OutputState.HOLD
        assert f"it belongs to model {first.model_id}, the model is now {second.model_id}" in memory.reason
        if second is WITH:
            assert loop.rig.control.request(OperatorRequest(enable=frozenset({"z_slope"})), "a person") == ""
        await loop.positioned()
        if second is WITHOUT:
            assert loop.state is OutputState.HOLD, "nothing tells the slope that is still asked for"
            assert loop.rig.control.request(OperatorRequest(disable=frozenset({"z_slope"})), "a person") == ""
        await loop.moments(6)
        assert loop.state is OutputState.ACTIVE
        assert (np.array(loop.applied[-20:]) == before).all(), "neither the restart nor the reference is a step"
        await loop.moments(5, 0.1)
        await loop.moments(12)
        wanted = [-0.5 * z1_um_per_k(second), -10.0 if second is WITH else 0.0]
        assert loop.applied[-1] - before == pytest.approx(wanted, abs=ROUNDED_UM)
