"""The axis position that a model needs is lost while the output follows: it holds, says why, and comes back to a twin.

Thermal task, control task and the guard's text on the clock of the test; the twin's axis moves in the same way and is
never lost.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_model import model
from twin_loop import BEFORE, TwinLoop, some_places
from whole_loop import MOMENT_S, lagged_model, loop_machine

from config.schema import Configuration
from config.schema.cnc import AxisPositionConfig
from drivers.contract import Capability, LinkError
from models.records import CncRun, FloatArray, OutputState
from models.thermal.family import ThermalModel

pytestmark = pytest.mark.quiet

AXIS = AxisPositionConfig(axis="Z", travel_mm=(0.0, 500.0), rapid_mm_per_min=6000.0)
LOST = 9
"""The position is lost for so many moments of ten seconds."""
AFTER = 30
WITHIN_UM = 1.1
"""One micrometre, and a tenth to which the control rounds on both."""
MEAN = 6
"""A position that is back counts when its mean is whole, after so many moments."""
SLEWED = 3
"""The output then goes to where the twin's is at the slew rate."""
HOLD_LIMIT = 60
"""Moments of `hold_limit_s`."""
Loss = Callable[["Travelling"], None]


def with_axis(directory: Path) -> Configuration:
    """The whole loop's machine; an estimate's position is from the poll ten seconds before."""
    whole = loop_machine(directory, "bumpless")
    cnc = whole.cnc.model_copy(update={"axis_positions": {"Z_mm": AXIS}, "stale_after_s": 1.5 * MOMENT_S})
    return whole.model_copy(update={"cnc": cnc})


MODELS: dict[str, ThermalModel] = {
    "increments": model("increments", axis_positions=("Z_mm",)),
    "lagged": lagged_model("lagged", ("Z_mm",)),
}


class Travelling(TwinLoop):
    """A machine whose axis travels; `lose` says in each moment in which its position is lost how."""

    lose: Loss | None = None
    lost_for = LOST
    positioned_at: int | None = None
    """Moment in which the work is positioned again."""
    reasons: list[str]

    async def _program(self) -> None:
        nc, self.reasons = self.loop.nc, getattr(self, "reasons", [])
        self.mm = 250.0 + 150.0 * np.sin(max(self.moment - 72, 0) / 9.0)
        nc.positions_mm, nc.reachable = {"Z_mm": self.mm}, True
        nc.cannot.pop(Capability.AXIS_POSITION, None)
        if self.lose is not None and 0 <= self.moment - BEFORE < self.lost_for:
            self.lose(self)
        if self.moment >= BEFORE and (memory := self.loop.rig.control.memory) is not None:
            self.reasons.append(memory.reason)
        if self.positioned_at is not None and (at := self.moment - BEFORE - self.positioned_at) in (0, 2):
            nc.run, nc.sequence_number = (CncRun.START, 100) if at == 0 else (CncRun.STOP, 900)
        await super()._program()


def gives(mm: float) -> Loss:
    return lambda loop: loop.loop.nc.positions_mm.update(Z_mm=mm)


def named_by_nobody(loop: Travelling) -> None:
    loop.loop.nc.positions_mm = {}


def refused(loop: Travelling) -> None:
    loop.loop.nc.positions_mm["Z_mm"] = np.nan
    loop.loop.nc.cannot[Capability.AXIS_POSITION] = "the server gives no value"


def half_open(loop: Travelling) -> None:
    loop.loop.nc.breaks = LinkError("no answer within 5 s")


def link_lost(loop: Travelling) -> None:
    loop.loop.nc.reachable = False


POSITION: dict[str, tuple[Loss, str]] = {
    "none": (named_by_nobody, "the control gives none now"),
    "nan": (gives(np.nan), "the control gives none now"),
    "refused": (refused, "the server gives no value"),
    "outside": (gives(9.8e3), "outside the travel"),
}
LINK = {"half-open": half_open, "lost": link_lost}
_twins: dict[str, list[FloatArray]] = {}


def played(
    directory: Path, name: str, lose: Loss | None = None, lost_for: int = LOST, positioned_at: int | None = None
) -> Travelling:
    """Warm up, position the work, follow, lose the position, and go on."""
    places = some_places(np.random.default_rng(3))
    loop = Travelling(directory, MODELS[name], places, "bare", configuration=with_axis(directory))
    loop.lose, loop.lost_for, loop.positioned_at = lose, lost_for, positioned_at
    asyncio.run(loop.run(lost_for + AFTER))
    return loop


def off_um(tmp_path: Path, name: str, loop: Travelling) -> FloatArray:
    """Return how far from its twin the tool stands in each moment [um]."""
    if name not in _twins:
        twin = played(tmp_path / "twin", name)
        assert set(twin.states) == {OutputState.ACTIVE}
        _twins[name] = twin.applied_um
    found: FloatArray = np.abs(np.array(loop.applied_um) - np.array(_twins[name])).max(axis=1)
    return found


@pytest.mark.parametrize(("kind", "name"), [*((kind, "increments") for kind in POSITION), ("none", "lagged")])
def test_a_position_that_is_lost_holds_at_once_and_comes_back_to_where_the_twin_is(
    tmp_path: Path, kind: str, name: str
) -> None:
    lose, words = POSITION[kind]
    loop = played(tmp_path / "loop", name, lose)
    held = [state is OutputState.HOLD for state in loop.states]
    back = LOST + MEAN
    assert held == [1 <= moment < back for moment in range(LOST + AFTER)], "from the next estimate on"
    assert words in loop.reasons[LOST] and "needs the position of axis Z (Z_mm)" in loop.reasons[LOST]
    moved_um = np.abs(np.diff(loop.applied_um[1 : LOST + 1], axis=0))
    assert not moved_um.any(), "and nothing moves the tool meanwhile"
    off = off_um(tmp_path, name, loop)
    assert off[back - 1] > 4.0, "the twin went on"
    assert off[back + SLEWED :].max() <= WITHIN_UM


@pytest.mark.parametrize("kind", LINK)
def test_a_link_that_takes_the_position_with_it_holds_until_the_work_is_positioned_again(
    tmp_path: Path, kind: str
) -> None:
    loop = played(tmp_path / "loop", "increments", LINK[kind], positioned_at=LOST + 5)
    again = loop.states.index(OutputState.ACTIVE)
    assert set(loop.states[:again]) == {OutputState.HOLD} and LOST + 5 < again <= LOST + 5 + MEAN
    assert loop.reasons[3] == "no link to the CNC"
    assert "so a positioning may have been missed" in loop.reasons[LOST + 3]
    assert set(loop.states[again:]) == {OutputState.ACTIVE}
    still = np.abs(np.array(loop.applied_um[: again - 1]) - loop.applied_um[0])
    assert not still.any(), "neither the loss nor the reference moves the tool"


def test_a_position_that_is_lost_for_longer_than_the_limit_lets_the_output_retreat_to_the_baseline(
    tmp_path: Path,
) -> None:
    loop = played(tmp_path / "loop", "increments", named_by_nobody, HOLD_LIMIT + 10)
    left = [moment for moment, state in enumerate(loop.states) if state is OutputState.RETREAT]
    assert abs(left[0] - HOLD_LIMIT) <= 2 and loop.states[-1] is OutputState.OFF
    assert "held too long" in loop.reasons[left[0] + 1] and "needs the position of axis Z" in loop.reasons[left[0] + 1]
    assert not np.array(loop.applied_um[-1]).any(), "where it stood at the reference"
