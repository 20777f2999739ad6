"""What commissioning does with the macro variables of the spindle speed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commissioning_bench import Bench, Person, refused, served_by_opcua, set_back
from speed_machine import MACROS, speed_machine

from models.records import WriteOutcome

pytestmark = pytest.mark.asyncio(loop_scope="module")
served, bench = served_by_opcua, set_back


@pytest.fixture
def tuned(tmp_path: Path) -> Callable[[dict[str, Any]], None]:
    """Add the section to a configuration."""
    section = speed_machine(tmp_path).spindle_speed
    assert section is not None

    def change(content: dict[str, Any]) -> None:
        content["spindle_speed"] = section.model_dump(mode="json")
        content["cnc"]["macros"]["writable"] = [*content["cnc"]["macros"]["writable"], "121"]

    return change


async def test_vacant_ones_are_set_to_zero_in_the_order_of_a_write(bench: Bench, tuned: Callable) -> None:
    bench.machine.nc.macros.set(MACROS.valid_until, None)
    for number in set(MACROS.ours) - {MACROS.valid_until}:
        bench.machine.nc.macros.set(number, None)
    await bench.commission(Person(bench), change=tuned, initialise_only=True)
    assert {bench.macro(number) for number in MACROS.ours if number != MACROS.valid_until} == {0.0}
    assert bench.macro(MACROS.valid_until) is None
    assert bench.macro(MACROS.calls) is None  # the NC's own
    (record,) = [each for each in bench.writes() if MACROS.enable in dict(each.macros)]
    assert record.outcome is WriteOutcome.VERIFIED
    order = [number for number, _ in record.macros]
    assert order.index(MACROS.sequence_a) < order.index(MACROS.enable) < order.index(MACROS.sequence_b)


async def test_foreign_ones_are_left_alone_unless_a_person_says_so(bench: Bench, tuned: Callable) -> None:
    for number in MACROS.ours:
        bench.machine.nc.macros.set(number, 0.0)
    bench.machine.nc.macros.set(MACROS.speed, 9999.0)
    person = Person(bench)
    person.denies = "Overwrite"
    assert f"#{MACROS.speed} = 9999" in await refused(bench, person, change=tuned, initialise_only=True)
    assert bench.macro(MACROS.speed) == 9999.0
    await bench.commission(Person(bench), change=tuned, initialise_only=True)
    assert bench.macro(MACROS.speed) == 0.0
