"""What a tool's expansion counts from when the daemon was restarted, no label has spoken yet, or it is set."""

import pytest
from control_rig import Bench, Rig, running
from nc_requests import REFERENCE, TOOL_CHANGE, Y_AXIS, Z_AXIS, answer, ask, requesting_bench, tool_2_set

from config.schema.compensation import ToolTermConfig

TERM = ToolTermConfig(length_mm=200.0, expansion_um_per_m_k=10.0, temperatures={"A": 1.0})
"""2 um per kelvin."""


def expanding_bench(tmp_path) -> Bench:
    """A machine whose tools expand with label A."""
    bench = requesting_bench(tmp_path)
    compensation = bench.configuration.compensation
    axes = compensation.axes | {"z": compensation.axes["z"].model_copy(update={"tool_term": TERM})}
    compensation = compensation.model_copy(update={"axes": axes})
    bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})
    return bench


async def let_pass(rig: Rig, seconds: float, nose_k: float | None, z_um: float = -4.0) -> None:
    """Let time pass in steps of 5 s; None: the label has no value, as long as nothing was heard of it."""
    label = {} if nose_k is None else {"A": nose_k}
    for _ in range(round(seconds / 5.0)):
        await rig.turn(rig.estimate(0.0, z_um, label_increment_degc=label), after_s=5.0)


async def warmed(rig: Rig) -> None:
    """The nose warms by 5 K, which is 4 um of the nose and 10 um of tool 1."""
    await rig.active(handshake=True)
    await let_pass(rig, 60.0, 5.0)
    assert rig.applied["z"] == pytest.approx(14.0, abs=0.11)
    rig.alive()


@pytest.mark.parametrize(("away_s", "known"), [(5.0, True), (40.0, True), (300.0, False)])
async def test_a_tool_that_came_while_the_daemon_was_away_has_not_expanded_since_the_reference(tmp_path, away_s, known):
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
    bench.clock.monotonic_s += away_s
    bench.nc.tool_number = 7
    async with running(bench.rig()) as rig:
        await rig.turn()
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == ("ACTIVE" if known else "HOLD"), rig.control.memory.reason
        assert rig.applied["z"] == pytest.approx(4.0 if known else 14.0, abs=0.11)
        await let_pass(rig, 60.0, 6.0)
        assert rig.applied["z"] == pytest.approx(6.0 if known else 14.0, abs=0.11)
        bench.nc.tool_number = 8
        await let_pass(rig, 60.0, 6.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0, abs=0.11)


def counting_bench(tmp_path) -> Bench:
    """Its NC counts the tools that come into the spindle in #561."""
    bench = expanding_bench(tmp_path)
    compensation = bench.configuration.compensation
    reference = compensation.reference.model_copy(update={"tool_counter": 561})
    compensation = compensation.model_copy(update={"reference": reference})
    bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})
    bench.nc.macros.set(561, 40.0)
    return bench


@pytest.mark.parametrize("away", [False, True])
@pytest.mark.parametrize("came", [0, 1, 2])
async def test_a_tool_that_goes_and_comes_back_between_two_polls_is_known_by_the_count_of_the_nc(tmp_path, came, away):
    bench = counting_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
        if not away:
            bench.nc.macros.set(561, 40.0 + came)
            await let_pass(rig, 60.0, 5.0)
            assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0 if came else 14.0, abs=0.11)
            return
    bench.clock.monotonic_s += 40.0
    bench.nc.macros.set(561, 40.0 + came)
    async with running(bench.rig()) as rig:
        await rig.turn()
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0 if came else 14.0, abs=0.11)


async def named_tool_1(rig: Rig, bench: Bench) -> None:
    """The nose warms by 5 K, and the program names the tool that is in the spindle already."""
    await warmed(rig)
    ask(bench, 1, TOOL_CHANGE, 0, 1.0)
    await let_pass(rig, 10.0, 5.0)
    await let_pass(rig, 60.0, 10.0)
    assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(14.0, abs=0.11), "4 of the nose, 10 of the tool"


@pytest.mark.parametrize("away", [False, True])
async def test_a_tool_that_the_program_has_named_goes_and_comes_back_too(tmp_path, away):
    """The program does not name it again, as where a person has looked at its edge."""
    bench = counting_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await named_tool_1(rig, bench)
        bench.nc.reachable = not away
        await let_pass(rig, 5.0, 10.0)
        bench.nc.macros.set(561, 42.0)
        bench.nc.reachable = True
        await rig.connected()
        await let_pass(rig, 60.0, 10.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0, abs=0.11)
        await let_pass(rig, 60.0, 11.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(6.0, abs=0.11)


async def test_another_tool_that_the_program_has_not_named_leaves_the_named_one_unknown_until_it_is_named(tmp_path):
    """What a control shows may be the next tool: T1 came back, or T7 is in the spindle and T1 is prepared."""
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await named_tool_1(rig, bench)
        for shown in (7, 1):
            bench.nc.tool_number = shown
            await let_pass(rig, 300.0, 10.0)
            assert rig.state == "HOLD" and rig.applied["z"] == pytest.approx(14.0, abs=0.11)
        assert "has shown T7 since the NC program named T1" in rig.control.memory.reason
        rig.alive()
    async with running(bench.rig()) as rig:
        await rig.turn()
        await let_pass(rig, 60.0, 10.0)
        assert rig.state == "HOLD" and "has shown T7" in rig.control.memory.reason, "after a restart too"
        ask(bench, 2, TOOL_CHANGE, 0, 1.0)
        await let_pass(rig, 60.0, 10.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0, abs=0.11)


async def test_a_count_that_is_vacant_for_a_while_tells_nothing(tmp_path):
    bench = counting_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
        for vacant in (None, 40.0):
            bench.nc.macros.set(561, vacant)
            await let_pass(rig, 30.0, 5.0)
            assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(14.0, abs=0.11)
        bench.nc.tool_number = 7
        bench.nc.macros.set(561, 41.0)
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0, abs=0.11)


@pytest.mark.parametrize("count", [0.0, 39.0, 40.5, 80.0, 1e9])
async def test_a_count_that_somebody_has_typed_or_that_begins_again_brings_no_tool(tmp_path, count):
    """Before, the tool counted as one that had just come, and went back by its expansion, in ACTIVE."""
    bench = counting_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
        bench.nc.macros.set(561, count)
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "HOLD" and "no estimate for axis z" in rig.control.memory.reason
        assert rig.applied["z"] == pytest.approx(14.0, abs=0.11)
        bench.nc.macros.set(561, 7.0)
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "HOLD", "nor does one that is set right again"
        bench.nc.macros.set(561, 8.0)
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0, abs=0.11), "a tool has come"


@pytest.mark.parametrize("held_s", [0.0, 30.0, 55.0])
async def test_a_tool_that_came_while_the_daemon_was_away_counts_right_though_a_sensor_missed_the_first_cycles(
    tmp_path, held_s
):
    """The first estimate after the restart holds a value of before it; the sensor is heard 10 s later."""
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
    bench.clock.monotonic_s += 40.0
    bench.nc.tool_number = 7
    async with running(bench.rig()) as rig:
        await rig.turn()
        for _ in range(2):
            held = rig.estimate(0.0, -4.0, label_increment_degc={"A": 5.0}, held_s=held_s)
            await rig.turn(held, after_s=5.0)
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "ACTIVE", rig.control.memory.reason
        assert rig.applied["z"] == pytest.approx(4.0, abs=0.11), "of the nose alone: tool 7 came at its temperature"


@pytest.mark.parametrize("heard", [False, True])
async def test_a_tool_that_came_while_the_daemon_was_away_is_unknown_when_it_ends_before_any_estimate(tmp_path, heard):
    """What the tool begins at is told by the first estimate after it came; the next run cannot tell it any more."""
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
    bench.clock.monotonic_s += 20.0
    bench.nc.tool_number = 7
    async with running(bench.rig()) as rig:
        await rig.turn()
        if heard:
            await let_pass(rig, 5.0, 5.0)
        rig.alive()
    bench.clock.monotonic_s += 5.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        await let_pass(rig, 60.0, 5.0)
        if heard:
            assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0, abs=0.11)
            return
        assert rig.state == "HOLD" and "no estimate for axis z" in rig.control.memory.reason
        assert rig.applied["z"] == pytest.approx(14.0, abs=0.11)
        bench.nc.tool_number = 8
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(4.0, abs=0.11)


@pytest.mark.parametrize(("silent_s", "known"), [(0.0, True), (30.0, True), (120.0, False)])
async def test_a_tool_that_comes_before_the_first_estimate_after_a_restart(tmp_path, silent_s, known):
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
        await let_pass(rig, 300.0, 5.0)
    bench.clock.monotonic_s += 5.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        bench.nc.tool_number = 7
        await rig.turn()
        bench.clock.monotonic_s += silent_s
        await rig.turn()
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == ("ACTIVE" if known else "HOLD"), rig.control.memory.reason
        assert rig.applied["z"] == pytest.approx(4.0 if known else 14.0, abs=1.0)


async def test_a_tool_that_comes_before_its_label_has_spoken_since_the_reference_holds(tmp_path):
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
        rig.set_reference("r2", handshake=True)
        await let_pass(rig, 100.0, None)
        stood = rig.applied["z"]
        bench.nc.tool_number = 7
        await let_pass(rig, 100.0, None)
        await let_pass(rig, 100.0, 5.0)
        assert rig.state == "HOLD" and "no estimate" in rig.control.memory.reason
        assert rig.applied["z"] == pytest.approx(stood, abs=0.11)
        rig.set_reference("r3", handshake=True)
        await let_pass(rig, 100.0, 0.0, z_um=0.0)
        assert rig.state == "ACTIVE", rig.control.memory.reason


async def test_a_tool_that_came_while_the_link_was_lost_for_long_holds(tmp_path):
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
        bench.nc.reachable = False
        await let_pass(rig, 300.0, 5.0)
        bench.nc.tool_number, bench.nc.reachable = 7, True
        await rig.connected()
        await let_pass(rig, 60.0, 5.0)
        assert rig.state == "HOLD" and rig.applied["z"] == pytest.approx(14.0, abs=0.11)


async def test_the_tool_that_the_program_has_named_is_known_after_a_restart(tmp_path):
    """The control shows the one that is prepared while the other cuts."""
    bench = requesting_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.tool_number = 2
        await rig.turn()
        assert "shows T2, and the NC program has named T1" in rig.control.memory.reason
        rig.alive()
    bench.clock.monotonic_s += 20.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -12.0, 10)
        assert rig.state == "HOLD" and "shows T2, and the NC program has named T1" in rig.control.memory.reason
        assert rig.control._measured.tool.number == 1


@pytest.mark.parametrize(("axis", "counts_on"), [(Y_AXIS, True), (Z_AXIS, False)])
async def test_a_tool_that_is_set_goes_on_expanding_along_an_axis_on_which_it_was_not(tmp_path, axis, counts_on):
    """Before, a setting on Y let the expansion along Z begin anew: the tool went back by all of it, in ACTIVE."""
    bench = expanding_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await warmed(rig)
        ask(bench, 1, REFERENCE, axis)
        await let_pass(rig, 60.0, 5.0)
        assert answer(bench) == 1.0 and rig.state == "ACTIVE"
        assert rig.applied["z"] == pytest.approx(14.0, abs=0.11), "nothing has gone on since"
        assert (rig.control._references.memory.record.tool is None) is counts_on
        await let_pass(rig, 60.0, 6.0)
        assert rig.applied["z"] == pytest.approx(16.0, abs=0.11)


async def test_a_tool_that_is_set_on_one_axis_goes_on_expanding_along_another_that_expands_too(tmp_path):
    """Before, the expansion began anew along both: along Y the tool went back by all of it, in ACTIVE."""
    bench = expanding_bench(tmp_path)
    compensation = bench.configuration.compensation
    axes = compensation.axes | {"y": compensation.axes["y"].model_copy(update={"tool_term": TERM})}
    compensation = compensation.model_copy(update={"axes": axes})
    bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})

    def stands(rig: Rig, y_um: float, z_um: float) -> None:
        assert rig.state == "ACTIVE", rig.control.memory.reason
        assert [rig.applied[axis] for axis in "yz"] == pytest.approx([y_um, z_um], abs=0.11)

    async with running(bench.rig()) as rig:
        await warmed(rig)
        stands(rig, 10.0, 14.0)
        ask(bench, 1, REFERENCE, Z_AXIS)
        await let_pass(rig, 60.0, 5.0)
        assert answer(bench) == 1.0
        stands(rig, 10.0, 14.0)
        await let_pass(rig, 60.0, 6.0)
        stands(rig, 12.0, 16.0)
        rig.alive()
    bench.clock.monotonic_s += 5.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        await let_pass(rig, 60.0, 6.0)
        stands(rig, 12.0, 16.0)
        bench.nc.tool_number = 7
        await let_pass(rig, 90.0, 6.0)
        stands(rig, 0.0, 4.0)
