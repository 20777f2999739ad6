"""The control task: what it writes, what it refuses to write, and how it comes back."""

import asyncio
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import structlog

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from control_rig import (
    BLOCK,
    ENABLE,
    SEQUENCE_A,
    SEQUENCE_B,
    VALID_UNTIL,
    HandClock,
    Rig,
    Y,
    Z,
    machine,
    record_for,
    running,
)
from memory_cnc import MemoryNc

from config.schema.cnc import OpcUaConfig
from daemon.history import HistoryReader
from daemon.thermal import ReferenceRequest
from drivers.clock import SystemClock
from models.compensation import OperatorRequest
from models.records import CncRun, Reference, WriteOutcome

ACKNOWLEDGE = OperatorRequest(acknowledge=True)


class Bench:
    """A directory, a clock and a control that outlive one run of the daemon."""

    def __init__(self, directory: Path, **changes) -> None:
        self.configuration = machine(directory, **changes)
        self.clock = HandClock()
        self.nc = MemoryNc(self.configuration, self.clock)

    def rig(self, **changes) -> Rig:
        content = {"record": record_for(self.configuration)} | changes
        return Rig(self.configuration, self.nc, self.clock, **content)


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


@pytest.fixture
async def rig(bench):
    async with running(bench.rig()) as rig:
        yield rig


def texts(logs, event):
    return [entry["text"] for entry in logs if entry["event"] == event]


# --- following -----------------------------------------------------------------------------


async def test_the_tool_point_is_moved_against_the_error(rig):
    await rig.active()
    await rig.follow(5.0, -12.0)
    assert rig.state == "ACTIVE"
    assert rig.applied == pytest.approx({"x": 0.0, "y": -5.0, "z": 12.0}, abs=0.11)
    assert rig.control.writes["verified"] == rig.control.writes["sent"] > 0
    assert rig.control.written_axes == {"y", "z"}


async def test_the_block_is_written_first_to_last_with_valid_until_on_the_clock_of_the_cnc(rig, bench):
    await rig.active()
    bench.nc.written.clear()
    await rig.turn(rig.estimate(0.0, -3.0), safe=False)
    numbers = [number for number, _ in bench.nc.written]
    values = dict(bench.nc.written)
    assert sorted(numbers) == sorted(BLOCK)
    assert numbers[0] == SEQUENCE_A and numbers[-1] == SEQUENCE_B
    assert values[SEQUENCE_A] == values[SEQUENCE_B]
    validity_s = bench.configuration.compensation.output.validity_s
    assert values[VALID_UNTIL] == pytest.approx(bench.nc.clock_s + validity_s, abs=0.01)
    assert values[ENABLE] == 0b110
    assert abs(bench.nc.clock_s - bench.clock.monotonic_s) > 100, "the clocks differ, or nothing is shown"


async def test_nothing_is_written_before_a_person_asks(rig, bench):
    await rig.turn()
    rig.set_reference()
    await rig.follow(5.0, 5.0, 5)
    assert bench.nc.written == []


async def test_slew_rate_and_bound_hold_whatever_is_estimated(rig, bench):
    await rig.active()
    before = 0.0
    for error in (-500.0, 500.0, -7.0, 300.0):
        for _ in range(30):
            await rig.turn(rig.estimate(0.0, error))
            now = bench.nc.macros.get(Z) * 1000.0
            assert abs(now - before) <= 60.0 / 60.0 * 0.5 + 1e-6
            assert abs(now) <= 30.0 + 1e-9
            before = now


async def test_nan_never_leaves(rig, bench):
    await rig.active()
    await rig.follow(3.0, -3.0, 10)
    await rig.follow(np.nan, np.nan, 5)
    assert rig.state == "HOLD"
    assert np.isfinite([value for _, value in bench.nc.written]).all()
    assert rig.applied == pytest.approx({"x": 0.0, "y": -3.0, "z": 3.0}, abs=0.11)
    await rig.follow(3.0, -3.0, 3)
    assert rig.state == "ACTIVE"


# --- what a person asks --------------------------------------------------------------------


async def test_requests_that_cannot_be_met_are_refused_in_words(rig):
    assert "not been reached" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
    await rig.turn()
    assert "no axis w" in rig.control.request(OperatorRequest(enable=frozenset({"w"})), "p")
    assert "no axis w" in rig.control.request(OperatorRequest(disable=frozenset({"w"})), "p")
    assert "axis x has no model" in rig.control.request(OperatorRequest(enable=frozenset({"x"})), "p")
    await rig.turn()
    assert not any(rig.control.memory.wanted)


async def test_without_a_commissioning_record_nothing_is_enabled(bench):
    async with running(bench.rig(record=None)) as rig:
        await rig.turn()
        assert "no commissioning record" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")


async def test_the_record_of_another_control_or_macro_map_does_not_count(bench):
    for changes, words in (
        ({"cnc_identity": "urn:other"}, "is for 'urn:other'"),
        ({"macro_map_sha256": "0" * 64}, "macro map has changed"),
        ({"axes": {}}, "not commissioned: axis z"),
    ):
        async with running(bench.rig(record=record_for(bench.configuration, **changes))) as rig:
            await rig.turn()
            assert words in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")


async def test_without_a_model_nothing_is_enabled(bench):
    async with running(bench.rig(model_obstacle="no thermal model is configured")) as rig:
        await rig.turn()
        assert "no thermal model" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")


async def test_a_disabled_axis_retreats_alone(rig):
    await rig.active()
    await rig.follow(-4.0, -6.0, 20)
    assert rig.control.request(OperatorRequest(disable=frozenset({"y"})), "p") == ""
    await rig.follow(-4.0, -6.0, 20)
    assert rig.state == "ACTIVE"
    assert rig.applied == pytest.approx({"x": 0.0, "y": 0.0, "z": 6.0}, abs=0.11)


async def test_switching_off_retreats_and_then_writes_enable_0_once(rig, bench):
    await rig.active()
    await rig.follow(-4.0, -6.0, 20)
    rig.control.request(OperatorRequest(disable=frozenset({"y", "z"}), zero=True), "p")
    await rig.follow(-4.0, -6.0, 30)
    assert rig.state == "OFF"
    assert rig.applied == pytest.approx({"x": 0.0, "y": 0.0, "z": 0.0}, abs=1e-6)
    assert bench.nc.macros.get(ENABLE) == 0.0
    bench.nc.written.clear()
    await rig.follow(-4.0, -6.0, 200)
    assert bench.nc.written == []


async def test_zero_retreats_to_zero_and_not_to_the_baseline(rig):
    await rig.active()
    await rig.follow(-4.0, -8.0, 20)
    rig.set_reference("r2")
    await rig.follow(0.0, 0.0, 5)
    rig.control.request(OperatorRequest(disable=frozenset({"y", "z"})), "p")
    await rig.follow(0.0, 0.0, 20)
    assert rig.applied["z"] == pytest.approx(8.0, abs=0.11), "the reference's baseline"
    rig.control.request(OperatorRequest(zero=True), "p")
    await rig.follow(0.0, 0.0, 30)
    assert rig.applied["z"] == pytest.approx(0.0, abs=1e-6)
    assert rig.state == "OFF"


async def test_switched_on_and_off_within_one_turn_both_are_heard(rig):
    await rig.turn()
    rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
    rig.control.request(OperatorRequest(disable=frozenset({"z"})), "p")
    await rig.turn()
    await rig.turn()
    assert rig.control.memory.wanted == (False, False, False)


# --- reference -----------------------------------------------------------------------------


async def test_setting_a_reference_does_not_move_the_output(rig, bench):
    await rig.active()
    await rig.follow(0.0, -15.0)
    before = bench.nc.macros.get(Z)
    rig.set_reference("r2")
    await rig.follow(0.0, 0.0, 5)
    assert bench.nc.macros.get(Z) == pytest.approx(before, abs=1e-9)
    await rig.follow(0.0, -2.0, 10)
    assert bench.nc.macros.get(Z) * 1000 == pytest.approx(before * 1000 + 2.0, abs=0.11)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda nc: setattr(nc, "program", 2000), "program changed"),
        (lambda nc: setattr(nc, "work_offset", 55), "work offset changed"),
        (lambda nc: nc.power_cycle(), "switched off and on"),
        (lambda nc: setattr(nc, "clock_zero_s", nc.clock_zero_s - 100.0), "clock went back"),
    ],
)
async def test_the_reference_ends_and_the_output_holds(rig, bench, change, words):
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    change(bench.nc)
    await rig.turn(rig.estimate(0.0, -25.0))
    await rig.follow(0.0, -25.0, 10)
    assert rig.control.reference is None
    assert any(words in notice for notice in rig.control.notices)
    assert rig.state == "HOLD"
    assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)
    assert rig.history.get_state("reference") is None
    rig.set_reference("r2")
    await rig.follow(0.0, 0.0, 10)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_a_positioning_block_asks_for_a_reference_once(rig, bench):
    await rig.turn()
    bench.nc.sequence_number = 100
    for _ in range(5):
        await rig.turn()
    assert len(rig.asked) == 1
    request = rig.asked[0]
    assert isinstance(request, ReferenceRequest)
    assert (request.source, request.program, request.work_offset) == ("O1000 N100", 1000, 54)


async def test_a_reference_by_hand_names_the_person_and_needs_a_link(rig, bench):
    await rig.turn()
    assert rig.control.request_reference("Ada (uid 7)") == ""
    assert "Ada" in rig.asked[0].source
    bench.nc.reachable = False
    await rig.turn()
    assert "no link" in rig.control.request_reference("Ada")


async def test_an_estimate_of_another_reference_moves_nothing(rig, bench):
    await rig.active()
    await rig.follow(0.0, -5.0, 15)
    await rig.follow(0.0, -25.0, 10, reference_id="old")
    assert rig.state == "HOLD"
    assert rig.applied["z"] == pytest.approx(5.0, abs=0.11)


# --- output not trusted --------------------------------------------------------------------


async def test_a_foreign_value_is_a_fault_until_it_is_acknowledged(rig, bench):
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    bench.nc.macros.set(Z, 0.002)
    bench.nc.written.clear()
    await rig.turn(rig.estimate(0.0, -10.0))
    assert rig.state == "FAULT"
    assert f"#{Z} holds 0.002" in rig.control.alarm
    await rig.follow(0.0, -10.0, 20)
    assert rig.state == "FAULT" and bench.nc.written == []
    applied = dict(rig.applied)
    assert rig.control.request(ACKNOWLEDGE, "p") == ""
    await rig.turn(safe=False)
    assert rig.control.memory.state == "HOLD" or rig.state == "ACTIVE"
    assert bench.nc.macros.get(Z) * 1000 == pytest.approx(applied["z"], abs=0.6)
    await rig.follow(0.0, -10.0, 20)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_a_fault_while_retreating_can_be_left(rig, bench):
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    rig.control.request(OperatorRequest(zero=True), "p")
    await rig.turn()
    bench.nc.macros.set(Y, 0.001)
    await rig.turn()
    assert rig.state == "FAULT"
    rig.control.request(ACKNOWLEDGE, "p")
    await rig.follow(0.0, -10.0, 40)
    assert rig.state == "OFF"
    assert rig.applied["z"] == pytest.approx(0.0, abs=1e-6)


async def test_a_read_back_that_differs_is_a_fault(rig, bench):
    await rig.active()
    bench.nc.forgets = Z
    await rig.turn(rig.estimate(0.0, -5.0))
    assert rig.control.receipt.outcome is WriteOutcome.DIFFERS
    bench.nc.written.clear()
    await rig.follow(0.0, -5.0, 10)
    assert rig.state == "FAULT" and bench.nc.written == []
    assert "read-back" in rig.control.memory.reason or "holds" in rig.control.memory.reason
    bench.nc.forgets = None
    rig.control.request(ACKNOWLEDGE, "p")
    await rig.follow(0.0, -5.0, 30)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(5.0, abs=0.11)


async def test_a_refused_write_is_a_fault_and_counted(rig, bench):
    await rig.active()
    bench.nc.refuses = Z
    await rig.turn(rig.estimate(0.0, -5.0))
    bench.nc.written.clear()
    await rig.follow(0.0, -5.0, 10)
    assert rig.state == "FAULT" and bench.nc.written == []
    assert rig.control.writes["refused"] == 1
    bench.nc.refuses = None
    rig.control.request(ACKNOWLEDGE, "p")
    await rig.follow(0.0, -5.0, 30)
    assert rig.state == "ACTIVE"


async def test_an_unknown_exception_latches_a_fault_and_the_loop_goes_on(rig, bench):
    await rig.active()
    await rig.follow(0.0, -5.0, 15)
    with structlog.testing.capture_logs() as logs:
        bench.nc.breaks = ZeroDivisionError("nobody expected this")
        await rig.turn(rig.estimate(0.0, -5.0))
    assert [entry for entry in logs if entry["event"] == "control.defect"]
    bench.nc.written.clear()
    await rig.follow(0.0, -5.0, 10)
    assert rig.state == "FAULT" and "ZeroDivisionError" in rig.control.alarm
    assert bench.nc.written == []
    assert rig.control.session.sample.time.monotonic_s == rig.clock.monotonic_s, "it still polls"
    rig.control.request(ACKNOWLEDGE, "p")
    await rig.follow(0.0, -5.0, 5)
    assert rig.state == "ACTIVE"


@pytest.mark.parametrize("vacant", [SEQUENCE_A, Z, ENABLE, SEQUENCE_B])
async def test_a_vacant_macro_at_the_start_is_an_alarm_and_nothing_is_written(bench, vacant):
    bench.nc.macros.set(vacant, None)
    async with running(bench.rig()) as rig:
        for _ in range(3):
            await rig.turn()
        assert f"#{vacant} is vacant" in rig.control.alarm
        rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        await rig.turn()
        assert bench.nc.written == []


@pytest.mark.parametrize("vacant", [SEQUENCE_A, Z, ENABLE, SEQUENCE_B])
async def test_acknowledging_does_not_make_a_vacant_macro_ours(bench, vacant):
    bench.nc.macros.set(vacant, None)
    async with running(bench.rig()) as rig:
        await rig.turn()
        rig.control.request(ACKNOWLEDGE, "p")
        await rig.turn()
        rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        for _ in range(5):
            await rig.turn()
        assert bench.nc.written == []
        assert rig.state == "FAULT"
        bench.nc.macros.set(vacant, 0.0)
        await rig.turn()
        rig.control.request(ACKNOWLEDGE, "p")
        await rig.turn()
        await rig.turn()
        assert rig.state != "FAULT", rig.control.memory.reason


async def test_a_vacant_echo_at_the_start_is_an_alarm_and_nothing_is_written(bench):
    bench.nc.macros.set(513, None)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert "echo" in rig.control.alarm
        assert "not been reached" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        await rig.turn()
        assert bench.nc.written == []
        bench.nc.macros.set(513, 0.0)
        await rig.turn()
        await rig.turn()
        assert rig.state == "OFF" and rig.control.alarm == ""


async def test_power_off_clears_valid_until_and_that_is_no_fault(rig, bench):
    await rig.active()
    bench.nc.power_cycle()
    for _ in range(5):
        await rig.turn()
    assert rig.state == "HOLD"


async def test_enable_bits_that_nobody_here_has_set_are_a_fault(bench):
    bench.nc.macros.set(ENABLE, 4.0)
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.turn()
        assert rig.state == "FAULT" and "enable bits" in rig.control.alarm
        assert bench.nc.written == []


# --- the link ------------------------------------------------------------------------------


@pytest.mark.parametrize("groups", [0, 1, 2])
async def test_a_link_lost_while_writing_is_no_fault_and_is_made_good(rig, bench, groups):
    await rig.active()
    await rig.follow(0.0, -8.0, 5)
    bench.nc.groups_until_lost = groups
    clients = len(bench.nc.opened)
    await rig.turn(rig.estimate(0.0, -8.0))
    assert rig.link.session is None
    await rig.connected()
    assert len(bench.nc.opened) == clients + 1, "a new client"
    assert bench.nc.opened[-2].closed
    await rig.follow(0.0, -8.0, 30)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(8.0, abs=0.11)
    assert rig.control.output_fault is None
    assert rig.control.writes["sent"] == rig.control.writes["verified"] + 1


async def test_a_foreign_value_is_still_seen_after_a_lost_write(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 5)
    bench.nc.groups_until_lost = 1
    await rig.turn(rig.estimate(0.0, -8.0))
    bench.nc.macros.set(Z, 0.0199)
    await rig.connected()
    bench.nc.written.clear()
    await rig.follow(0.0, -8.0, 5)
    assert rig.state == "FAULT" and bench.nc.written == []


async def test_without_the_link_the_output_holds_and_then_goes_on(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 20)
    bench.nc.reachable = False
    await rig.follow(0.0, -20.0, 10)
    assert rig.state == "HOLD" and "no link" in rig.control.memory.reason
    bench.nc.reachable = True
    await rig.connected()
    value = bench.nc.macros.get(Z)
    await rig.turn(rig.estimate(0.0, -20.0))
    assert abs(bench.nc.macros.get(Z) - value) * 1000 <= 0.51
    await rig.follow(0.0, -20.0, 40)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(20.0, abs=0.11)


async def test_acknowledging_without_a_link_is_not_lost_for_ever(rig, bench):
    await rig.active()
    bench.nc.macros.set(Z, 0.002)
    await rig.turn()
    bench.nc.reachable = False
    await rig.turn()
    rig.control.request(ACKNOWLEDGE, "p")
    await rig.turn()
    bench.nc.reachable = True
    await rig.connected()
    await rig.turn()
    assert rig.state == "FAULT"
    rig.control.request(ACKNOWLEDGE, "p")
    await rig.follow(0.0, 0.0, 5)
    assert rig.state == "ACTIVE"


async def test_another_control_behind_the_same_address_is_never_written_to(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 20)
    bench.nc.reachable = False
    await rig.turn()
    bench.nc.identity, bench.nc.reachable = "urn:another-control", True
    await rig.connected()
    bench.nc.written.clear()
    await rig.follow(0.0, -8.0, 5)
    assert rig.state == "HOLD" and "urn:another-control" in rig.control.memory.reason
    assert bench.nc.written == []


async def test_a_scaled_clock_never_drives_a_control_that_is_not_simulated(bench):
    bench.nc.macros.set(513, 0.005)  # it applies an offset, so that the output begins in HOLD
    bench.nc.guard.applied_um["z"] = 5.0
    bench.nc.identity = "urn:a-real-control"
    bench.clock.speed = 60.0
    record = record_for(bench.configuration, cnc_identity="urn:a-real-control")
    async with running(bench.rig(record=record)) as rig:
        await rig.turn()
        assert "clock is simulated" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        rig.control.request(OperatorRequest(zero=True), "p")
        for _ in range(5):
            await rig.turn()
        assert bench.nc.written == []


async def test_an_insecure_connection_is_never_written_over(tmp_path):
    opcua = OpcUaConfig(endpoint="opc.tcp://127.0.0.1:1/none", namespace_uri="urn:toolpoint:cnc")
    bench = Bench(tmp_path, cnc={"opcua": opcua})
    bench.nc.macros.set(513, 0.005)
    bench.nc.guard.applied_um["z"] = 5.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert "not secure" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        rig.control.request(OperatorRequest(zero=True), "p")
        for _ in range(5):
            await rig.turn()
        assert bench.nc.written == []


# --- restart -------------------------------------------------------------------------------


async def leave(bench, error_um=-10.0):
    """Run until the output is active with an offset, then end as a crash would: without a word."""
    async with running(bench.rig()) as rig:
        await rig.active()
        rig.history.put_state("alive_utc_s", bench.clock.now().utc_s)
        await rig.follow(0.0, error_um, 60)
        assert rig.state == "ACTIVE"
        return rig.control.reference


async def test_a_restart_resumes_from_the_echo_with_the_same_reference(bench):
    left = await leave(bench)
    bench.clock.monotonic_s += 30.0
    value = bench.nc.macros.get(Z)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.state == "HOLD"
        assert isinstance(rig.asked[0], Reference)
        assert rig.control.reference.reference_id == left.reference_id
        for _ in range(30):
            await rig.turn(rig.estimate(0.0, -10.0))
            assert bench.nc.macros.get(Z) == pytest.approx(value, abs=0.11e-3), "no step and no creep"
        assert rig.state == "ACTIVE"
        await rig.follow(0.0, -12.0, 20)
        assert rig.applied["z"] == pytest.approx(12.0, abs=0.11)


async def test_a_restart_keeps_the_baseline_of_the_second_reference(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -10.0, 40)
        rig.set_reference("r2")
        await rig.follow(0.0, -3.0, 20)
        rig.history.put_state("alive_utc_s", bench.clock.now().utc_s)
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -3.0, 20)
        assert rig.applied["z"] == pytest.approx(13.0, abs=0.11)
        rig.control.request(OperatorRequest(disable=frozenset({"y", "z"})), "p")
        await rig.follow(0.0, -3.0, 30)
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11), "retreats to that reference's baseline"


async def test_what_the_error_did_during_the_outage_is_made_good(bench):
    await leave(bench)
    bench.clock.monotonic_s += 30.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -14.0, 20)
        assert rig.applied["z"] == pytest.approx(14.0, abs=0.11)


async def test_an_estimate_right_after_the_restart_does_not_count_twice(bench):
    await leave(bench)
    async with running(bench.rig()) as rig:
        await rig.control._guarded(rig.control._poll())
        rig.control.deliver(rig.estimate(0.0, -10.0))
        await rig.follow(0.0, -10.0, 20)
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_a_reference_without_its_baseline_is_not_taken_up(bench):
    await leave(bench)
    async with running(bench.rig()) as rig:
        rig.history.put_state("rest", None)
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -20.0, 3)
        assert rig.state == "HOLD" and rig.control.reference is None
        assert "baseline was not stored" in rig.control.notices[-1]
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_acknowledging_where_nothing_is_wrong_changes_nothing(rig):
    await rig.active()
    await rig.follow(0.0, -10.0, 10)
    assert rig.control.request(ACKNOWLEDGE, "p") == ""
    await rig.control._guarded(rig.control._act(None))  # before the next poll
    await rig.follow(0.0, -10.0, 5)
    assert rig.state == "ACTIVE"


async def test_a_differing_read_back_is_acknowledged_before_the_next_poll(rig, bench):
    await rig.active()
    bench.nc.forgets = Z
    await rig.turn(rig.estimate(0.0, -5.0))
    bench.nc.forgets = None
    rig.control.request(ACKNOWLEDGE, "p")
    await rig.control._guarded(rig.control._act(None))
    await rig.control._guarded(rig.control._act(None))
    await rig.follow(0.0, -5.0, 5)
    assert rig.state == "ACTIVE"


async def test_after_a_long_outage_the_output_holds_without_a_reference(bench):
    await leave(bench)
    bench.clock.monotonic_s += 2000.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -20.0, 5)
        assert rig.control.reference is None
        assert rig.state in ("HOLD", "RETREAT")


async def test_after_a_power_cycle_the_old_reference_is_not_taken_up(bench):
    await leave(bench)
    bench.nc.power_cycle()
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -20.0, 3)
        assert rig.control.reference is None
        assert rig.state == "HOLD"
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_a_foreign_value_written_during_the_outage_is_a_fault(bench):
    await leave(bench)
    bench.nc.macros.set(Z, 0.025)
    bench.nc.written.clear()
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -20.0, 3)
        assert rig.state == "FAULT" and bench.nc.written == []


async def test_every_write_is_in_the_audit(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -5.0, 10)
        sent = rig.control.writes["sent"]
    with HistoryReader(bench.configuration.history.path) as reader:
        records = reader.writes(0.0, 1e11)
        assert len(records) == sent
        assert all(record.outcome is WriteOutcome.VERIFIED for record in records)
        assert reader.unsettled_writes() == []
        assert any(event.kind == "request" and event.person == "a person" for event in reader.events(0.0, 1e11))


# --- the loop itself -----------------------------------------------------------------------


async def test_the_loop_polls_ticks_writes_and_survives_a_defect(tmp_path):
    configuration = machine(tmp_path)
    clock = SystemClock()
    nc = MemoryNc(configuration, clock)
    async with running(Rig(configuration, nc, clock, record=record_for(configuration))) as rig:
        task = asyncio.create_task(rig.control.run())
        try:
            await until(lambda: rig.control.memory is not None)
            rig.set_reference()
            rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
            rig.control.deliver(rig.estimate(0.0, 0.0))
            await until(lambda: rig.state == "ACTIVE")
            assert rig.control.writes["verified"] > 0
            ticks = rig.ticks
            nc.breaks = RuntimeError("made up")
            await until(lambda: rig.state == "FAULT")
            await until(lambda: rig.ticks > ticks + 1)
            assert not task.done()
            rig.control.stop()
            async with asyncio.timeout(10):
                await task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def test_an_estimate_is_written_without_waiting_for_the_next_tick(tmp_path):
    """The tick is a minute here: only the estimate itself can cause the write."""
    configuration = machine(tmp_path, tick_s=60.0, validity_s=100.0)
    clock = SystemClock()
    nc = MemoryNc(configuration, clock)
    async with running(Rig(configuration, nc, clock, record=record_for(configuration))) as rig:
        task = asyncio.create_task(rig.control.run())
        try:
            await until(lambda: rig.control.memory is not None)
            rig.set_reference()
            rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
            for _ in range(3):
                rig.control.deliver(rig.estimate(0.0, -5.0))
                writes = rig.control.writes["verified"]
                await until(lambda writes=writes: rig.control.writes["verified"] > writes, 20.0)
            assert rig.state == "ACTIVE"
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def until(condition, timeout_s=30.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        await asyncio.sleep(0.005)


async def test_everything_that_is_not_known_to_be_harmless_is_cutting(rig, bench):
    await rig.turn()
    assert rig.control.phase.value == "cutting"
    bench.nc.sequence_number = 900
    await rig.turn()
    assert rig.control.phase.value == "safe point"
    bench.nc.run = CncRun.HOLD
    await rig.turn()
    assert rig.control.phase.value == "cutting"
    bench.nc.run = CncRun.RESET
    await rig.turn()
    assert rig.control.phase.value == "idle"
