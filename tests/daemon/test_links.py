"""What the links tell: losses and returns of a line, and rows of the logger that cannot be read."""

import asyncio
import sys
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import history_records as make
import numpy as np
import pytest
import structlog
from control_rig import HandClock, machine
from displacement_file import HEADER, append, config, row

from config.schema import Configuration
from config.schema.displacement_sources import DisplacementSourceConfig
from config.schema.displacements import DisplacementsConfig
from daemon.cnc.session import CncLink
from daemon.estimation.task import MOST_WAITING, ThermalInbox
from daemon.links import DisplacementLog, Links
from daemon.registry import PARTS
from daemon.snapshots import DisplacementSnapshot
from drivers.clock import SystemClock
from drivers.contract import LinkError
from drivers.displacement.source import DisplacementCsvSource
from models.quality import Reason
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


async def test_one_bad_row_among_good_ones_is_named_with_its_column(tmp_path: Path) -> None:
    path = tmp_path / "logger.csv"
    append(path, HEADER + row(0) + row(1, y="1x") + row(2))
    told = Told()
    links = Links(with_displacements(tmp_path, path), SystemClock(), PARTS, no_cnc(), lambda: None)
    running = asyncio.create_task(next(links.displacements(lambda: None, told.log)))
    async with asyncio.timeout(FOREVER_S):
        while told.shown.rows_read < 3:
            told.changed.clear()
            await told.changed.wait()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    ((kind, text),) = told.events
    assert kind == "displacements"
    assert text == f"{path}:3:2: '1x' is no number for Y; it is left out"
    assert links.snapshots()[-1].up


async def test_a_file_that_is_not_there_is_no_link(tmp_path: Path) -> None:
    told, reached = Told(), []
    source = DisplacementCsvSource(config(tmp_path / "logger.csv"), SystemClock())
    given = source.samples(told.log.problem, lambda: reached.append(True))
    asked = asyncio.ensure_future(anext(given))
    await told.until_problems(1)
    assert reached == [] and "No such file" in told.events[0][1]
    append(tmp_path / "logger.csv", HEADER + row(0))
    async with asyncio.timeout(FOREVER_S):
        assert (await asked).um[0] == 1.5
    following = asyncio.ensure_future(anext(given))
    async with asyncio.timeout(FOREVER_S):
        while not reached:
            await asyncio.sleep(0)
    following.cancel()
    await asyncio.gather(following, return_exceptions=True)
    await source.close()


async def test_cycles_that_come_faster_than_they_are_taken_wait_at_their_line() -> None:
    inbox = ThermalInbox()
    (cycle,) = [make.cycle("spindle", 1, 0.0, [20.0])]
    for _ in range(MOST_WAITING):
        await inbox.put_cycle(cycle)
    waiting = asyncio.create_task(inbox.put_cycle(cycle))
    await asyncio.sleep(0)
    assert not waiting.done() and inbox.qsize() == MOST_WAITING
    inbox.get_nowait()
    await asyncio.wait_for(waiting, FOREVER_S)
    assert inbox.qsize() == MOST_WAITING


async def test_a_change_of_a_link_is_published_at_once(tmp_path: Path) -> None:
    changes: list[bool] = []
    links = Links(machine(tmp_path), SystemClock(), PARTS, no_cnc(), lambda: changes.append(line.up))
    line = links.shown[0]
    line.came_up()
    line.came_up()
    line.went_down("unplugged", 1.0)
    assert changes == [True, False]


async def test_a_file_and_a_program_bring_rows_side_by_side_and_the_latest_of_each_is_shown(tmp_path: Path) -> None:
    path = tmp_path / "logger.csv"
    append(path, HEADER + row(0))
    filed = config(path)
    code = "import time\nwhile True: print('{\"x\": 0.0125}', flush=True); time.sleep(0.02)"
    gauge = {
        "name": "gauge",
        "driver": "process",
        "cycle_period_s": 0.02,
        "process": {
            "command": [sys.executable, "-I", "-S", "-c", code],
            "channels": [{"name": "X9", "field": "x", "unit": "mm"}],
        },
    }
    mixed = DisplacementsConfig(
        file=filed.file, channels=filed.channels, sources=[DisplacementSourceConfig.model_validate(gauge)]
    )
    names = [channel.name for channel in mixed.every_channel]
    assert names[-1] == "X9"
    links = Links(
        machine(tmp_path).model_copy(update={"displacements": mixed}), SystemClock(), PARTS, no_cnc(), lambda: None
    )
    assert [link.name for link in links.snapshots()][-2:] == ["displacement files", "process gauge"]
    told = Told()
    running = [asyncio.create_task(work) for work in links.displacements(lambda: None, told.log)]
    async with asyncio.timeout(FOREVER_S):
        while told.shown.latest is None or np.isnan(told.shown.latest.um[[0, -1]]).any():
            told.changed.clear()
            await told.changed.wait()
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    assert told.shown.latest.um[0] == 1.5 and told.shown.latest.um[-1] == pytest.approx(12.5)
    of_file = next(each for each in told.rows if each.source.startswith(str(path)))
    of_program = next(each for each in told.rows if each.source == "source gauge")
    assert of_file.reason[-1] == Reason.ELSEWHERE and np.isnan(of_file.um[-1])
    assert list(of_program.reason[:-1]) == [Reason.ELSEWHERE] * (len(names) - 1)
