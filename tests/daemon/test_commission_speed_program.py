"""Commissioning with a tuned spindle speed: the control must run the configuration's speed program; over OPC UA."""

from pathlib import Path
from typing import Any

import pytest
from commissioning_bench import Bench, Person, refused, served_by_opcua, set_back
from speed_machine import speed_machine

from drivers.guard.speed_text import speed_text_number

TEXT = 548
"""The variable in which the speed program tells its text, one that the bench's server has."""
pytestmark = pytest.mark.asyncio(loop_scope="module")
served, bench = served_by_opcua, set_back


def tuned(content: dict[str, Any]) -> None:
    """The bench's machine with the tuning of the speed."""
    folder = Path(content["history"]["path"]).parent
    tuning = speed_machine(folder).spindle_speed
    assert tuning is not None
    content["spindle_speed"] = tuning.model_dump(mode="json")
    content["spindle_speed"]["macros"]["called_text"] = TEXT
    content["cnc"]["macros"]["writable"] += ["121"]


async def test_a_speed_program_that_has_not_run_is_asked_for(bench: Bench) -> None:
    bench.machine.nc.macros.set(TEXT, None)
    said = await refused(bench, change=tuned, axes=("z",))
    assert "has not told its text" in said
    assert "G65 P9020" in said
    assert bench.at_rest()


async def test_another_text_is_refused_and_the_own_one_is_taken(bench: Bench) -> None:
    number = speed_text_number(bench.configuration(tuned))
    bench.machine.nc.macros.set(TEXT, number + 1.0)
    said = await refused(bench, change=tuned, axes=("z",))
    assert f"text {number + 1}" in said
    assert f"the configuration's is {number}" in said
    bench.machine.nc.macros.set(TEXT, float(number))
    person = Person(bench)
    assert await bench.commission(person, change=tuned, axes=("z",)) is not None
    assert "The speed program is the configuration's" in person.text_said


async def test_without_the_tuning_nobody_asks(bench: Bench) -> None:
    bench.machine.nc.macros.set(TEXT, 1.0)
    assert await bench.commission(Person(bench), axes=("z",)) is not None
