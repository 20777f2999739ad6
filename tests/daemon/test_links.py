"""What the links tell: losses and returns of a line, and rows of the logger that cannot be read."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from control_rig import HandClock, machine
from displacement_file import HEADER, append, config, row

from config.schema import Configuration
from daemon.cnc.session import CncLink
from daemon.links import DisplacementLog, Links
from daemon.registry import PARTS
from daemon.snapshots import DisplacementSnapshot
from drivers.clock import SystemClock
from drivers.contract import LinkError
from models.records import DisplacementSample, TemperatureCycle, Trace

FOREVER_S = 30.0


class CutLine:
    """A line that gives one cycle and is cut, so often; then it stays."""

    name = "spindle"

    def __init__(self, cuts: list[int]) -> None:
        self._cuts = cuts

    async def cycles(self) -> AsyncIterator[TemperatureCycle]:
        now = HandClock().now()
        codes = np.zeros(3, dtype=np.uint8)
        yield TemperatureCycle(
            line="spindle",
            number=1,
            degc=np.full(3, 20.0),
            quality=codes,
            reason=codes.copy(),
            complete=True,
            trace=Trace(first_byte=now, last_byte=now),
        )
        if self._cuts:
            self._cuts.pop()
            raise LinkError("the adapter was pulled out")
        await asyncio.Event().wait()

    async def close(self) -> None:
        pass


def no_cnc() -> CncLink:
    def nothing(*_: object) -> Any:
        raise AssertionError("no CNC here")

    return CncLink(nothing, nothing)


async def test_every_loss_and_return_of_a_serial_line_is_logged_and_the_problem_goes(tmp_path: Path) -> None:
    cuts = [1, 2, 3]
    parts = replace(PARTS, open_temperature_source=lambda *_: CutLine(cuts))
    configuration = machine(tmp_path)
    links = Links(configuration, HandClock(), parts, no_cnc(), lambda: None)
    taken, whole = [], asyncio.Event()

    async def take(cycle: TemperatureCycle) -> None:
        taken.append(cycle)
        if len(taken) == 4:
            whole.set()

    with structlog.testing.capture_logs() as logs:
        running = asyncio.create_task(next(links.temperatures(take)))
        async with asyncio.timeout(FOREVER_S):
            await whole.wait()
        shown = links.snapshots()[0]
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert {entry["link"] for entry in logs} == {"latsis spindle"}
    assert [entry["event"] for entry in logs] == ["link.up", "link.lost"] * 3 + ["link.up"]
    assert (shown.up, shown.problem, shown.losses) == (True, "", 3)
    assert shown.last_problem == "the adapter was pulled out"
    assert shown.last_problem_utc_s == HandClock().now().utc_s


class Told:
    """What a displacement log said, and a way to wait for it."""

    def __init__(self) -> None:
        self.rows: list[DisplacementSample] = []
        self.events: list[tuple[str, str]] = []
        self.shown = DisplacementSnapshot()
        self.changed = asyncio.Event()
        self.log = DisplacementLog(HandClock(), self.rows.append, self._event, self._publish)

    def _event(self, kind: str, text: str) -> None:
        self.events.append((kind, text))

    def _publish(self, snapshot: DisplacementSnapshot) -> None:
        self.shown = snapshot
        self.changed.set()

    async def until_problems(self, count: int) -> None:
        async with asyncio.timeout(FOREVER_S):
            while self.shown.problems < count:
                self.changed.clear()
                await self.changed.wait()


def with_displacements(tmp_path: Path, path: Path, **file: Any) -> Configuration:
    return machine(tmp_path).model_copy(update={"displacements": config(path, **file)})


async def test_a_wrong_time_format_is_said_in_log_event_and_status(tmp_path: Path) -> None:
    path = tmp_path / "logger.csv"
    append(path, HEADER + "".join(row(minute) for minute in range(20)))
    configuration = with_displacements(tmp_path, path, time_format="%d.%m.%Y %H:%M:%S")
    links = Links(configuration, SystemClock(), PARTS, no_cnc(), lambda: None)
    told = Told()
    with structlog.testing.capture_logs() as logs:
        running = asyncio.create_task(next(links.displacements(lambda: None, told.log)))
        await told.until_problems(20)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        told.log.flush()
    assert told.rows == [] and told.shown.rows_read == 0
    assert f"{path}:21:1: the time stamp" in told.shown.last_problem
    assert told.shown.last_problem_utc_s == HandClock().now().utc_s
    said = [entry["problem"] for entry in logs if entry["event"] == "displacements.unreadable"]
    assert len(said) == 4, "three at once, the rest summed up"
    assert said[0].startswith(f"{path}:2:1: the time stamp '2026-01-31T08:00:00' cannot be read")
    assert "no row has been read since the daemon started: check `displacements`" in said[0]
    assert "16 more since the last report" in said[-1] and f"{path}:21:1:" in said[-1]
    assert told.events == [("displacements", problem) for problem in said]
