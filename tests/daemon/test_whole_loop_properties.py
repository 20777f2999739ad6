"""Whatever happens to sensors, links, people, programs and the daemon: how the tool may move.

Thermal task, control task and the text of the guard, which the simulated NC's interpreter runs. Judged is
the offset that the NC has taken, which nobody but the guard can have moved.
"""

import asyncio
import shutil
import tempfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from control_rig import ENABLE, SENSOR_IDS, Y, Z
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from nc_requests import PROBE, REFERENCE, TOOL_CHANGE, Z_AXIS, ask
from small_model import model
from whole_loop import BOUND_UM, REACH_UM, STEP_UM, WholeLoop, lagged_model

from daemon.cnc.macro_block import ECHO_SLACK_UM
from drivers.sim.nc.safe_point import GuardStatus
from models.control.state import OperatorRequest
from models.records import CncRun, FloatArray, OutputState, Phase

pytestmark = pytest.mark.quiet

MODELS = {"first": model("first"), "second": model("second"), "lagged": lagged_model("lagged")}
NOISE_UM = 1e-3
AXES = st.sets(st.sampled_from(["y", "z"]), min_size=1).map(frozenset)
SENSOR = st.integers(0, len(SENSOR_IDS) - 1)
STILL = (OutputState.ARMED, OutputState.HOLD)
WATCHED = (OutputState.ARMED, OutputState.ACTIVE, OutputState.HOLD, OutputState.RETREAT)


class Shop(RuleBasedStateMachine):
    """A day in the shop."""

    policy = "bumpless"

    def __init__(self) -> None:
        super().__init__()
        self.directory = Path(tempfile.mkdtemp())
        self.runner = asyncio.Runner()
        self.loop = WholeLoop(self.directory, MODELS["first"], policy=self.policy)
        self.counter = 0
        self.touched = False
        """Somebody else has written into the block since the daemon last did."""
        self.followed = None
        """The latest estimate that the output could follow."""
        self.runner.run(self.loop.start())
        self.let_pass(1)
        self.loop.rig.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
        self.let_pass(7)
        self.the_work_is_positioned()
        self.the_machine_warms_or_cools([0.15, 0.1, 0.1, 0.05, 0.05], 4)
        assert self.memory.state is OutputState.ACTIVE and self.loop.applied_um.any()

    def teardown(self) -> None:
        self.runner.run(self.loop.end())
        self.runner.close()
        shutil.rmtree(self.directory)

    def could_be_followed(self, estimate) -> bool:
        if estimate is None or estimate.inhibit or not estimate.in_domain:
            return False
        return estimate.confidence >= self.loop.configuration.compensation.output.min_confidence

    # --- what is always true ---------------------------------------------------------------

    @property
    def memory(self):
        return self.loop.rig.control.memory

    def let_pass(self, moments: int) -> None:
        for _ in range(moments):
            self.moment()

    def moment(self) -> None:
        """Ten seconds; then the guard, when the tool is away from the work."""
        loop, before = self.loop, self.memory
        written, applied = loop.written_um, loop.applied_um
        self.runner.run(loop.moment())
        assert np.array_equal(loop.applied_um, applied), "nobody but the guard moves the tool"
        if self.could_be_followed(loop.thermal.latest_estimate):
            self.followed = loop.thermal.latest_estimate
        if before is not None and self.memory is not None:
            self.judge_command(before, written, applied)
        if loop.nc.run is CncRun.STOP or loop.nc.sequence_number == 900:
            self.guard(alive=loop.nc.reachable)

    def judge_command(self, before, written: FloatArray, applied: FloatArray) -> None:
        memory, now = self.memory, self.memory.command_um
        assert np.isfinite(now).all() and np.isfinite(self.loop.written_um).all()
        assert np.all(np.abs(now) <= np.maximum(BOUND_UM, np.abs(before.command_um)) + NOISE_UM)
        at_once = np.abs(now - applied) <= REACH_UM + NOISE_UM  # a reference, or an acknowledged fault
        assert np.all((np.abs(now - before.command_um) <= REACH_UM + NOISE_UM) | at_once), "slew rate"
        assert np.all(np.abs(now - applied) <= np.maximum(STEP_UM, np.abs(before.command_um - applied)) + NOISE_UM)
        if not self.touched and memory.state is not OutputState.FAULT and self.loop.rig.link.session is not None:
            assert np.allclose(self.loop.written_um, now, atol=NOISE_UM), "what is commanded is written"
        adopted = memory.reference_id is not None and memory.reference_id != before.reference_id
        if adopted and memory.state in (*STILL, OutputState.ACTIVE):
            assert np.allclose(now[1:], applied[1:], atol=NOISE_UM), "a reference moves nothing"
        resting = np.array(memory.wanted) & np.array(before.wanted)
        tool_set = memory.tools is not before.tools  # what is applied, rounded by the control, is the command then
        if memory.state in STILL and before.state in STILL and not (adopted or tool_set or before.settling):
            assert np.allclose(now[resting], before.command_um[resting], atol=NOISE_UM), "frozen"
        latest = self.loop.thermal.latest
        stale = self.loop.thermal.latest_estimate is None or latest is None or np.isnan(latest.degc).all()
        if stale and memory.state is OutputState.ACTIVE:
            cycle = self.loop.rig.control._estimate
            assert cycle is not None, "nothing is followed without an estimate"

    def guard(self, *, alive: bool) -> None:
        """The NC program calls the guard at a safe point."""
        loop, before = self.loop, self.loop.applied_um
        watched = alive and self.memory is not None and self.memory.state in WATCHED and not self.touched
        commanded = self.memory is not None and watched and any(self.memory.wanted)
        status = loop.nc.safe_point()
        after = loop.applied_um
        assert np.all(np.abs(after - before) <= STEP_UM + NOISE_UM), "one step per call"
        if status is not GuardStatus.APPLIED:
            assert np.array_equal(after, before), "a block that does not count moves nothing"
        if commanded and loop.rig.link.session is not None and loop.nc.macros.get(ENABLE):
            assert status is GuardStatus.APPLIED, "the daemon lives, so its block counts"

    @invariant()
    def the_taken_offset_stays_inside_the_bound_and_is_known(self) -> None:
        applied = self.loop.applied_um
        assert np.isfinite(applied).all() and np.all(np.abs(applied) <= BOUND_UM + NOISE_UM)
        assert applied[0] == 0.0, "an axis without a model stays where it is"
        session = self.loop.rig.link.session
        if session is not None and session.echo is not None and np.isfinite(session.echo.applied_um).all():
            assert np.all(np.abs(session.echo.applied_um - applied) <= STEP_UM + ECHO_SLACK_UM)
        fault = self.loop.rig.control.journal.fault
        assert fault is None or "unexpected" not in fault, fault

    # --- sensors ---------------------------------------------------------------------------

    @rule(rise_k=st.lists(st.floats(-0.15, 0.15), min_size=5, max_size=5), moments=st.integers(1, 6))
    def the_machine_warms_or_cools(self, rise_k: list[float], moments: int) -> None:
        self.loop.rise_k = np.array(rise_k)
        self.let_pass(moments)
        self.loop.rise_k = np.zeros(5)

    @rule(which=st.sets(SENSOR, min_size=1), moments=st.integers(1, 9))
    def sensors_fall_silent(self, which: set[int], moments: int) -> None:
        self.loop.offset_k[list(which)] = np.nan
        self.let_pass(moments)

    @rule(moments=st.integers(1, 4))
    def all_sensors_fall_silent(self, moments: int) -> None:
        self.loop.offset_k[:] = np.nan
        self.let_pass(19)  # held values, means of the last minute, and the estimate: each may be a minute old
        held = self.memory.command_um.copy() if self.memory is not None else None
        state = self.memory.state if self.memory is not None else None
        self.let_pass(moments)
        if state in STILL and self.memory.state in STILL:
            assert np.array_equal(self.memory.command_um[1:], held[1:]) or not all(self.memory.wanted[1:])
        assert state is not OutputState.ACTIVE, "stale temperatures hold the output"

    @rule(sensor=SENSOR, offset_k=st.floats(-8.0, 8.0))
    def sensors_return_perhaps_with_another_offset(self, sensor: int, offset_k: float) -> None:
        """All that are silent; one that has just fallen silent where none is."""
        if not np.isnan(self.loop.offset_k).any():
            self.loop.offset_k[sensor] = np.nan
        silent = np.isnan(self.loop.offset_k)
        if silent.all() or self.loop.thermal._online.model.layout.lags_min:
            self.loop.offset_k[silent] = offset_k
            self.let_pass(4)
            return
        self.let_pass(13)  # held values have expired, and the means of the last minute stand still now
        before = self.loop.thermal.latest_estimate
        # what comes from too few sensors led nothing, so the estimate goes on from what did
        led = before if self.could_be_followed(before) else self.followed
        self.loop.offset_k[silent] = offset_k
        self.moment()
        after = self.loop.thermal.latest_estimate
        same = led is not None and after is not None and led.reference_id == before.reference_id == after.reference_id
        gone = {SENSOR_IDS[i] for i in np.flatnonzero(silent)}  # until a minute ago a held value may have counted
        if same and self.loop.thermal._reference is not None and gone <= set(before.imputed):
            fading = [rest.amount[0] for rest in self.loop.thermal._since._rest.values()]
            of_before_um = 0.4 * max(map(abs, fading), default=0.0)  # in ten seconds, of an earlier return
            moved_um = np.minimum(
                np.abs(after.thermal_error_um - before.thermal_error_um).max(),
                np.abs(after.thermal_error_um - led.thermal_error_um).max(),
            )
            assert moved_um <= 1e-6 + of_before_um, "a return is no step"
        self.let_pass(3)

    @rule(sensor=SENSOR, offset_k=st.floats(-30.0, 30.0))
    def a_sensor_lies(self, sensor: int, offset_k: float) -> None:
        self.loop.offset_k[sensor] = offset_k
        self.let_pass(4)

    # --- links and accidents -----------------------------------------------------------------

    @rule(moments=st.integers(1, 8))
    def the_link_is_lost_for_a_while(self, moments: int) -> None:
        self.loop.nc.reachable = False
        self.let_pass(moments)
        self.loop.nc.reachable = True
        self.let_pass(2)

    @rule(groups=st.integers(0, 2))
    def the_link_is_lost_within_a_write(self, groups: int) -> None:
        self.loop.nc.groups_until_lost = groups
        self.touched = True
        self.let_pass(2)
        self.loop.nc.groups_until_lost = None
        self.let_pass(1)
        self.touched = False

    @rule(number=st.sampled_from([Y, Z, ENABLE]), value=st.one_of(st.none(), st.floats(-0.1, 0.1)))
    def somebody_writes_into_the_block(self, number: int, value: float | None) -> None:
        if self.memory is None:
            return
        was = self.loop.nc.macros.get(number)
        if value is not None and was is not None and abs(value - was) < 1e-3:
            return
        self.loop.nc.macros.set(number, value)
        self.touched = True
        frozen = self.loop.applied_um
        self.runner.run(self.loop.moment())
        assert self.memory.state is OutputState.FAULT, "a foreign value is an alarm, and nothing is written"
        assert np.array_equal(self.loop.applied_um, frozen)
        self.loop.nc.macros.set(number, was)

    @rule()
    def a_person_acknowledges(self) -> None:
        refusal = self.loop.rig.acknowledge("a person")
        if not refusal:
            self.touched = False
        self.let_pass(2)

    @rule(moments=st.sampled_from([1, 3, 80]))
    def the_daemon_dies_and_starts_again(self, moments: int) -> None:
        before = self.loop.applied_um
        self.runner.run(self.loop.end())
        self.loop.clock.monotonic_s += 10.0 * moments
        self.runner.run(self.loop.start())
        self.runner.run(self.loop.moment())
        if self.memory is not None and self.memory.state is not OutputState.FAULT:
            assert np.allclose(self.memory.command_um, before, atol=REACH_UM + NOISE_UM), "it begins from the echo"
        assert np.array_equal(self.loop.applied_um, before)
        self.let_pass(2)

    @rule()
    def the_control_is_switched_off_and_on(self) -> None:
        before = self.loop.applied_um
        self.loop.nc.power_cycle()
        self.loop.nc.guard.power_cycle()
        self.moment()
        self.moment()
        assert self.memory is None or self.memory.reference_id is None
        assert self.memory is None or not self.memory.tools
        assert np.all(np.abs(self.loop.applied_um - before) <= 2 * STEP_UM + NOISE_UM)

    # --- people and programs -----------------------------------------------------------------

    @rule(axes=AXES)
    def a_person_switches_on(self, axes: frozenset[str]) -> None:
        self.loop.rig.control.request(OperatorRequest(enable=axes), "a person")
        self.let_pass(2)

    @rule(axes=AXES, zero=st.booleans())
    def a_person_switches_off(self, axes: frozenset[str], zero: bool) -> None:
        self.loop.rig.control.request(OperatorRequest(disable=axes, zero=zero), "a person")
        self.let_pass(4)

    @rule()
    def a_person_sets_a_reference(self) -> None:
        self.loop.rig.control.requests.put_reference("a person")
        self.runner.run(self.loop.hand_on())
        self.let_pass(2)

    @rule()
    def everything_is_set_right(self) -> None:
        """What a person does after an alarm: sensors mended, fault acknowledged, axes on, the work positioned."""
        self.loop.offset_k = np.nan_to_num(self.loop.offset_k)
        self.loop.nc.run, self.loop.nc.sequence_number = CncRun.START, 900
        self.a_person_acknowledges()
        self.a_person_switches_on(frozenset({"y", "z"}))
        self.the_work_is_positioned()
        self.let_pass(7)

    @rule()
    def the_work_is_positioned(self) -> None:
        nc, at = self.loop.nc, self.loop.nc.sequence_number
        before = self.loop.applied_um
        nc.run, nc.sequence_number = CncRun.START, 100
        self.let_pass(2)
        assert np.array_equal(self.loop.applied_um, before), "positioning with what is applied shows no step"
        nc.sequence_number = at
        self.let_pass(1)

    @rule(kind=st.sampled_from([REFERENCE, PROBE, TOOL_CHANGE]), value=st.floats(-0.03, 0.03), tool=st.integers(1, 3))
    def the_program_asks(self, kind: int, value: float, tool: int) -> None:
        self.counter += 1
        axis = Z_AXIS if kind != TOOL_CHANGE else 0
        ask(self.loop, self.counter, kind, axis, float(tool) if kind == TOOL_CHANGE else value)
        self.let_pass(2)

    @rule(moments=st.integers(1, 6), rise_k=st.floats(-0.15, 0.15))
    def a_cut(self, moments: int, rise_k: float) -> None:
        """The guard is not called; bad input and falling confidence freeze what is written."""
        nc, loop = self.loop.nc, self.loop
        nc.run, nc.sequence_number = CncRun.START, 500
        before = loop.applied_um
        loop.rise_k = np.full(5, rise_k)
        for _ in range(moments):
            weight = None if self.memory is None else self.memory.weight
            follows = self.memory is not None and self.memory.state in (OutputState.ACTIVE, OutputState.HOLD)
            self.moment()
            if follows and loop.rig.control.phase is Phase.CUTTING and self.memory.state in STILL:
                assert self.memory.weight == weight, "a cut freezes, it does not scale"
        loop.rise_k = np.zeros(5)
        assert np.array_equal(loop.applied_um, before), "in a cut the tool is not moved"
        nc.sequence_number = 900
        self.let_pass(1)

    @rule(work_offset=st.sampled_from([54, 55]), program=st.sampled_from([1000, 2000]))
    def another_work_offset_or_program(self, work_offset: int, program: int) -> None:
        self.loop.nc.work_offset, self.loop.nc.program = work_offset, program
        self.let_pass(2)

    @rule(stopped=st.booleans())
    def the_program_stops_or_runs(self, stopped: bool) -> None:
        self.loop.nc.run = CncRun.STOP if stopped else CncRun.START
        self.let_pass(1)

    @rule(name=st.sampled_from(list(MODELS)))
    def another_model_is_released(self, name: str) -> None:
        """The command may be on its way to what the model before had asked for: judged is what is asked for."""
        before, command = self.memory, self.loop.rig.control.command
        degc = self.loop.thermal._cleansing.mean_degc()
        self.runner.run(self.loop.use_model(MODELS[name]))
        self.moment()
        if before is None or before.state is not OutputState.ACTIVE or before.settling or self.memory.settling:
            return
        still = np.array_equal(self.loop.thermal._cleansing.mean_degc(), degc, equal_nan=True)
        same_reference = self.memory.reference_id == before.reference_id
        if still and self.memory.model_id != before.model_id and same_reference and self.memory.wanted == before.wanted:
            requested_um = self.loop.rig.control.command.requested_um
            moved = np.abs(requested_um - command.requested_um)[np.array(self.memory.wanted)]
            assert np.all(moved <= 0.1 + NOISE_UM), "the new model contributes from now on"

    @precondition(lambda self: self.policy == "zero_first")
    @rule()
    def the_program_passes_its_retreat_block(self) -> None:
        self.loop.nc.run, self.loop.nc.sequence_number = CncRun.START, 50
        self.let_pass(2)
        self.loop.nc.sequence_number = 900
        self.let_pass(3)


class ShopThatRetreatsFirst(Shop):
    policy = "zero_first"


SOME = {"stateful_step_count": 14, "deadline": None, "suppress_health_check": list(HealthCheck)}
TestShop = Shop.TestCase
TestShop.settings = settings(max_examples=8, **SOME)
TestShopThatRetreatsFirst = ShopThatRetreatsFirst.TestCase
TestShopThatRetreatsFirst.settings = settings(max_examples=4, **SOME)
