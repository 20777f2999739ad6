"""What every source must do, whatever reads it and whatever it measures; `SourceBench` gives the checks one to try."""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pytest
from left_behind import leaves_nothing_behind

from config.schema.displacements import DisplacementSourceConfig
from config.schema.source_drivers import SourceConfig, SourceEntry
from drivers.contract import LinkError
from drivers.displacement.of_sources import SourceDisplacements
from drivers.readings import Row, RowSource
from models.quality import Quality, Reason

PATIENCE_S = 30.0
NAME = "box"


@dataclass(frozen=True, slots=True, kw_only=True)
class Measuring:
    """What the device of a bench measures: three inputs, the same on every wire."""

    inputs: dict[int | str, dict[str, Any]]
    """By key; what one source's inputs have in every configuration."""
    config: type[SourceEntry]
    listed: str
    words: tuple[str, str]
    """How faults name the first two."""
    unit: str

    @property
    def keys(self) -> list[int | str]:
        """Keys of the inputs in their order."""
        return list(self.inputs)

    def described(self, place: int, **about: Any) -> dict[str, Any]:
        """Return an input's description with where its number is found."""
        key = self.keys[place]
        return {("id" if isinstance(key, int) else "name"): key, **self.inputs[key], **about}


TEMPERATURES = Measuring(
    inputs={
        401: {"component": "Spindle unit", "part": "Housing", "label": "Nose", "open": [-999.0]},
        402: {"component": "Column", "min_degc": -10.0, "max_degc": 60.0, "open": [-999.0]},
        403: {"component": "Ambient", "label": "Room", "open": [-999.0]},
    },
    config=SourceConfig,
    listed="sensors",
    words=("sensor 401 (Spindle unit, Housing)", "sensor 402 (Column)"),
    unit="degC",
)
DISPLACEMENTS = Measuring(
    inputs={
        "Z1": {"axis": "z", "open": [-999.0]},
        "Y1": {"min_um": -10.0, "max_um": 60.0, "open": [-999.0]},
        "Weg X [um]": {"open": [-999.0]},
    },
    config=DisplacementSourceConfig,
    listed="channels",
    words=("channel Z1", "channel Y1"),
    unit="um",
)


class SourceBench(Protocol):
    """A device with three inputs, and the source that reads it."""

    measuring: Measuring

    def open(self) -> RowSource:
        """Return a new source."""
        ...

    async def show(self, *numbers: float | None) -> None:
        """Let the device give these numbers from now on; an input with None gives none."""
        ...

    async def lose(self) -> None:
        """Let the device go away."""
        ...

    async def bring_back(self) -> None:
        """Let the device be there again."""
        ...


Check = Callable[[SourceBench], Awaitable[None]]


async def until(rows: AsyncIterator[Row], wanted: Callable[[Row], bool]) -> Row:
    """Return the first row that is as wanted."""
    async with asyncio.timeout(PATIENCE_S):
        async for row in rows:
            if wanted(row):
                return row
    raise AssertionError("the source ended")


async def a_row_holds_every_input_in_the_order_of_the_configuration(bench: SourceBench) -> None:
    await bench.show(21.5, -3.25, 40.0)
    source = bench.open()
    assert source.name == NAME
    async with aclosing(source.rows()) as rows:
        row = await until(rows, lambda row: bool(np.isfinite(row.values).all()))
    assert list(row.values) == pytest.approx([21.5, -3.25, 40.0])
    assert list(row.reason) == [Reason.NONE] * 3 and row.number >= 1
    assert row.trace.first_byte.real_s <= row.trace.last_byte.real_s


async def rows_come_to_the_daemon_as_what_they_measure(bench: SourceBench) -> None:
    await bench.show(21.5, -3.25, 40.0)
    if bench.measuring is DISPLACEMENTS:
        reached: list[int] = []
        samples = SourceDisplacements(bench.open()).samples(lambda _: None, lambda: reached.append(1))
        async with asyncio.timeout(PATIENCE_S), aclosing(samples):
            async for sample in samples:
                if np.isfinite(sample.um).all():
                    break
        assert list(sample.um) == pytest.approx([21.5, -3.25, 40.0]) and list(sample.reason) == [Reason.NONE] * 3
        assert sample.source == f"source {NAME}" and reached
        assert abs(sample.utc_s - time.time()) < PATIENCE_S
        return
    cycles = bench.open().cycles()
    async with asyncio.timeout(PATIENCE_S), aclosing(cycles):
        async for cycle in cycles:
            if cycle.complete and np.isfinite(cycle.degc).all():
                break
    assert cycle.line == NAME and list(cycle.degc) == pytest.approx([21.5, -3.25, 40.0])
    assert list(cycle.quality) == [Quality.GOOD] * 3 and list(cycle.reason) == [Reason.NONE] * 3


async def a_new_number_is_a_new_value(bench: SourceBench) -> None:
    await bench.show(20.0, 20.0, 20.0)
    async with aclosing(bench.open().rows()) as rows:
        first = await until(rows, lambda row: row.values[0] == 20.0)
        await bench.show(20.5, 20.5, 20.5)
        second = await until(rows, lambda row: bool((row.values == 20.5).all()))
    assert second.number > first.number
    assert second.trace.first_byte.monotonic_s >= first.trace.first_byte.monotonic_s


async def what_is_no_value_never_passes(bench: SourceBench) -> None:
    await bench.show(-999.0, 60.5, 20.0)
    async with aclosing(bench.open().rows()) as rows:
        row = await until(rows, lambda row: row.values[2] == 20.0)
    assert np.isnan(row.values[:2]).all()
    assert list(row.reason) == [Reason.DEVICE_ERROR, Reason.OUT_OF_RANGE, Reason.NONE]
    named = [fault for fault in row.faults if f"source {NAME}" in fault]
    first, second = bench.measuring.words
    assert any(first in fault and "open" in fault for fault in named), row.faults
    span = f"outside -10 to 60 {bench.measuring.unit}"
    assert any(second in fault and span in fault for fault in named), row.faults


async def an_input_without_a_number_is_not_received_and_named(bench: SourceBench) -> None:
    await bench.show(20.0, None, 20.0)
    async with aclosing(bench.open().rows()) as rows:
        row = await until(rows, lambda row: bool(np.isfinite(row.values[[0, 2]]).all()))
        assert np.isnan(row.values[1])
        assert row.reason[1] != Reason.NONE
        assert any(f"source {NAME}" in fault and bench.measuring.words[1] in fault for fault in row.faults), row.faults


async def a_lost_device_is_a_link_error_that_names_the_source_and_a_new_one_comes_back(bench: SourceBench) -> None:
    await bench.show(20.0, 20.0, 20.0)
    for _ in range(2):
        source = bench.open()
        async with aclosing(source.rows()) as rows:
            await until(rows, lambda row: row.values[0] == 20.0)
            await bench.lose()
            with pytest.raises(LinkError, match=f"source {NAME}"):
                await until(rows, lambda row: False)
        with pytest.raises(LinkError, match=f"source {NAME}"):
            await until(bench.open().rows(), lambda row: False)
        await bench.bring_back()
        await bench.show(20.0, 20.0, 20.0)


async def closing_ends_the_rows_at_any_time_and_more_than_once(bench: SourceBench) -> None:
    await bench.show(20.0, 20.0, 20.0)
    never = bench.open()
    await never.close()
    await never.close()

    async def follow(source: RowSource) -> None:
        async for _ in source.rows():
            pass

    for wait_s in (0.0, 0.004, 0.008, 0.016, 0.05):  # before it is asked for anything, while it opens, at work
        source = bench.open()
        task = asyncio.create_task(follow(source))
        await asyncio.sleep(wait_s)
        await source.close()
        await source.close()
        async with asyncio.timeout(PATIENCE_S):
            await task
        with pytest.raises(RuntimeError, match="used once"):
            await anext(source.rows())


async def twenty_sources_leave_nothing_open(bench: SourceBench) -> None:
    await bench.show(20.0, 20.0, 20.0)

    async def one() -> None:
        async with aclosing(bench.open().rows()) as rows:
            await until(rows, lambda row: row.values[0] == 20.0)

    async def twenty() -> None:
        for _ in range(20):
            await one()

    await one()
    tasks = len(asyncio.all_tasks())
    await leaves_nothing_behind(twenty, within_s=PATIENCE_S)
    async with asyncio.timeout(PATIENCE_S):
        while len(asyncio.all_tasks()) > tasks:
            await asyncio.sleep(0.01)


CHECKS: tuple[Check, ...] = (
    a_row_holds_every_input_in_the_order_of_the_configuration,
    rows_come_to_the_daemon_as_what_they_measure,
    a_new_number_is_a_new_value,
    what_is_no_value_never_passes,
    an_input_without_a_number_is_not_received_and_named,
)
"""Of what a source measures."""
WIRE_CHECKS: tuple[Check, ...] = (
    a_lost_device_is_a_link_error_that_names_the_source_and_a_new_one_comes_back,
    closing_ends_the_rows_at_any_time_and_more_than_once,
    twenty_sources_leave_nothing_open,
)
"""Of how it is opened, lost and closed, whatever it measures."""
