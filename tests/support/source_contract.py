"""What every source of temperatures must do, whatever reads it; `SourceBench` gives the checks one to try it on."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import aclosing
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest

from drivers.contract import LinkError, TemperatureSource
from models.quality import Quality, Reason
from models.records import TemperatureCycle

PATIENCE_S = 30.0
NAME = "box"
SENSORS: dict[int, dict[str, Any]] = {
    401: {"component": "Spindle unit", "part": "Housing", "label": "Nose", "open": [-999.0]},
    402: {"component": "Column", "min_degc": -10.0, "max_degc": 60.0, "open": [-999.0]},
    403: {"component": "Ambient", "label": "Room", "open": [-999.0]},
}
"""By ID; what one source's sensors have in every configuration."""


class SourceBench(Protocol):
    """A device with three sensors, and the source that reads it."""

    def open(self) -> TemperatureSource:
        """Return a new source."""
        ...

    async def show(self, numbers: dict[int, float]) -> None:
        """Let the device give these numbers from now on; a sensor that is not named gives none."""
        ...

    async def lose(self) -> None:
        """Let the device go away."""
        ...

    async def bring_back(self) -> None:
        """Let the device be there again."""
        ...


Check = Callable[[SourceBench], Awaitable[None]]


async def until(
    cycles: AsyncIterator[TemperatureCycle], wanted: Callable[[TemperatureCycle], bool]
) -> TemperatureCycle:
    """Return the first cycle that is as wanted."""
    async with asyncio.timeout(PATIENCE_S):
        async for cycle in cycles:
            if wanted(cycle):
                return cycle
    raise AssertionError("the source ended")


async def a_cycle_holds_every_sensor_in_the_order_of_the_configuration(bench: SourceBench) -> None:
    await bench.show({401: 21.5, 402: -3.25, 403: 40.0})
    source = bench.open()
    assert source.name == NAME
    async with aclosing(source.cycles()) as cycles:
        cycle = await until(cycles, lambda cycle: bool(np.isfinite(cycle.degc).all()))
    assert cycle.line == NAME
    assert list(cycle.degc) == pytest.approx([21.5, -3.25, 40.0])
    assert list(cycle.quality) == [Quality.GOOD] * 3 and list(cycle.reason) == [Reason.NONE] * 3
    assert cycle.complete and cycle.number >= 1
    assert cycle.trace.first_byte.real_s <= cycle.trace.last_byte.real_s


async def a_new_number_is_a_new_temperature(bench: SourceBench) -> None:
    await bench.show({401: 20.0, 402: 20.0, 403: 20.0})
    async with aclosing(bench.open().cycles()) as cycles:
        first = await until(cycles, lambda cycle: cycle.degc[0] == 20.0)
        await bench.show({401: 20.5, 402: 20.5, 403: 20.5})
        second = await until(cycles, lambda cycle: bool((cycle.degc == 20.5).all()))
    assert second.number > first.number
    assert second.trace.first_byte.monotonic_s >= first.trace.first_byte.monotonic_s


async def what_is_no_temperature_never_passes(bench: SourceBench) -> None:
    await bench.show({401: -999.0, 402: 60.5, 403: 20.0})
    async with aclosing(bench.open().cycles()) as cycles:
        cycle = await until(cycles, lambda cycle: cycle.degc[2] == 20.0)
    assert np.isnan(cycle.degc[:2]).all()
    assert list(cycle.quality) == [Quality.MISSING, Quality.MISSING, Quality.GOOD]
    assert list(cycle.reason) == [Reason.DEVICE_ERROR, Reason.OUT_OF_RANGE, Reason.NONE]
    named = [fault for fault in cycle.faults if f"source {NAME}" in fault]
    assert any("401 (Spindle unit, Housing)" in fault and "open" in fault for fault in named), cycle.faults
    assert any("402 (Column)" in fault and "outside -10 to 60 degC" in fault for fault in named), cycle.faults


async def a_sensor_without_a_number_is_not_received_and_named(bench: SourceBench) -> None:
    await bench.show({401: 20.0, 403: 20.0})
    async with aclosing(bench.open().cycles()) as cycles:
        cycle = await until(cycles, lambda cycle: bool(np.isfinite(cycle.degc[[0, 2]]).all()))
        assert np.isnan(cycle.degc[1]) and cycle.quality[1] == Quality.MISSING
        assert cycle.reason[1] != Reason.NONE
        assert any(f"source {NAME}" in fault and "402 (Column)" in fault for fault in cycle.faults), cycle.faults


async def a_lost_device_is_a_link_error_that_names_the_source_and_a_new_one_comes_back(bench: SourceBench) -> None:
    await bench.show({401: 20.0, 402: 20.0, 403: 20.0})
    for _ in range(2):
        source = bench.open()
        async with aclosing(source.cycles()) as cycles:
            await until(cycles, lambda cycle: cycle.degc[0] == 20.0)
            await bench.lose()
            with pytest.raises(LinkError, match=f"source {NAME}"):
                await until(cycles, lambda cycle: False)
        with pytest.raises(LinkError, match=f"source {NAME}"):
            await until(bench.open().cycles(), lambda cycle: False)
        await bench.bring_back()
        await bench.show({401: 20.0, 402: 20.0, 403: 20.0})


async def closing_ends_the_cycles_at_any_time_and_more_than_once(bench: SourceBench) -> None:
    await bench.show({401: 20.0, 402: 20.0, 403: 20.0})
    never = bench.open()
    await never.close()
    await never.close()
    source = bench.open()

    async def follow() -> None:
        async for _ in source.cycles():
            pass

    task = asyncio.create_task(follow())
    await asyncio.sleep(0.05)
    await source.close()
    await source.close()
    async with asyncio.timeout(PATIENCE_S):
        await task
    with pytest.raises(RuntimeError, match="used once"):
        await anext(source.cycles())


async def twenty_sources_leave_nothing_open(bench: SourceBench) -> None:
    await bench.show({401: 20.0, 402: 20.0, 403: 20.0})

    async def one() -> None:
        async with aclosing(bench.open().cycles()) as cycles:
            await until(cycles, lambda cycle: cycle.degc[0] == 20.0)

    await one()
    tasks = len(asyncio.all_tasks())
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(20):
        await one()
    async with asyncio.timeout(PATIENCE_S):
        while len(list(Path("/proc/self/fd").iterdir())) > before or len(asyncio.all_tasks()) > tasks:
            await asyncio.sleep(0.01)


CHECKS: tuple[Check, ...] = (
    a_cycle_holds_every_sensor_in_the_order_of_the_configuration,
    a_new_number_is_a_new_temperature,
    what_is_no_temperature_never_passes,
    a_sensor_without_a_number_is_not_received_and_named,
    a_lost_device_is_a_link_error_that_names_the_source_and_a_new_one_comes_back,
    closing_ends_the_cycles_at_any_time_and_more_than_once,
    twenty_sources_leave_nothing_open,
)
