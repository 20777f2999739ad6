"""What every driver of a CNC must do, whatever its protocol; `Bench` gives the checks a control to try it on.

A driver that says it cannot write passes them too: where others write it refuses with a sentence, before anything is
sent, and no macro variable of it ever has a value.
"""

import asyncio
import gc
import math
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import pytest

from config.schema.cnc import AxisPositionConfig
from drivers.contract import Capability, Cnc, DriverError, FatalDriverError, LinkError, NotSentError
from drivers.sim.wires.tcp_relay import TcpRelay
from models.records import CncSample

GROUPS = [[(500, 1.0)], [(501, 0.004), (503, 0.0105)], [(505, 1.0)]]
FORBIDDEN = 599


class Bench(Protocol):
    """One control that a driver can be tried on. It takes #500 to #505, and #502 is vacant."""

    def open(self, **changes: Any) -> Cnc:
        """Return a new driver; `changes` go to the CNC's section."""
        ...

    async def lose(self) -> None:
        """Let the control go away."""
        ...

    def refuse(self, number: int) -> None:
        """Let the control refuse this macro variable."""
        ...


class WireBench(Bench, Protocol):
    """A control behind a TCP port."""

    @property
    def port(self) -> int:
        """Where it listens."""
        ...

    def open_at(self, port: int, **changes: Any) -> Cnc:
        """Return a new driver for another port of this computer."""
        ...

    def written(self) -> list[int]:
        """Return the numbers that were written so far, in their order."""
        ...

    def mistype(self, number: int) -> None:
        """Let the control show words where the number of this macro variable, or of the spindle speed, stands."""
        ...


Check = Callable[[Bench], Awaitable[None]]
WireCheck = Callable[[WireBench], Awaitable[None]]
IMPATIENT_S = 0.3


async def connected(bench: Bench, **changes: Any) -> Cnc:
    cnc = bench.open(**changes)
    await cnc.connect()
    return cnc


def writes(cnc: Cnc) -> bool:
    """Return whether the driver claims to write; one that does not says that it reads no macro variable either."""
    claims = Capability.WRITE_MACROS not in cnc.cannot
    assert claims or Capability.READ_MACROS in cnc.cannot
    return claims


async def written(cnc: Cnc, groups: Sequence[Sequence[tuple[int, float]]]) -> bool:
    """Write, and return True; a driver that cannot refuses with a sentence and the remedy, and this returns False."""
    if writes(cnc):
        await cnc.write_macros(groups)
        return True
    with pytest.raises(NotSentError, match=r"^nothing was sent: .*another driver.* \(cnc\.driver\)$"):
        await cnc.write_macros(groups)
    numbers = [number for group in groups for number, _ in group]
    assert await cnc.read_macros(numbers) == dict.fromkeys(numbers)
    return False


async def identity_stays(bench: Bench) -> None:
    first, second = await connected(bench), await connected(bench)
    assert first.identity == second.identity != ""
    assert bench.open().security in ("encrypted", "insecure")
    await first.close()
    await second.close()


async def one_read_gives_state_and_macros(bench: Bench) -> None:
    cnc = await connected(bench)
    arrived = await written(cnc, GROUPS)
    sample = await cnc.read([501, 502])
    assert isinstance(sample, CncSample) and math.isfinite(sample.clock_s)
    assert sample.macros == ({501: 0.004, 502: None} if arrived else {501: None, 502: None})
    found = await cnc.read_macros([503, 502, 500])
    assert found == ({503: 0.0105, 502: None, 500: 1.0} if arrived else dict.fromkeys((503, 502, 500)))
    await cnc.close()


async def nothing_follows_a_refused_value(bench: Bench) -> None:
    cnc = await connected(bench)
    if await written(cnc, [[(500, 7.0)], [(505, 7.0)]]):
        bench.refuse(501)
        with pytest.raises(FatalDriverError, match="#501") as refused:
            await cnc.write_macros(GROUPS)
        assert not isinstance(refused.value, NotSentError), "sequence_a has arrived"
        assert await cnc.read_macros([500, 505]) == {500: 1.0, 505: 7.0}
    await cnc.close()


async def what_must_not_be_written_is_refused_before_anything_is_sent(bench: Bench) -> None:
    cnc = await connected(bench)
    arrived = await written(cnc, [[(500, 7.0)]])
    for number, value in ((501, math.nan), (501, math.inf), (FORBIDDEN, 1.0)):
        with pytest.raises(NotSentError, match=f"#{number}" if arrived else "nothing was sent"):
            await cnc.write_macros([[(500, 1.0)], [(number, value)]])
    assert await cnc.read_macros([500]) == {500: 7.0 if arrived else None}
    await cnc.close()


async def an_insecure_connection_needs_to_be_allowed(bench: Bench) -> None:
    cnc = await connected(bench, allow_insecure_writes=False)
    if cnc.security == "insecure" and writes(cnc):
        with pytest.raises(FatalDriverError, match=r"set cnc\.allow_insecure_writes: true"):
            await cnc.write_macros(GROUPS)
    await cnc.close()


async def close_is_for_any_time(bench: Bench) -> None:
    cnc = bench.open()
    await cnc.close()
    cnc = await connected(bench)
    await cnc.close()
    await cnc.close()
    with pytest.raises(LinkError):
        await cnc.read([500])
    with pytest.raises(LinkError):
        await cnc.write_macros(GROUPS)


async def a_control_that_went_away_is_a_lost_link(bench: Bench) -> None:
    cnc = await connected(bench)
    await bench.lose()
    with pytest.raises(LinkError):
        await cnc.read([500])
    with pytest.raises(LinkError):
        await cnc.write_macros(GROUPS)
    await cnc.close()
    with pytest.raises(LinkError):
        await bench.open().connect()


async def what_it_cannot_is_said_and_has_no_value(bench: Bench) -> None:
    cnc = await connected(bench)
    sample = await cnc.read([])
    assert set(cnc.cannot) <= set(Capability) and all(cnc.cannot.values())
    values = {"spindle_speed": sample.spindle_speed_rpm, "motor_temperature": sample.motor_temperature_degc}
    assert {name for name, value in values.items() if math.isnan(value)} == set(cnc.cannot) & set(values)
    assert math.isfinite(sample.clock_s)
    await cnc.close()


async def axis_positions_come_in_mm_or_with_the_reason_why_not(bench: Bench) -> None:
    axis = AxisPositionConfig(axis="Z", travel_mm=(0.0, 500.0), rapid_mm_per_min=30_000.0)
    cnc = await connected(bench, axis_positions={"Z_mm": axis})
    found = (await cnc.read([])).positions_mm
    assert set(found) == {"Z_mm"}
    assert math.isnan(found["Z_mm"]) == (Capability.AXIS_POSITION in cnc.cannot)
    assert math.isnan(found["Z_mm"]) or found["Z_mm"] == pytest.approx(getattr(bench, "z_mm", 250.0), abs=1e-3)
    await cnc.close()
    cnc = await connected(bench, axis_positions={"W_mm": axis.model_copy(update={"axis": "W", "number": 9})})
    assert math.isnan((await cnc.read([])).positions_mm["W_mm"]) and cnc.cannot[Capability.AXIS_POSITION]
    await cnc.close()
    cnc = await connected(bench)
    assert (await cnc.read([])).positions_mm == {}
    await cnc.close()


async def a_second_look_at_one_instant_differs_only_in_time(bench: Bench) -> None:
    cnc = await connected(bench)
    first, second = await cnc.read([500]), await cnc.read([500])
    assert second.time.monotonic_s >= first.time.monotonic_s and second.clock_s >= first.clock_s
    assert (first.power_on_count, first.program, first.macros) == (second.power_on_count, second.program, second.macros)
    await cnc.close()


async def groups_arrive_in_their_order(bench: WireBench) -> None:
    cnc = await connected(bench)
    if await written(cnc, [[(500, 1.0)], [(503, 2.0), (501, 1.0), (504, 3.0)], [(505, 1.0)]]):
        first, *between, last = bench.written()
        assert (first, last) == (500, 505) and set(between) == {501, 503, 504}
    else:
        assert bench.written() == []
    await cnc.close()


async def words_are_no_number(bench: WireBench) -> None:
    cnc = await connected(bench)
    await written(cnc, GROUPS)
    bench.mistype(501)
    try:
        sample = await cnc.read([501])
    except DriverError:
        pass  # said in words, as what cannot be read has to be
    else:
        assert sample.macros == {501: None} and math.isnan(sample.spindle_speed_rpm)
    await cnc.close()


async def a_silent_peer_is_a_lost_link_within_the_time_out(bench: WireBench) -> None:
    async def say_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    silent = await asyncio.start_server(say_nothing, "127.0.0.1", 0)
    cnc = bench.open_at(silent.sockets[0].getsockname()[1], timeout_s=IMPATIENT_S)
    with pytest.raises(LinkError, match=r"did not answer within 0\.3 s"):
        await cnc.connect()
    await cnc.close()
    silent.close()


async def who_speaks_another_protocol_is_no_control(bench: WireBench) -> None:
    async def say_something_else(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        await reader.read()
        writer.close()

    other = await asyncio.start_server(say_something_else, "127.0.0.1", 0)
    cnc = bench.open_at(other.sockets[0].getsockname()[1], timeout_s=5 * IMPATIENT_S)
    with pytest.raises(DriverError):
        await cnc.connect()
    await cnc.close()
    other.close()


async def a_connection_that_is_open_on_one_side_only_is_lost(bench: WireBench) -> None:
    relay = TcpRelay(port=0, target_port=bench.port)
    await relay.start()
    try:
        cnc = bench.open_at(relay.port)
        await cnc.connect()
        await cnc.close()
        cnc = bench.open_at(relay.port, timeout_s=5 * IMPATIENT_S)
        await cnc.connect()
        relay.freeze()
        with pytest.raises(LinkError, match="did not answer within"):
            await (cnc.write_macros([[(500, 2.0)]]) if writes(cnc) else cnc.read([]))
        relay.thaw()
        with pytest.raises(LinkError):
            await cnc.read_macros([500])
        await cnc.close()
    finally:
        await relay.stop()


async def reconnecting_leaves_nothing_behind(bench: Bench, times: int, *, kept: float = 0.5) -> None:
    """Connect again and again; less than `kept` objects stay of each connection, where a whole one is more by far."""

    async def once() -> None:
        cnc = await connected(bench)
        await cnc.read([500])
        await cnc.close()

    few = times // 20  # the simulated control, in this process too, closes its side a little later
    for _ in range(20):
        await once()
    before = _left_behind()
    for _ in range(times):
        await once()
    await asyncio.sleep(0.05)
    tasks, files, objects = (now - then for now, then in zip(_left_behind(), before, strict=True))
    assert tasks <= few and files <= few, f"{tasks} tasks, {files} files"
    assert objects <= kept * times, f"{objects} objects after {times} connections"


def _left_behind() -> tuple[int, int, int]:
    gc.collect()
    return len(asyncio.all_tasks()), sum(1 for _ in Path("/proc/self/fd").iterdir()), len(gc.get_objects())


CHECKS: tuple[Check, ...] = (
    identity_stays,
    one_read_gives_state_and_macros,
    nothing_follows_a_refused_value,
    what_must_not_be_written_is_refused_before_anything_is_sent,
    an_insecure_connection_needs_to_be_allowed,
    close_is_for_any_time,
    a_control_that_went_away_is_a_lost_link,
    what_it_cannot_is_said_and_has_no_value,
    axis_positions_come_in_mm_or_with_the_reason_why_not,
    a_second_look_at_one_instant_differs_only_in_time,
)
WIRE_CHECKS: tuple[WireCheck, ...] = (
    groups_arrive_in_their_order,
    words_are_no_number,
    a_silent_peer_is_a_lost_link_within_the_time_out,
    who_speaks_another_protocol_is_no_control,
    a_connection_that_is_open_on_one_side_only_is_lost,
)
