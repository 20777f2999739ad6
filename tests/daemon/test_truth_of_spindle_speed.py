"""What the NC takes is a speed at which the cut is stable with the spindle of now, or the daemon says otherwise.

The true temperatures are played into a planner of its own; bounds, steps and words of the daemon do not count.
"""

import math
import random
import re
from collections.abc import Iterable
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import running
from speed_machine import MACROS, bearing_model
from speed_rig import CUT, CYCLE_S, SAFE, SpeedRig, ThreadPlanner

from config.machine.stability_case import load_stability_case
from daemon.spindle_speed import turning
from drivers.guard.speed_text import SpeedStatus
from models.stability.lobes_zoa import zeroth_order_lobes
from models.thermomechanics.artifact import model_to_json
from models.thermomechanics.regression import ThermomechanicalModel

PASSES = 10
EVENTS = ["", "", "", "silent", "another_operation", "link", "restart", "switch", "standstill"]
HANDS = ["override", "speed", "tool", "model", "slept", "overwritten", "deeper", "another_feed", "another_tool", ""]
LATER = ["released", "turned in between", "override", "silent", "standstill", "restart", ""]
"""What people, programs and a busy computer do beside the daemon."""
SILENT_S = 20
"""A cut at a speed that is none to cut at may go on for so long before an alarm: the daemon waits for ten seconds."""


def confident(picture: dict[str, Any]) -> bool:
    """Tell whether status says that the cut is stable, within a cut in HOLD, and nothing against it."""
    return not picture["alarm"] and picture["reason"].startswith("stable to")


def softer_along_y(stiffening_per_k: float) -> ThermomechanicalModel:
    """Bearings of which those along Y stiffen less: how deep a cut may be depends on the direction of the feed."""
    model, other = (bearing_model(stiffening_per_k=share * stiffening_per_k) for share in (1.0, 0.4))
    return replace(model, axes=model.axes | {"y": other.axes["y"]})


class TrueSpindle:
    """Hears every true temperature, also while the daemon hears none, and says by itself what a speed bears."""

    def __init__(self, bench: SpeedRig) -> None:
        assert bench.configuration.spindle_speed is not None
        self._estimator = ThreadPlanner(bench.configuration)._planning._operations[0].estimator
        case = load_stability_case(bench.configuration.spindle_speed.operations[0].case)
        self._cut = case.cut().straight()
        self.feed_deg = float(case.feed_deg)

    def hear(self, bench: SpeedRig) -> None:
        self._estimator.renew(bench.clock.monotonic_s, np.full(5, bench.degc))

    def limiting_depth_mm(self, speed_rpm: float) -> float:
        assert self._estimator.known is not None
        lobes = zeroth_order_lobes(
            self._estimator.known.response,
            self._cut,
            from_rpm=0.999 * speed_rpm,
            to_rpm=1.001 * speed_rpm,
            points=3,
            feed_deg=self.feed_deg,
        )
        return float(lobes.limiting_depth_mm[1])


class History:
    """One random day of passes while the spindle warms and cools by at most 1.5 K a minute."""

    def __init__(
        self, folder: Path, seed: int, events: list[str] = EVENTS, *, everywhere: bool = False, told: bool = True
    ) -> None:
        """`everywhere`: the feed goes another way in each pass, and the spindle is softer along Y.

        `told`: the configuration does not say that it goes one way alone.
        """
        self.random, self.events, self.said = random.Random(seed), events, list[str]()
        self.directions = random.Random(f"{seed} feed") if everywhere else None
        model = softer_along_y(0.02) if everywhere else None
        limits: dict[str, Any] = {"step_rpm": self.random.choice([30.0, 200.0]), "dwell_s": 5.0}
        self.bench = SpeedRig(folder, model=model, one_feed_direction=not (everywhere and told), **limits)
        self.spindle = TrueSpindle(self.bench)
        self.stack = AsyncExitStack()
        self.rate_k_per_min, self.judged, self.wrong = 0.0, 0, list[str]()
        self.depth_mm, self.cut_wrong_s, self.cuts = 0.0, 0, 0

    async def passes(self, seconds: int, sequence_number: int, *, temperatures: bool = True) -> None:
        for _ in range(seconds):
            self.bench.degc = min(max(self.bench.degc + self.rate_k_per_min / 60.0, 22.0), 42.0)
            if round(self.bench.clock.monotonic_s) % CYCLE_S == 0:
                self.spindle.hear(self.bench)
                self._cut_judged(sequence_number)
            await self.bench.pass_by(1.0, sequence_number, temperatures=temperatures)

    def _cut_judged(self, sequence_number: int) -> None:
        """Judge what is cut now, at whatever speed the spindle turns."""
        picture, actual_rpm = self.bench.picture(), self.bench.nc.spindle_speed_rpm
        if sequence_number != CUT or not (confident(picture) and self.depth_mm and actual_rpm > 0.0):
            self.cut_wrong_s = 0
            return
        self.cuts += 1
        bears_mm = self.spindle.limiting_depth_mm(actual_rpm)
        self.cut_wrong_s = self.cut_wrong_s + CYCLE_S if bears_mm < self.depth_mm else 0
        if self.cut_wrong_s == SILENT_S:
            said = f"cuts {self.depth_mm} mm at {actual_rpm:.0f} 1/min, {picture['reason']}: bears {bears_mm:.3g} mm"
            self.wrong.append(f"{said}; {self.said}")

    def taken(self, depth_mm: float, speed_rpm: float) -> None:
        """Call as the part program does, and judge what the NC takes."""
        got_rpm, _, status = self.bench.call(S=speed_rpm, D=depth_mm)
        self.depth_mm = depth_mm if status is SpeedStatus.APPLIED else 0.0
        picture = self.bench.picture()
        if status is not SpeedStatus.APPLIED or not confident(picture):
            return
        self.judged += 1
        if (bears_mm := self.spindle.limiting_depth_mm(got_rpm)) < depth_mm:
            said = picture["reason"]
            got = f"S{speed_rpm:.0f} D{depth_mm} at {got_rpm:.0f} 1/min"
            self.wrong.append(f"{got}, {said}: bears {bears_mm:.3g} mm; {self.said}")

    async def play(self) -> None:
        bench, depth_mm = self.bench, self.random.choice([1.5, 2.0, 2.5]) * (1.0 if self.directions is None else 0.6)
        programmed_rpm = self.programmed_rpm = self.random.choice([8000.0, 9000.0, 10000.0])
        async with self.stack:
            await self._run()
            for _ in range(PASSES):
                bench.nc.sequence_number = SAFE
                if self.directions is not None:
                    self.spindle.feed_deg = self.directions.uniform(0.0, 360.0)
                bench.call(S=programmed_rpm, D=depth_mm)
                await self.passes(12, SAFE)
                self.taken(depth_mm, programmed_rpm)
                self.rate_k_per_min = self.random.choice([0.0, 0.5, 1.5, 1.5, -1.5])
                await self.passes(20, CUT)
                self.said.append(event := self.random.choice(self.events))
                await self.happens(event, depth_mm)
                await self.passes(self.random.choice([10, 60]), CUT)

    async def _run(self) -> None:
        await self.stack.enter_async_context(running(self.bench.rig))
        await self.bench.rig.turn(safe=False)

    async def happens(self, event: str, depth_mm: float) -> None:
        bench = self.bench
        if event == "silent":
            await self.passes(self.random.choice([40, 70]), CUT, temperatures=False)
        elif event == "another_operation":
            bench.call(S=9300.0, D=depth_mm / 2.0)
            self.depth_mm = 0.0
            await self.passes(60, SAFE)
        elif event == "link":
            bench.nc.reachable = False
            await self.passes(self.random.choice([4, 40]), CUT)
            bench.nc.reachable = True
        elif event == "restart":
            await self._restart()
        elif event == "switch":
            bench.speed.turn(on=False, person="a person")
            await self.passes(20, CUT)
            bench.speed.turn(on=True, person="a person")
        elif event == "standstill":
            await self.passes(100, 0)
        elif event in ("override", "speed"):
            usual_rpm = bench.nc.spindle_speed_rpm
            bench.nc.spindle_speed_rpm = self.random.choice([0.8, 0.9, 0.97, 1.03, 1.1, 1.2]) * usual_rpm
            await self.passes(self.random.choice([5, 60]), CUT)
            bench.nc.spindle_speed_rpm = usual_rpm if event == "override" else bench.nc.spindle_speed_rpm
        elif event == "tool":
            self._edit(r"frequency_hz: \d+", f"frequency_hz: {self.random.choice([600, 610, 630, 640])}")
            await self._restart()
        elif event == "model":
            model = bearing_model(stiffening_per_k=self.random.choice([0.015, 0.02, 0.025]))
            (bench.folder / "bearings.json").write_text(model_to_json(model), encoding="utf-8")
            await self._restart()
        elif event == "released":
            self._release(self.random.choice([0.015, 0.02, 0.025]))
            await self.passes(self.random.choice([5, 30]), CUT)
        elif event == "turned in between":
            bench.nc.after_read = self._turns_the_override
            await self.passes(self.random.choice([5, 60]), CUT)
        elif event == "slept":
            bench.nc.after_read = self._sleeps
            await self.passes(20, CUT)
        elif event == "overwritten":
            value = self.random.choice([0.0, 1.0, 9000.0, 7000.0, 1e9, self.random.uniform(2000.0, 12000.0)])
            bench.nc.macros.set(self.random.choice(MACROS.ours), value)
            self.taken(depth_mm, self.programmed_rpm)
            await self.passes(10, CUT)
            bench.rig.acknowledge("a person")
        elif event == "deeper":
            await self.passes(12, SAFE)
            self.taken(1.5 * depth_mm, self.programmed_rpm)
            await self.passes(12, SAFE)
            self.taken(1.5 * depth_mm, self.programmed_rpm)
        elif event == "another_feed":
            bench.call(S=self.programmed_rpm, F=1000.0, D=depth_mm)
            self.depth_mm = 0.0
            await self.passes(12, SAFE)
            bench.call(S=self.programmed_rpm, F=1000.0, D=depth_mm)
        elif event == "another_tool":
            bench.nc.tool_number = 2
            self.taken(depth_mm, self.programmed_rpm)
            await self.passes(self.random.choice([3, 20]), CUT)
            bench.nc.tool_number = 1

    async def _restart(self) -> None:
        bench = self.bench
        await self.stack.aclose()
        bench.clock.monotonic_s += self.random.choice([2.0, 45.0])
        bench.speed.close()
        bench.new_rig()
        feed_deg, self.spindle = self.spindle.feed_deg, TrueSpindle(bench)
        self.spindle.feed_deg = feed_deg
        self.spindle.hear(bench)
        await self._run()

    def _edit(self, what: str, by: str) -> None:
        path = self.bench.folder / "case.yaml"
        path.write_text(re.sub(what, by, path.read_text(encoding="utf-8")), encoding="utf-8")

    def _release(self, stiffening_per_k: float) -> None:
        """Other bearings are released while the daemon runs, and its planning process ends and begins with them."""
        bench, feed_deg = self.bench, self.spindle.feed_deg
        model = (
            softer_along_y(stiffening_per_k) if self.directions else bearing_model(stiffening_per_k=stiffening_per_k)
        )
        (bench.folder / "bearings.json").write_text(model_to_json(model), encoding="utf-8")
        planner = bench.speed.follower.worker._planner
        assert isinstance(planner, ThreadPlanner)
        planner._planning = ThreadPlanner(bench.configuration)._planning
        self.spindle = TrueSpindle(bench)
        self.spindle.feed_deg = feed_deg
        self.spindle.hear(bench)

    def _turns_the_override(self, _numbers: object) -> None:
        """Between what the daemon reads and what it writes the operator turns the override, and leaves it there."""
        self.bench.nc.after_read = None
        self.bench.nc.spindle_speed_rpm *= self.random.choice([0.8, 0.97, 1.03, 1.2])

    def _sleeps(self, _numbers: object) -> None:
        """The computer does nothing between what it reads and what it writes."""
        self.bench.nc.after_read = None
        self.bench.clock.monotonic_s += self.random.choice([2.0, 15.0, 40.0])


OUTGROWN = 102
"""Seed of a cut at the edge of a pocket without the margin: before, status called it stable and gave no alarm."""


async def played(
    folder: Path, seeds: Iterable[int], events: list[str], *, everywhere: bool = False, told: bool = True
) -> tuple[int, list[str]]:
    """Return how often a call was judged in histories of these events, and what was wrong."""
    judged, wrong = 0, list[str]()
    for seed in seeds:
        (own := folder / str(seed)).mkdir()
        history = History(own, seed, events, everywhere=everywhere, told=told)
        await history.play()
        judged, wrong = judged + history.judged, wrong + history.wrong
    return judged, wrong


async def test_what_the_nc_takes_is_stable_with_the_spindle_of_now(tmp_path: Path) -> None:
    judged, wrong = await played(tmp_path, range(4), EVENTS)
    assert judged >= PASSES
    assert not wrong


async def test_nor_do_people_and_programs_bring_a_speed_that_nobody_has_verified(tmp_path: Path) -> None:
    judged, wrong = await played(tmp_path, (2, OUTGROWN), HANDS)
    assert judged >= PASSES
    assert not wrong


async def test_nor_does_a_feed_that_goes_every_way_or_a_model_that_is_released_meanwhile(tmp_path: Path) -> None:
    judged, wrong = await played(tmp_path, (0, 1), LATER, everywhere=True)
    assert judged >= PASSES
    assert not wrong


@pytest.mark.slow
async def test_nor_in_many_histories(tmp_path: Path, times_as_many: int) -> None:
    _, wrong = await played(tmp_path, range(1000, 1000 + times_as_many), EVENTS + HANDS)
    _, found = await played(tmp_path, range(2000, 2000 + times_as_many), HANDS + LATER, everywhere=True)
    assert not wrong + found


async def test_the_judge_sees_a_cut_at_another_speed_that_is_told_by_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(turning, "LASTS_S", math.inf)
    _, wrong = await played(tmp_path, [3], ["override", "speed"])
    assert wrong and "bears" in wrong[0]


async def test_the_judge_sees_a_feed_that_goes_another_way_than_the_configuration_says(tmp_path: Path) -> None:
    _, wrong = await played(tmp_path, [1], LATER, everywhere=True, told=False)
    assert wrong and "bears" in wrong[0]
