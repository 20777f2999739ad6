"""What every driver of a CNC must do, whatever its protocol; `Bench` gives the checks a control to try it on."""

import math
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import pytest

from drivers.contract import Cnc, FatalDriverError, LinkError, NotSentError
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


Check = Callable[[Bench], Awaitable[None]]


async def connected(bench: Bench, **changes: Any) -> Cnc:
    cnc = bench.open(**changes)
    await cnc.connect()
    return cnc


async def identity_stays(bench: Bench) -> None:
    first, second = await connected(bench), await connected(bench)
    assert first.identity == second.identity != ""
    assert bench.open().security in ("encrypted", "insecure")
    await first.close()
    await second.close()


async def one_read_gives_state_and_macros(bench: Bench) -> None:
    cnc = await connected(bench)
    await cnc.write_macros(GROUPS)
    sample = await cnc.read([501, 502])
    assert isinstance(sample, CncSample) and math.isfinite(sample.clock_s)
    assert sample.macros == {501: 0.004, 502: None}
    assert await cnc.read_macros([503, 502, 500]) == {503: 0.0105, 502: None, 500: 1.0}
    await cnc.close()


async def nothing_follows_a_refused_value(bench: Bench) -> None:
    cnc = await connected(bench)
    await cnc.write_macros([[(500, 7.0)], [(505, 7.0)]])
    bench.refuse(501)
    with pytest.raises(FatalDriverError, match="#501") as refused:
        await cnc.write_macros(GROUPS)
    assert not isinstance(refused.value, NotSentError), "sequence_a has arrived"
    assert await cnc.read_macros([500, 505]) == {500: 1.0, 505: 7.0}
    await cnc.close()


async def what_must_not_be_written_is_refused_before_anything_is_sent(bench: Bench) -> None:
    cnc = await connected(bench)
    await cnc.write_macros([[(500, 7.0)]])
    for number, value in ((501, math.nan), (501, math.inf), (FORBIDDEN, 1.0)):
        with pytest.raises(NotSentError, match=f"#{number}"):
            await cnc.write_macros([[(500, 1.0)], [(number, value)]])
    assert await cnc.read_macros([500]) == {500: 7.0}
    await cnc.close()


async def an_insecure_connection_needs_to_be_allowed(bench: Bench) -> None:
    cnc = await connected(bench, allow_insecure_writes=False)
    if cnc.security == "insecure":
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


CHECKS: tuple[Check, ...] = (
    identity_stays,
    one_read_gives_state_and_macros,
    nothing_follows_a_refused_value,
    what_must_not_be_written_is_refused_before_anything_is_sent,
    an_insecure_connection_needs_to_be_allowed,
    close_is_for_any_time,
    a_control_that_went_away_is_a_lost_link,
)
