"""Random histories over the wire of every dialect: the tool is never moved wrongly without a word."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import pytest
from cnc_histories import Shop, played
from cnc_wire import DIALECTS, serving

PLAIN, SLOPED, TOOLS, EXPANDING, BY_PLACE = 2, 5, 57, 9, 5
"""Seeds: a machine with a slope, one whose tools are set, or expand, and one whose guard puts a slope in by place."""
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
    shop.nc.guard.control.external_mm[shop.machine.places["z"]] += 0.003


def tilted(shop: Shop) -> None:
    """The same of a slope: 2.5 um at the ends of the travel."""
    shop.nc.guard.control.slopes[shop.machine.places["z_slope"]] += 1e-5


def another_answer(shop: Shop) -> None:
    """A daemon that counts from another error than that of the positioning."""
    for error_um in shop.at_reference.values():
        error_um["z"] += 3.0


def another_temperature(shop: Shop) -> None:
    """A daemon whose tool expands from another temperature than it had when the work was positioned."""
    for reference_id in shop.degc_at_reference:
        shop.degc_at_reference[reference_id] += 1.0


def another_slope(shop: Shop) -> None:
    """A daemon that lets the guard put a slope into the offset that is 3 um off at the ends of the travel."""
    for error_um in shop.at_reference.values():
        error_um["z_slope"] += 12.0


def set_elsewhere(shop: Shop) -> None:
    """A daemon that lets every tool count from another setting than the machine's."""
    assert shop.rig is not None and shop.rig.control.memory is not None
    memory = shop.rig.control.memory
    if shop.nc.tool_number not in memory.tools:
        shop.then(shop.turn_number + 1, set_elsewhere)
        return
    off = {number: replace(tool, baseline_um=tool.baseline_um + 3.0) for number, tool in memory.tools.items()}
    shop.rig.control.memory = replace(memory, tools=MappingProxyType(off))


@pytest.mark.parametrize(
    ("dialect", "seed", "wrong"),
    [
        ("opcua", PLAIN, shifted),
        ("opcua", PLAIN, another_answer),
        ("sinumerik", SLOPED, tilted),
        ("opcua", TOOLS, set_elsewhere),
        ("opcua", EXPANDING, another_temperature),
        ("focas", BY_PLACE, another_slope),
    ],
)
async def test_the_judge_sees_a_tool_that_is_moved_wrongly(
    tmp_path: Path, dialect: str, seed: int, wrong: Callable[[Shop], None]
) -> None:
    async with serving(dialect, tmp_path) as served:
        shop = Shop(served, tmp_path, seed, attacked=False)
        shop.then(100, wrong)
        await shop.play()
        assert shop.ends == "ACTIVE" and "um off" in shop.verdict()
