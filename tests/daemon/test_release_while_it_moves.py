"""Models that are released while the machine warms: the tool stands where it stood without a release."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from small_model import model
from whole_loop import WholeLoop, lagged_model

from daemon.estimation.task import thermal_snapshot
from models.control.state import OperatorRequest
from models.records import CncRun, FloatArray, OutputState
from models.thermal.family import ThermalModel

FIRST, SECOND = model("first"), model("second")
RISE_K = 0.1
"""In ten seconds: half a micrometre on z."""
RELEASES = (20, 31, 41)


async def applied_um(
    directory: Path, releases: tuple[int, ...], models: tuple[ThermalModel, ThermalModel] = (FIRST, SECOND), at: int = 8
) -> FloatArray:
    """Warm the machine while models are released in some moments; return what is applied in the last one.

    `at`: moment in which the work is positioned.
    """
    directory.mkdir()
    first, second = models
    loop = WholeLoop(directory, first)
    await loop.start()
    try:
        loop.rise_k = np.full(len(SENSOR_IDS), RISE_K)
        for moment in range(60):
            positioned = at <= moment < at + 3
            loop.nc.run, loop.nc.sequence_number = (CncRun.START, 100) if positioned else (CncRun.STOP, 900)
            if moment == 3:
                assert not loop.rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
            if moment in releases:
                await loop.use_model(second if loop.model is first else first)
            await loop.moment()
            loop.nc.safe_point()
        memory, estimate = loop.rig.control.memory, loop.thermal.latest_estimate
        assert memory is not None and memory.state is OutputState.ACTIVE
        assert estimate is not None and (
            estimate.model_id == loop.model.model_id or thermal_snapshot(loop.thermal).model_waits
        )
        return loop.applied_um
    finally:
        await loop.end()


def test_releases_of_the_same_model_move_the_tool_nowhere(tmp_path: Path) -> None:
    """What the temperatures changed by between two estimates counted as a difference of the models."""
    alone_um = asyncio.run(applied_um(tmp_path / "alone", ()))
    released_um = asyncio.run(applied_um(tmp_path / "released", RELEASES))
    assert released_um == pytest.approx(alone_um, abs=0.21)


@pytest.mark.parametrize("release", [40, 44, 50])
def test_a_model_whose_lags_are_less_known_waits_and_moves_the_tool_nowhere(tmp_path: Path, release: int) -> None:
    """What it estimates would count for less at once, and part of what is compensated be taken back."""
    lags = lagged_model("lags"), lagged_model("the same")
    alone_um = asyncio.run(applied_um(tmp_path / "alone", (), lags, at=30))
    released_um = asyncio.run(applied_um(tmp_path / "released", (release,), lags, at=30))
    assert np.abs(alone_um).max() > 4.0
    assert released_um == pytest.approx(alone_um, abs=0.21)
