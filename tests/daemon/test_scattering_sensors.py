"""A machine whose sensors scatter by a few tenths of a kelvin is followed as any other."""

import numpy as np
import pytest
from thermal_rig import Task, model

SCATTER_K = 0.3


class Scattering:
    """All five sensors scatter, while the machine warms by 0.1 K/min."""

    def __init__(self, task: Task) -> None:
        self.task, self.rng, self.wrong_k = task, np.random.default_rng(8), 0.0

    async def minutes(self, count: float) -> None:
        for _ in range(round(count * 6)):
            warm = 20.0 + 0.1 * self.task.clock.monotonic_s / 60.0
            said = np.round((warm + self.rng.normal(0.0, SCATTER_K, 5)) / 0.0625) * 0.0625
            said[0] += self.wrong_k
            await self.task.minutes(1 / 6, said[:3], said[3:])


async def test_sensors_that_scatter_are_not_doubted_nor_after_a_restart(tmp_path) -> None:
    task = Task(tmp_path, model())
    task.history.start()
    shop = Scattering(task)
    await shop.minutes(6.0)
    await task.ask()
    await shop.minutes(40.0)
    assert len(task.estimates) > 400
    assert min(each.confidence for each in task.estimates) == 1.0
    await task.history.flushed()
    shop.task = again = task.restarted(model())
    await again.task.recall()
    await again.task._take(task.taken_up(task.references[-1]))
    await shop.minutes(10.0)
    assert min(each.confidence for each in again.estimates[12:]) == 1.0
    again.history.close()


@pytest.mark.parametrize("wrong_k", [4.0, -7.0])
async def test_one_that_jumps_by_more_than_it_scatters_is_doubted_as_any_other(tmp_path, wrong_k: float) -> None:
    task = Task(tmp_path, model())
    task.history.start()
    shop = Scattering(task)
    await shop.minutes(6.0)
    await task.ask()
    await shop.minutes(10.0)
    shop.wrong_k = wrong_k
    await shop.minutes(3.0)
    assert task.estimates[-1].confidence == 0.0 and "the level of sensor 1" in task.estimates[-1].inhibit
    task.history.close()
