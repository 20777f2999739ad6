"""The process that plans the spindle speed: what it answers, and that the speed is frozen when it is lost."""

import asyncio
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from control_rig import running
from speed_machine import bearing_model, speed_machine
from speed_rig import CUT, SpeedRig, ThreadPlanner

from daemon.registry import SPEED_PLANNER
from daemon.spindle_speed.messages import CalledOperation, OpenedModel, PlanRequest
from daemon.spindle_speed.planner_process import STARTING, PlannerProcess
from daemon.supervisor import Backoff, LinkHealth, run_with_reconnect
from drivers.contract import LinkError
from models.thermomechanics.artifact import model_to_json

pytestmark = pytest.mark.wires

CALLED = CalledOperation(tool_number=1, program=1000, speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=2.0, radial_mm=0.0)


def asked(time_s: float = 1000.0, sensors: int = 5) -> PlanRequest:
    return PlanRequest(readings=((time_s, (28.0,) * sensors),), time_s=time_s, called=CALLED, place=0, doubted={})


def ends(process_id: int) -> bool:
    """Wait for the end of a process, whoever's child it is."""
    try:
        handle = os.pidfd_open(process_id)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([handle], [], [], 60.0)[0])
    finally:
        os.close(handle)


class Supervised:
    """A planner with one attempt under way."""

    def __init__(self, folder: Path, command: tuple[str, ...] = SPEED_PLANNER) -> None:
        (folder / "bearings.json").write_text(model_to_json(bearing_model()), encoding="utf-8")
        self.configuration = speed_machine(folder)
        self.is_open, self.overdue = asyncio.Event(), asyncio.Event()
        self.planner = PlannerProcess(command, self.configuration, self._opened, self.overdue.wait)
        self.begin()

    def _opened(self, _: OpenedModel) -> None:
        self.is_open.set()

    def begin(self) -> None:
        self.is_open.clear()
        self.attempt = asyncio.create_task(self.planner.attempt())

    async def opened(self) -> int:
        await asyncio.wait(
            [self.attempt, opening := asyncio.create_task(self.is_open.wait())], return_when=asyncio.FIRST_COMPLETED
        )
        opening.cancel()
        assert self.planner.process_id is not None, self.attempt
        return self.planner.process_id

    async def lost(self) -> str:
        with pytest.raises(LinkError) as error:
            await self.attempt
        assert self.planner.inhibit == str(error.value)
        assert "the speed is frozen" in self.planner.inhibit
        with pytest.raises(LinkError):
            await self.planner.plan(asked())
        return str(error.value)


@contextlib.asynccontextmanager
async def supervised(folder: Path, command: tuple[str, ...] = SPEED_PLANNER) -> AsyncIterator[Supervised]:
    child = Supervised(folder, command)
    try:
        yield child
    finally:
        child.attempt.cancel()
        await asyncio.gather(child.attempt, return_exceptions=True)


async def test_it_answers_what_the_planning_says(tmp_path: Path) -> None:
    async with supervised(tmp_path) as child:
        assert child.planner.inhibit == STARTING
        await child.opened()
        assert child.planner.inhibit == ""
        assert child.planner.opened is not None
        assert child.planner.opened.model.model_id == "made-up"
        planned = await child.planner.plan(asked())
        assert planned is not None
        assert planned.plan is not None
        assert planned == await ThreadPlanner(child.configuration).plan(asked())
        nothing = PlanRequest(
            readings=((1001.0, (float("nan"),) * 5),), time_s=1001.0, called=None, place=None, doubted={}
        )
        assert await child.planner.plan(nothing) is None


async def test_a_killed_one_is_named_and_another_takes_its_place(tmp_path: Path) -> None:
    async with supervised(tmp_path) as child:
        first = await child.opened()
        os.kill(first, signal.SIGKILL)
        assert "was ended by SIGKILL" in await child.lost()
        child.begin()
        assert await child.opened() != first
        assert (await child.planner.plan(asked())) is not None


async def test_one_that_hangs_is_killed_and_so_is_its_answer(tmp_path: Path) -> None:
    async with supervised(tmp_path) as child:
        process_id = await child.opened()
        os.kill(process_id, signal.SIGSTOP)
        waiting = asyncio.create_task(child.planner.plan(asked()))
        await asyncio.sleep(0)
        child.overdue.set()
        assert "has not answered in time and is killed" in await child.lost()
        with pytest.raises(LinkError, match="has not answered in time"):
            await waiting
        assert ends(process_id)


async def test_a_defect_in_the_daemon_says_why_no_speed_is_planned(tmp_path: Path) -> None:
    def defect(_: OpenedModel) -> None:
        raise OverflowError("too much")

    async with supervised(tmp_path) as child:
        await child.opened()
        child.attempt.cancel()
        await asyncio.gather(child.attempt, return_exceptions=True)
        child.planner._on_opened = defect
        child.begin()
        with pytest.raises(OverflowError):
            await child.attempt
        assert "unexpected OverflowError: too much" in child.planner.inhibit
        with pytest.raises(LinkError, match="the speed is frozen"):
            await child.planner.plan(asked())


async def test_one_that_needs_too_much_memory_ends_and_says_so(tmp_path: Path) -> None:
    hungry = (
        "import daemon.speed_planner as planner\n"
        "opened = planner.open_planning\n"
        "planner.open_planning = lambda *told: bytearray(1 << 30) and opened(*told)\n"
        "planner.main()"
    )
    async with supervised(tmp_path, (sys.executable, "-P", "-c", hungry)) as child:
        assert "MemoryError" in await child.lost()


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("print('{\"opened\": 3}')", "an answer that cannot be read"),
        ("print('{}')", "has not said what it opened"),
        ("print('x' * 3_000_000)", "an answer that cannot be read"),
        ("raise SystemExit(7)", "has ended with status 7"),
    ],
)
async def test_what_is_no_answer_is_not_believed(tmp_path: Path, program: str, words: str) -> None:
    async with supervised(tmp_path, (sys.executable, "-c", f"import sys; sys.stdin.readline(); {program}")) as child:
        assert words in await child.lost()


@pytest.mark.parametrize("wrong", [{"speed_rpm": float("nan")}, {"speed_rpm": -1.0}, {"time_s": 0.0}, {"program": 7}])
async def test_a_plan_of_something_else_or_without_a_speed_is_not_taken(tmp_path: Path, wrong: dict[str, Any]) -> None:
    called = asdict(CALLED) | {key: value for key, value in wrong.items() if key == "program"}
    choice = {"speed_rpm": 9100.0, "limiting_depth_mm": float("inf"), "pocket_rpm": [9000.0, 9200.0]}
    choice |= {key: value for key, value in wrong.items() if key == "speed_rpm"}
    planned = {
        "called": called,
        "time_s": wrong.get("time_s", 1000.0),
        "plan": {"choice": choice, "flagged_span_rpm": 0.0},
        "problem": "",
        "resonance_hz": {},
        "change_per_step_rpm": {},
    }
    model = dict.fromkeys(("model_id", "sha256", "release", "released_by", "released"))
    opened = {"inhibit": "", "words": "", "model": model | {"problem": "", "warning": ""}}
    replies = [json.dumps({"opened": opened}), json.dumps({"planned": planned})]
    program = f"import sys\nfor reply in {replies!r}:\n    sys.stdin.readline()\n    print(reply, flush=True)"
    async with supervised(tmp_path, (sys.executable, "-c", f"{program}\nsys.stdin.readline()")) as child:
        await child.opened()
        with pytest.raises(LinkError, match="something else than it was asked"):
            await child.planner.plan(asked())
        assert "something else than it was asked" in await child.lost()


@pytest.mark.parametrize("stopped", [False, True])
async def test_it_ends_with_a_daemon_that_is_killed(tmp_path: Path, stopped: bool) -> None:
    program = (
        "import asyncio, sys\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "from test_planner_process import Supervised\n"
        "async def main():\n"
        "    child = Supervised(Path(sys.argv[1]))\n"
        "    print(await child.opened(), flush=True)\n"
        "    await child.attempt\n"
        "asyncio.run(main())\n"
    )
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n{program}"]
    with subprocess.Popen([*command, str(tmp_path)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        process_id = int(await asyncio.to_thread(parent.stdout.readline))
        if stopped:
            os.kill(process_id, signal.SIGSTOP)
        parent.kill()
        assert await asyncio.to_thread(ends, process_id)


async def test_a_lost_planner_freezes_the_speed_and_a_new_one_goes_on(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    again = asyncio.Event()
    planner = PlannerProcess(SPEED_PLANNER, bench.configuration, lambda _: again.set())
    health = LinkHealth("speed planner")
    keeper = asyncio.create_task(run_with_reconnect(health, planner.attempt, Backoff(0.001, 0.002)))
    try:
        async with running(bench.new_rig(planner=planner)):
            await again.wait()
            speed_rpm, _, _ = await bench.operation()
            assert speed_rpm != 9000.0
            await bench.pass_by(3.0, CUT)

            again.clear()
            assert planner.process_id is not None
            os.kill(planner.process_id, signal.SIGSTOP)  # so that nothing comes back before it has been seen
            os.kill(planner.process_id, signal.SIGKILL)
            while not planner.inhibit:
                await asyncio.sleep(0)
            bench.degc += 10.0
            await bench.rig.turn(after_s=1.0, safe=False)
            await bench.rig.serve()
            assert bench.picture()["state"] == "HOLD"
            assert "is started again, and the speed is frozen" in bench.picture()["alarm"]
            assert bench.picture()["target_rpm"] is None
            assert bench.call()[0] == speed_rpm

            await again.wait()
            await bench.pass_by(30.0, CUT)
            assert bench.picture()["alarm"] == ""
            assert bench.picture()["target_rpm"] not in (None, speed_rpm)
            assert health.attempts == 2
    finally:
        keeper.cancel()
        await asyncio.gather(keeper, return_exceptions=True)
