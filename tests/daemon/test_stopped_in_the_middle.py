"""A daemon that is killed, or told to end, at any call to the CNC of a probe, a release, a tool change or a retreat.

The next one ends within 1 um of what a daemon that lived on applies, or its output holds and says why.
"""

from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dying_daemon import ACTS, DyingLoop
from nc_requests import PROBE, TOOL_CHANGE, Z_AXIS, ask
from small_model import model
from whole_loop import WholeLoop

from models.control.state import OperatorRequest
from models.records import OutputState

pytestmark = pytest.mark.quiet

WITHIN_UM, ROUNDED_UM = 1.0, 0.1
MOMENTS, FEWEST_CALLS = 2, 8
"""So many moments are looked at from the act on, which have at least so many calls."""


def probe(loop: WholeLoop) -> None:
    ask(loop, 1, PROBE, Z_AXIS, 0.004)


def release(loop: WholeLoop) -> Coroutine[Any, Any, None]:
    loop.model = model("second", coefficients_um_per_k=np.vstack([np.full(5, 0.2), np.full(5, 2.0)]))
    return loop.use_model(loop.model)


def tool_change(loop: WholeLoop) -> None:
    loop.nc.tool_number = 2
    ask(loop, 1, TOOL_CHANGE, 0, 2.0)


def retreat(loop: WholeLoop) -> None:
    assert loop.rig.control.request(OperatorRequest(disable=frozenset({"y", "z"})), "a person") == ""


ACTIONS = (probe, release, tool_change, retreat)


@pytest.mark.parametrize("killed", [True, False], ids=["killed", "told to end"])
@pytest.mark.parametrize("act", ACTIONS)
async def test_wherever_the_daemon_ends_the_next_one_stands_where_it_would_or_holds(
    tmp_path: Path, act: Callable[[WholeLoop], Any], killed: bool
) -> None:
    twin = DyingLoop(tmp_path / "twin", act)
    await twin.run(None)
    assert twin.states[ACTS - 1] is OutputState.ACTIVE
    calls = MOMENTS * twin.nc.calls // (len(twin.states) - ACTS)
    assert calls >= FEWEST_CALLS
    wrong = {}
    for after in range(0, calls, 1 if killed else 2):  # to be told is tried at every second one
        loop = DyingLoop(tmp_path / f"after{after}", act, killed=killed, by_person=act is retreat)
        await loop.run(after)
        assert loop.nc.left is None, "it died"
        off_um = float(np.abs(loop.applied_um[-1] - twin.applied_um[-1]).max())
        if off_um > WITHIN_UM + ROUNDED_UM and loop.states[-1] is not OutputState.HOLD:
            wrong[after] = (off_um, loop.states[-1].value, loop.reasons[-1])
    assert not wrong
