"""What the NC takes is a speed at which the cut is stable with the spindle of now, or the daemon says otherwise.

The true temperatures are played into a planner of its own; bounds, steps and words of the daemon do not count.
"""

import random
from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np
from control_rig import running
from speed_rig import CUT, CYCLE_S, SAFE, SpeedRig, ThreadPlanner

from config.machine.stability_case import load_stability_case
from drivers.guard.speed_text import SpeedStatus
from models.stability.lobes_zoa import zeroth_order_lobes

PASSES = 10
EVENTS = ["", "", "", "silent", "another_operation", "link", "restart", "switch", "standstill"]


class TrueSpindle:
    """Hears every true temperature, also while the daemon hears none, and says by itself what a speed bears."""

    def __init__(self, bench: SpeedRig) -> None:
        assert bench.configuration.spindle_speed is not None
        self._estimator = ThreadPlanner(bench.configuration)._planning._operations[0].estimator
        case = load_stability_case(bench.configuration.spindle_speed.operations[0].case)
        self._cut, self._feed_deg = case.cut().straight(), float(case.feed_deg)

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
            feed_deg=self._feed_deg,
        )
        return float(lobes.limiting_depth_mm[1])


class History:
    """One random day of passes while the spindle warms and cools by at most 1.5 K a minute."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.random = random.Random(seed)
        self.bench = SpeedRig(folder, step_rpm=self.random.choice([30.0, 200.0]), dwell_s=5.0)
        self.spindle = TrueSpindle(self.bench)
        self.stack = AsyncExitStack()
        self.rate_k_per_min, self.judged, self.wrong = 0.0, 0, list[str]()

    async def passes(self, seconds: int, sequence_number: int, *, temperatures: bool = True) -> None:
        for _ in range(seconds):
            self.bench.degc = min(max(self.bench.degc + self.rate_k_per_min / 60.0, 22.0), 42.0)
            if round(self.bench.clock.monotonic_s) % CYCLE_S == 0:
                self.spindle.hear(self.bench)
            await self.bench.pass_by(1.0, sequence_number, temperatures=temperatures)

    def taken(self, depth_mm: float, speed_rpm: float) -> None:
        """Call as the part program does, and judge what the NC takes."""
        got_rpm, _, status = self.bench.call(S=speed_rpm, D=depth_mm)
        picture = self.bench.picture()
        if status is not SpeedStatus.APPLIED or picture["alarm"] or picture["state"] != "TUNED":
            return
        self.judged += 1
        if (bears_mm := self.spindle.limiting_depth_mm(got_rpm)) < depth_mm:
            said = picture["reason"]
            self.wrong.append(f"S{speed_rpm:.0f} D{depth_mm} at {got_rpm:.0f} 1/min, {said}: bears {bears_mm:.3g} mm")

    async def play(self) -> None:
        bench, depth_mm = self.bench, self.random.choice([1.5, 2.0, 2.5])
        programmed_rpm = self.random.choice([8000.0, 9000.0, 10000.0])
        async with self.stack:
            await self._run()
            for _ in range(PASSES):
                bench.nc.sequence_number = SAFE
                bench.call(S=programmed_rpm, D=depth_mm)
                await self.passes(12, SAFE)
                self.taken(depth_mm, programmed_rpm)
                self.rate_k_per_min = self.random.choice([0.0, 0.5, 1.5, 1.5, -1.5])
                await self.passes(20, CUT)
                await self.happens(self.random.choice(EVENTS), depth_mm)
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
            await self.passes(60, SAFE)
        elif event == "link":
            bench.nc.reachable = False
            await self.passes(self.random.choice([4, 40]), CUT)
            bench.nc.reachable = True
        elif event == "restart":
            await self.stack.aclose()
            bench.clock.monotonic_s += self.random.choice([2.0, 45.0])
            bench.speed.close()
            bench.new_rig()
            await self._run()
        elif event == "switch":
            bench.speed.turn(on=False, person="a person")
            await self.passes(20, CUT)
            bench.speed.turn(on=True, person="a person")
        elif event == "standstill":
            await self.passes(100, 0)


async def test_what_the_nc_takes_is_stable_with_the_spindle_of_now(tmp_path: Path) -> None:
    judged, wrong = 0, list[str]()
    for seed in range(4):
        (folder := tmp_path / str(seed)).mkdir()
        history = History(folder, seed)
        await history.play()
        judged, wrong = judged + history.judged, wrong + history.wrong
    assert judged >= PASSES
    assert not wrong
