"""Models that are released while the machine warms: the tool stands where it stood without a release."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from small_model import model
from whole_loop import WholeLoop

from models.control.state import OperatorRequest
from models.records import CncRun, FloatArray, OutputState

FIRST, SECOND = model("first"), model("second")
RISE_K = 0.1
"""In ten seconds: half a micrometre on z."""
RELEASES = (20, 31, 41)


async def applied_um(directory: Path, releases: tuple[int, ...]) -> FloatArray:
    """Warm the machine while models are released in some moments; return what is applied in the last one."""
    directory.mkdir()
    loop = WholeLoop(directory, FIRST)
    await loop.start()
    try:
        loop.rise_k = np.full(len(SENSOR_IDS), RISE_K)
        for moment in range(60):
            positioned = 8 <= moment < 11
            loop.nc.run, loop.nc.sequence_number = (CncRun.START, 100) if positioned else (CncRun.STOP, 900)
            if moment == 3:
                assert not loop.rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
            if moment in releases:
                await loop.use_model(SECOND if loop.model is FIRST else FIRST)
            await loop.moment()
            loop.nc.safe_point()
        memory, estimate = loop.rig.control.memory, loop.thermal.latest_estimate
        assert memory is not None and memory.state is OutputState.ACTIVE
        assert estimate is not None and estimate.model_id == loop.model.model_id
        return loop.applied_um
    finally:
        await loop.end()


def test_releases_of_the_same_model_move_the_tool_nowhere(tmp_path: Path) -> None:
    """What the temperatures changed by between two estimates counted as a difference of the models."""
    alone_um = asyncio.run(applied_um(tmp_path / "alone", ()))
    released_um = asyncio.run(applied_um(tmp_path / "released", RELEASES))
    assert released_um == pytest.approx(alone_um, abs=0.21)
