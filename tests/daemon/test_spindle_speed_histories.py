"""Random histories of an NC and a daemon that tunes its spindle speed: what must hold in all of them."""

import asyncio
import contextlib
import shutil
import tempfile
from pathlib import Path
from typing import Any

from control_rig import running
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from speed_machine import MACROS, speed_machine
from speed_rig import CUT, SAFE, SpeedRig

from drivers.guard.speed_text import SpeedStatus

OPERATIONS: list[dict[str, float]] = [
    *({} for _ in range(8)),
    {"D": 1.5},
    {"D": 8.0},
    {"S": 8000.0, "F": 1500.0},
    {"K": 2.0},
    {"K": 0.0},
]
DISTURBANCES = [
    "another_program",
    "broken_call",
    "another_tool",
    "lost_temperatures",
    "lost_link",
    "long_lost_link",
    "lost_write",
    *["torn_step"] * 3,
    "fault",
    "interference",
    "power_cycle",
    "restart",
    "long_restart",
]
PLACES = ["before", "announced", "announced", "decided", "taken", "cut"]
HIGHEST_RPM = {1: 12000.0, 2: 10000.0}
LOWEST_RPM, WITHIN, STEP_RPM, ROUNDING_RPM = 2000.0, 0.2, 30.0, 1.0
SETTINGS = {"step_rpm": STEP_RPM, "hysteresis_rpm": 20.0, "dwell_s": 5.0}
"""So small that the target is often several steps away."""
CHANGES = ("moves", "jumps")

Operation = tuple[float, ...]


class Histories(RuleBasedStateMachine):
    """The part program, its operator and the network do what they like; the daemon is the real one."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="histories-"))
        self.runner = asyncio.Runner()
        self.stack = contextlib.AsyncExitStack()
        self.taken: dict[Operation, float] = {}
        """Operation -> speed that the NC has taken for it last."""
        self.changes: dict[str, list[str]] = {}
        """Operation in words -> changes that the daemon has told of since the NC has taken one."""
        self.under_way = ""
        self.settled = False
        """The latest call has taken the pair, and nothing has happened since that may end it."""
        self.whole_rpm = 0.0
        """Speed in the block when it was last whole."""

    @initialize()
    def begin(self) -> None:
        configured = speed_machine(self.folder).spindle_speed
        assert configured is not None
        operations = [
            configured.operations[0].model_copy(update={"tool_number": tool, "highest_rpm": rpm})
            for tool, rpm in HIGHEST_RPM.items()
        ]
        self.bench = SpeedRig(self.folder, operations=operations, **SETTINGS)
        self.runner.run(self._run())

    async def _run(self) -> None:
        rig = self.bench.rig
        say = rig.control.journal.say

        def heard(kind: str, text: str) -> None:
            self._hear(kind, text)
            say(kind, text)

        rig.control.journal.say = heard  # type: ignore[method-assign]
        await self.stack.enter_async_context(running(rig))
        await rig.turn(safe=False)

    def _hear(self, kind: str, text: str) -> None:
        if kind == "speed" and " begins in O" in text:
            self.under_way = text.partition(" begins in O")[0]
        elif kind == "speed":
            assert text.startswith(CHANGES)
            self.changes.setdefault(self.under_way, []).append(text)

    def teardown(self) -> None:
        with self.runner:
            self.runner.run(self.stack.aclose())
        shutil.rmtree(self.folder, ignore_errors=True)

    # --- the part program ----------------------------------------------------------------

    @rule(
        arguments=st.sampled_from(OPERATIONS),
        tool=st.sampled_from([1, 1, 1, 1, 1, 2]),
        waits_s=st.sampled_from([8, 8, 3, 2]),
        cuts_s=st.sampled_from([5, 15, 15, 40]),
        warms_k=st.sampled_from([0.0, 2.0, 4.0, -6.0, 9.0]),
        disturbance=st.sampled_from(["", "", *DISTURBANCES]),
        at=st.sampled_from(PLACES),
        acknowledges=st.sampled_from([True, True, False]),
    )
    def mill(
        self,
        arguments: dict[str, float],
        tool: int,
        waits_s: int,
        cuts_s: int,
        warms_k: float,
        disturbance: str,
        at: str,
        acknowledges: bool,
    ) -> None:
        """One operation: call, wait, call once more, cut; something happens meanwhile."""

        def here(place: str) -> None:
            if disturbance and place == at:
                getattr(self, f"_{disturbance}")()

        here("before")
        self._change_tool(tool)
        self.bench.nc.sequence_number = SAFE
        self._called(arguments)
        here("announced")
        self._pass(waits_s, SAFE)
        here("decided")
        self._called(arguments)
        here("taken")
        self._pass(cuts_s // 2, CUT)
        self.bench.degc = min(max(self.bench.degc + warms_k, 22.0), 42.0)
        here("cut")
        self._pass(cuts_s, CUT)
        if acknowledges and self.bench.rig.control.journal.fault is not None:
            self._acknowledge()
        self.bench.nc.reachable = True

    @rule(seconds=st.sampled_from([1, 5, 25]), sequence_number=st.sampled_from([SAFE, SAFE, CUT, 0]))
    def wait(self, seconds: int, sequence_number: int) -> None:
        self._pass(seconds, sequence_number)

    def _called(self, arguments: dict[str, float]) -> None:
        bench, tool = self.bench, self.bench.nc.tool_number
        speed_rpm, feed_mm_min, status = bench.call(**arguments)
        said = {"S": 9000.0, "F": 1800.0, "D": 2.0, "E": 0.0, "K": 1.0} | arguments
        self.settled = status is SpeedStatus.APPLIED
        if not self.settled:
            assert (speed_rpm, feed_mm_min) == (said["S"], said["F"])
            return
        assert LOWEST_RPM - ROUNDING_RPM <= speed_rpm <= HIGHEST_RPM[tool] + ROUNDING_RPM
        assert abs(speed_rpm - said["S"]) <= WITHIN * said["S"] + ROUNDING_RPM
        assert abs(feed_mm_min - said["F"] * speed_rpm / said["S"]) < 0.1
        assert said["K"] > 0.0
        made_for = [MACROS.for_tool, MACROS.for_speed, MACROS.for_feed, MACROS.for_depth, MACROS.for_radial]
        operation = (float(tool), *(said[letter] for letter in "SFDE"), said["K"])
        assert tuple(bench.nc.macros.get(number) for number in [*made_for, MACROS.for_kind]) == operation
        self._stepped(operation, speed_rpm, said)

    def _stepped(self, operation: Operation, speed_rpm: float, said: dict[str, float]) -> None:
        """What the NC takes differs by one change at most: a step, or a jump to another pocket.

        One that it has not taken yet may be decided anew.
        """
        words = f"T{operation[0]:g} S{said['S']:g} F{said['F']:g} D{said['D']:g}"
        words += f" E{said['E']:g}" if said["E"] else ""
        words += f" K{said['K']:g}" if said["K"] != 1.0 else ""
        changes, before_rpm = self.changes.pop(words, []), self.taken.get(operation)
        self.taken[operation] = speed_rpm
        if before_rpm is None:
            return
        if not changes:
            assert speed_rpm == before_rpm
        elif all(each.startswith("moves") for each in changes):
            assert abs(speed_rpm - before_rpm) <= STEP_RPM + ROUNDING_RPM

    def _change_tool(self, tool: int) -> None:
        self.settled = self.settled and tool == self.bench.nc.tool_number
        self.bench.nc.tool_number = tool

    # --- what happens meanwhile ----------------------------------------------------------

    def _another_program(self) -> None:
        """Polls fall into the speed program, the guard, a subprogram."""
        sequence_number = self.bench.nc.sequence_number
        for program in (9020, 9010, 77):
            self.bench.nc.program = program
            self._pass(2, sequence_number)
        self.bench.nc.program = 1000

    def _broken_call(self) -> None:
        """A reset while a call is being told."""
        bench = self.bench
        bench.control.common, bench.control.tool_number = bench.nc.macros, bench.nc.tool_number
        bench.program.start(9020, S=9000.0, F=1800.0, D=4.0)
        while (bench.nc.macros.get(MACROS.calls) or 0.0) >= 0.0:
            bench.program.step()
        bench.program.reset()

    def _another_tool(self) -> None:
        self._change_tool(3 - self.bench.nc.tool_number)

    def _lost_temperatures(self) -> None:
        self._pass(70, self.bench.nc.sequence_number, temperatures=False)

    def _lost_link(self) -> None:
        self.bench.nc.reachable = False
        self._pass(4, self.bench.nc.sequence_number)
        self.bench.nc.reachable = True
        self._lost_write()

    def _long_lost_link(self) -> None:
        self.bench.nc.reachable = False
        self._pass(35, self.bench.nc.sequence_number)
        self.bench.nc.reachable = True

    def _lost_write(self) -> None:
        """The next two writes are torn."""
        for groups in (1, 2):
            self.bench.nc.groups_until_lost = groups
            self._pass(12, self.bench.nc.sequence_number)

    def _torn_step(self) -> None:
        """The next write is torn, whatever it says."""
        self.bench.nc.groups_until_lost = 1

    def _fault(self) -> None:
        self.bench.rig.control.journal.raise_fault("somebody else's fault")

    def _interference(self) -> None:
        """Somebody else writes into the block."""
        self.bench.nc.macros.set(MACROS.feed, 1.0)
        self.settled = False

    def _power_cycle(self) -> None:
        self.bench.nc.power_cycle()

    def _restart(self) -> None:
        self._restarted(0.0)

    def _long_restart(self) -> None:
        self._restarted(40.0)

    def _restarted(self, seconds: float) -> None:
        async def anew() -> None:
            await self.stack.aclose()
            self.bench.clock.monotonic_s += seconds
            self.bench.speed.close()
            self.bench.new_rig()
            await self._run()

        self.runner.run(anew())
        self.settled = False

    def _acknowledge(self) -> None:
        async def asked() -> None:
            await self.bench.rig.connected()
            await self.bench.rig.turn(safe=False)
            self.bench.rig.acknowledge("a person")
            await self.bench.rig.turn(safe=False)

        self.bench.nc.reachable = True
        self.runner.run(asked())

    # --- time ----------------------------------------------------------------------------

    def _pass(self, seconds: int, sequence_number: int, **options: Any) -> None:
        self._note()
        before = len(self.bench.nc.written)
        self.runner.run(self.bench.pass_by(seconds, sequence_number, **options))
        written = {value for number, value in self.bench.nc.written[before:] if number == MACROS.speed}
        if sequence_number == CUT:
            allowed = {self.whole_rpm} if self.settled else {self.whole_rpm, 0.0}
            assert written <= allowed, (written, allowed)
        self._note()

    def _note(self) -> None:
        macros = self.bench.nc.macros
        if macros.get(MACROS.sequence_a) == macros.get(MACROS.sequence_b) and macros.get(MACROS.feed) != 1.0:
            self.whole_rpm = macros.get(MACROS.speed) or 0.0


TestHistories = Histories.TestCase
TestHistories.settings = settings(max_examples=8, stateful_step_count=8, deadline=None)
