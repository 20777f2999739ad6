"""Random histories over the wire of every dialect: the tool is never moved wrongly without a word."""

from collections.abc import Callable
from pathlib import Path

import pytest
from cnc_histories import Shop, played
from cnc_wire import DIALECTS, serving

SOME, MANY = {"haas": 1}, 2
"""Histories of each dialect that are always played, where not two, and those beyond them."""


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_some_histories_of_a_control_move_the_tool_nowhere_wrong(dialect: str, tmp_path: Path) -> None:
    tally = await played(dialect, range(SOME.get(dialect, 2)), tmp_path)
    assert tally.wrong == [] and tally.motions > 0


@pytest.mark.slow
@pytest.mark.parametrize("dialect", DIALECTS)
async def test_many_histories_of_a_control_move_the_tool_nowhere_wrong(
    dialect: str, tmp_path: Path, times_as_many: int
) -> None:
    tally = await played(dialect, range(2, 2 + MANY * times_as_many), tmp_path)
    assert tally.wrong == []


def shifted(shop: Shop) -> None:
    """Somebody moves the offset, and the daemon of a control whose offset is not watched cannot know."""
    shop.nc.guard.control.external_mm[2] += 0.003


def another_answer(shop: Shop) -> None:
    """A daemon that counts from another error than that of the positioning."""
    for error_um in shop.at_reference.values():
        error_um["z"] += 3.0


@pytest.mark.parametrize("wrong", [shifted, another_answer])
async def test_the_judge_sees_a_tool_that_is_moved_wrongly(tmp_path: Path, wrong: Callable[[Shop], None]) -> None:
    async with serving("opcua", tmp_path) as served:
        shop = Shop(served, tmp_path, 1, attacked=False)
        shop.then(100, wrong)
        await shop.play()
        assert shop.ends == "ACTIVE" and "um off" in shop.verdict()
