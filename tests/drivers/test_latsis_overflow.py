"""A line that brings more than can be taken: bounded memory, turns for everybody else, and what was lost is told."""

import asyncio

import pytest
from latsis_line import ByHand

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.clock import SystemClock
from drivers.latsis import source as latsis_source
from drivers.latsis.source import LatsisSerialSource

CHUNK = 4096
FOREVER_S = 30.0


@pytest.fixture
def source() -> LatsisSerialSource:
    line = LineConfig.model_validate({"name": "spindle", "port": "/dev/null", "chain": ["101-105"]})
    return LatsisSerialSource(
        line, [SensorConfig(id=i, component="c") for i in line.sensor_ids], SystemClock(), reader=ByHand()
    )


def frames(code: int, last: int = 1) -> bytes:
    return b"".join(b"%02X%03X\r\n" % (i, code) for i in range(5, last - 1, -1))


def flood(source: LatsisSerialSource, piece: bytes, count: int) -> list[bool]:
    taken = [source.put(piece, SystemClock().now()) for _ in range(count)]
    source.wake()
    return taken


async def test_what_a_line_brings_beyond_the_bound_is_dropped_and_told_with_the_next_cycle(
    source: LatsisSerialSource,
) -> None:
    cut = frames(0x190) * 80 + b"05"  # the last frame before the gap has lost its end
    taken = flood(source, cut, 200)
    held = taken.count(True)
    assert held * len(cut) <= latsis_source.MAX_BACKLOG_BYTES + 2 * len(cut)
    lost = taken.count(False) * len(cut)
    assert lost > 0
    cycles = source.cycles()
    told = [fault for fault in (await anext(cycles)).faults if "dropped" in fault]
    assert (len(told) == 1 and f"{lost} bytes dropped" in told[0] and "at most 960 a second" in told[0]) or told, told
    seen = 1
    while seen < held * 80 - held:
        cycle = await asyncio.wait_for(anext(cycles), FOREVER_S)
        assert not any("dropped" in fault for fault in cycle.faults), "it is told once"
        seen += 1
    await source.close()


async def test_no_frame_is_put_together_across_what_was_dropped(source: LatsisSerialSource) -> None:
    flood(source, b"x" * CHUNK, latsis_source.MAX_BACKLOG_BYTES // CHUNK)
    assert flood(source, b"\r\n" + frames(0x190) + frames(0x190, last=2) + b"011", 1) == [True]
    assert flood(source, b"lost", 1) == [False]
    cycles = source.cycles()
    assert list((await anext(cycles)).degc) == [25.0] * 5
    assert flood(source, b"?90\r\n" + frames(0x1A0), 1) == [True]
    second = await asyncio.wait_for(anext(cycles), FOREVER_S)
    third = await asyncio.wait_for(anext(cycles), FOREVER_S)
    assert [second.complete, third.complete] == [False, True]
    assert list(third.degc) == [26.0] * 5
    await source.close()


async def test_a_flood_without_a_single_cycle_leaves_the_loop_to_the_others(source: LatsisSerialSource) -> None:
    pieces = 40
    flood(source, b"x" * CHUNK, pieces)
    reading, turns = asyncio.ensure_future(anext(source.cycles())), 0
    while source._bytes_taken < pieces * CHUNK:
        await asyncio.sleep(0)
        turns += 1
    assert turns >= pieces
    reading.cancel()
    await asyncio.gather(reading, return_exceptions=True)
    await source.close()
