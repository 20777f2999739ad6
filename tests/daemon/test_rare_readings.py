"""Temperatures that are read once a minute or every five: nothing else needs to be set, and the output follows."""

from pathlib import Path

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from small_model import model
from whole_loop import MOMENT_S, WholeLoop, loop_machine

from config.schema.temperatures import TemperaturesConfig
from models.control.state import OperatorRequest
from models.records import CncRun, OutputState

WARMS_K_PER_MIN = 0.4


class RareLoop(WholeLoop):
    """Both lines are read once in a period."""

    def __init__(self, directory: Path, period_s: float) -> None:
        whole = loop_machine(directory, "bumpless")
        temperatures = whole.temperatures
        lines = [line.model_copy(update={"cycle_period_s": period_s}) for line in temperatures.lines]
        rare = TemperaturesConfig(lines=lines, sensors=temperatures.sensors)
        configuration = whole.model_copy(update={"temperatures": rare})
        super().__init__(directory, model("increments"), configuration=configuration)
        self.every = round(period_s / MOMENT_S)
        self.count = 0

    async def moment(self) -> None:
        self.count += 1
        await super().moment()
        self.nc.safe_point()

    async def _speak(self, line: str, part: slice) -> None:
        if self.count % self.every == 0:
            await super()._speak(line, part)


@pytest.mark.parametrize("period_s", [60.0, 300.0])
async def test_a_machine_that_is_read_rarely_is_followed_wherever_between_two_readings_it_is_positioned(
    tmp_path: Path, period_s: float
) -> None:
    """Within a period it warms by more than readings that are ten seconds apart may differ."""
    loop = RareLoop(tmp_path, period_s)
    await loop.start()
    loop.rise_k = np.full(len(SENSOR_IDS), WARMS_K_PER_MIN * MOMENT_S / 60.0)
    try:
        for moment in range(12 * loop.every):
            if moment == 6 * loop.every:
                loop.rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
                loop.nc.run, loop.nc.sequence_number = CncRun.START, 100
            if moment == 6 * loop.every + 3:
                loop.nc.run, loop.nc.sequence_number = CncRun.STOP, 900
            await loop.moment()
            memory = loop.rig.control.memory
            if moment > 8 * loop.every:
                assert memory is not None
                assert memory.state is OutputState.ACTIVE, (moment, memory.reason)
    finally:
        await loop.end()
    assert np.abs(loop.applied_um[1:]).min() > 1.0, "it went with the machine"
