"""An input that already answered from memory when the work was positioned, which is known only minutes later."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from thermal_rig import Task, model

ENDS_MIN = 12.0
"""Minutes after the positioning when the line tells the truth again, ..."""
JUDGED_MIN = 24.0
"""... and when it is judged."""


async def warming(task: Task, minutes: float, stands: Callable[[float], bool], begin_min: float) -> None:
    """Let the machine warm by 0.4 K/min; while it stands, the line of the spindle says what it said before."""
    for step in range(round(minutes * 6.0)):
        now_min = begin_min + step / 6.0
        scatter = 0.0625 * (step % 3)
        if not stands(now_min):
            task.said = 20.0 + 0.4 * now_min + scatter  # type: ignore[attr-defined]
        task.clock.monotonic_s += 10.0
        await task.cycle("spindle", task.said)  # type: ignore[attr-defined]
        await task.cycle("column", 20.0 + scatter)


@pytest.mark.parametrize(
    ("before_min", "then"),
    [(4.0, ""), (2.0, "restarts"), (0.0, ""), (0.0, "restarts"), (4.0, "two are refused"), (0.0, "two are refused")],
)
def test_what_stood_when_the_work_was_positioned_holds_until_it_is_positioned_again(
    tmp_path: Path, before_min: float, then: str
) -> None:
    """After two references that were refused one after the other the one before them had forgotten it."""

    def stands(now_min: float) -> bool:
        return -before_min <= now_min < ENDS_MIN if before_min else False

    async def play() -> tuple[Any, Any]:
        task = Task(tmp_path, model())
        task.history.start()
        await warming(task, 40.0, stands, -40.0)
        await task.ask()
        await warming(task, JUDGED_MIN - 6.0, stands, 0.0)
        if then == "two are refused":
            await task.ask("refused")
            task.clock.monotonic_s += 2.0
            await task.ask("refused too")
            await task.task._take(task.taken_up(task.references[0]))
        if then == "restarts":
            said, reference, sensors = task.said, task.references[-1], task.sensors  # type: ignore[attr-defined]
            task = task.restarted(model())
            task.said, task.sensors = said, sensors  # type: ignore[attr-defined]
            await task.task.recall()
            await task.task._take(task.taken_up(reference))
        await warming(task, 6.0, stands, JUDGED_MIN - 6.0)
        held = task.estimates[-1]
        await task.ask("r2")
        await warming(task, 3.0, stands, JUDGED_MIN)
        task.history.close()
        return held, task.estimates[-1]

    held, again = asyncio.run(play())
    right = bool(abs(held.thermal_error_um[0] - 2.0 * 0.4 * JUDGED_MIN) < 1.0)
    assert right is (before_min == 0.0)
    assert (held.confidence > 0.0) is right
    assert ("while the work was positioned" in held.inhibit) is not right
    assert again.confidence == 1.0 and again.inhibit == ""
