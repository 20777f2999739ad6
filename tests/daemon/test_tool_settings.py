"""Tool settings: kept per tool, over the end of the work's reference and a restart; never over a power cycle."""

import pytest
from control_rig import running
from nc_requests import REFERENCE, TOOL_CHANGE, Z_AXIS, answer, ask, requesting_bench, tool_2_set

from config.schema.cnc_drivers import FocasConfig
from daemon.messages import ReferenceEnded, ReferenceTakenUp


@pytest.fixture
def bench(tmp_path):
    return requesting_bench(tmp_path)


async def take_tool_2(rig, bench, counter, z_um):
    ask(bench, counter, TOOL_CHANGE, 0, 2.0)
    await rig.follow(0.0, z_um, 40)


async def test_another_work_offset_ends_the_reference_and_no_tool_setting(bench):
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.work_offset = 55
        await rig.turn()
        assert rig.control.reference is None and rig.state == "HOLD"
        ended = [item for item in rig.asked if isinstance(item, ReferenceEnded)]
        assert [(item.reference_id, item.for_good) for item in ended] == [("r1", False)]
        await rig.follow(0.0, -15.0, 5, reference_id="r1")
        rig.set_reference("r2")
        await rig.follow(0.0, 0.0, 5)
        assert rig.applied["z"] == pytest.approx(12.0, abs=0.11), "tool 1 stays where it is"
        await take_tool_2(rig, bench, 4, -1.0)
        assert rig.applied["z"] == pytest.approx(8.0 + 7.0 + 1.0, abs=0.11)
        assert not any("tool settings" in notice for notice in rig.control.journal.notices)


async def test_a_power_cycle_ends_them_and_says_which(bench):
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.power_cycle()
        await rig.turn()
        await rig.turn()
        assert not rig.control.memory.tools and rig.control._references.kept_id is None
        assert any("settings of T2 have ended" in notice for notice in rig.control.journal.notices)
        assert rig.asked[-1] == ReferenceEnded(reference_id="r1", for_good=True)


async def test_a_power_cycle_after_the_end_of_the_reference_ends_them_too(bench):
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.program = 2000
        await rig.turn()
        assert list(rig.control.memory.tools) == [2]
        bench.nc.power_cycle()
        await rig.turn()
        await rig.turn()
        assert not rig.control.memory.tools


@pytest.mark.parametrize("ended", [False, True])
async def test_a_restart_takes_them_up_again_valid_reference_or_not(bench, ended):
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        if ended:
            bench.nc.work_offset = 55
            await rig.turn()
        rig.alive()
    bench.nc.work_offset = 55
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.reference is None
        assert [type(item) for item in rig.asked] == [ReferenceTakenUp], (
            "what the settings count from is estimated again"
        )
        await rig.follow(0.0, -13.0, 3, reference_id="r1")
        rig.set_reference("r2")
        await rig.follow(0.0, 0.0, 10)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(12.0, abs=0.11)
        await take_tool_2(rig, bench, 4, -1.0)
        assert rig.applied["z"] == pytest.approx(8.0 + 5.0 + 1.0, abs=0.11)


async def test_a_restart_after_a_power_cycle_does_not(bench):
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        rig.alive()
    bench.nc.power_cycle()
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert not rig.control.memory.tools
        assert any("settings of T2 have ended" in notice for notice in rig.control.journal.notices)
        assert rig.asked == []


async def test_a_tool_that_is_prepared_in_the_cut_lends_its_setting_to_none_in_the_spindle(bench):
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.work_offset = 55
        await rig.turn()
        await rig.follow(0.0, -15.0, 5, reference_id="r1")
        rig.set_reference("r2")
        await rig.follow(0.0, 0.0, 10)
        stood = rig.applied["z"]
        bench.nc.tool_number = 2  # what #4120 says when T2 is prepared while T1 cuts
        await rig.follow(0.0, 0.0, 40)
        assert rig.applied["z"] == pytest.approx(stood, abs=0.01)
        assert rig.state == "HOLD" and "shows T2, and the NC program has named T1" in rig.control.memory.reason
        ask(bench, 4, TOOL_CHANGE, 0, 2.0)
        await rig.follow(0.0, 0.0, 40)
        assert rig.state == "ACTIVE" and answer(bench) == 4.0
        assert rig.applied["z"] == pytest.approx(8.0 + 7.0, abs=0.11), "its own setting, and what came since"


async def test_where_the_control_tells_the_latest_t_word_alone_nothing_is_followed_until_the_program_has_named_its_tool(
    bench,
):
    """T2 is prepared while T1 cuts: neither its setting nor its expansion is that of the tool in the spindle."""
    cnc = bench.configuration.cnc.model_copy(update={"focas": FocasConfig(host="192.168.10.20")})
    bench.configuration = bench.configuration.model_copy(update={"cnc": cnc})
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        ask(bench, 1, TOOL_CHANGE, 0, 2.0)
        await rig.follow(0.0, -8.0, 40)
        ask(bench, 2, REFERENCE, Z_AXIS)
        await rig.follow(0.0, -8.0, 4)
        ask(bench, 3, TOOL_CHANGE, 0, 1.0)
        await rig.follow(0.0, -12.0, 30)
        bench.nc.program = 2000
        await rig.turn()
        bench.nc.program = 1000
        await rig.follow(0.0, -12.0, 5, reference_id="r1")
        rig.set_reference("r2")
        await rig.follow(0.0, 0.0, 10)
        stood = rig.applied["z"]
        for shown in (1, 2):
            bench.nc.tool_number = shown
            await rig.follow(0.0, -3.0, 40)
            assert rig.state == "HOLD" and f"T{shown} is the latest T word" in rig.control.memory.reason
            assert rig.applied["z"] == pytest.approx(stood, abs=0.01)
        ask(bench, 4, REFERENCE, Z_AXIS)
        await rig.follow(0.0, -3.0, 4)
        assert answer(bench) == -4.0
        ask(bench, 5, TOOL_CHANGE, 0, 1.0)
        await rig.follow(0.0, -3.0, 40)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(stood + 3.0, abs=0.11)


async def test_another_program_that_names_no_tool_has_what_the_control_shows(bench):
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.tool_number = 2
        await rig.turn()
        bench.nc.program = 2000
        await rig.turn()
        assert rig.control._measured.tool.number == 2 and rig.control._measured.tool.inhibit() is None


async def test_where_no_tool_is_set_and_none_expands_its_number_holds_nothing(bench):
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        ask(bench, 1, TOOL_CHANGE, 0, 1.0)
        await rig.follow(0.0, -3.0, 4)
        bench.nc.tool_number = 2
        await rig.follow(0.0, -3.0, 10)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(3.0, abs=0.11)


async def test_while_it_is_not_known_which_tool_is_there_none_is_set_and_a_reference_leaves_both_in_doubt(bench):
    """The program gave up naming T1, as while the link was away: the control alone shows it."""
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.tool_number = 2
        await take_tool_2(rig, bench, 4, -12.0)
        bench.nc.tool_number = 1
        await rig.follow(0.0, -12.0, 5)
        assert rig.state == "HOLD" and "shows T1, and the NC program has named T2" in rig.control.memory.reason
        ask(bench, 5, REFERENCE, 3, 0.0)
        await rig.follow(0.0, -12.0, 5)
        assert answer(bench) == -5.0
        rig.set_reference("r2")
        await rig.follow(0.0, 0.0, 5)
        bench.nc.tool_number = 2
        ask(bench, 6, TOOL_CHANGE, 0, 2.0)
        await rig.follow(0.0, 0.0, 40)
        assert rig.state == "HOLD" and "T2 was set" in rig.control.memory.reason
        assert "any number of um off" in rig.control.memory.reason
        ask(bench, 7, REFERENCE, 3, 0.0)
        await rig.follow(0.0, 0.0, 10)
        assert answer(bench) == 7.0 and rig.state == "ACTIVE"


@pytest.mark.parametrize("restarted", [False, True])
async def test_a_tool_that_was_shown_before_the_one_that_is_shown_now_is_in_doubt_too(bench, restarted):
    """The control shows the tool that is prepared: the one that came unnamed is neither that nor the named one."""
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        bench.nc.tool_number = 2
        await rig.follow(0.0, -16.0, 10)
        bench.nc.tool_number = 3
        await rig.follow(0.0, -16.0, 5)
        assert rig.state == "HOLD" and "shows T3, and the NC program has named T1" in rig.control.memory.reason
        rig.alive()
        if not restarted:
            await work_positioned_with_tool_2(rig, bench)
    if restarted:
        bench.clock.monotonic_s += 5.0
        async with running(bench.rig()) as rig:
            await rig.turn()
            await rig.follow(0.0, -16.0, 5)
            await work_positioned_with_tool_2(rig, bench)


async def work_positioned_with_tool_2(rig, bench):
    rig.set_reference("r2")
    await rig.follow(0.0, 0.0, 5)
    ask(bench, 4, TOOL_CHANGE, 0, 2.0)
    await rig.follow(0.0, 0.0, 40)
    assert rig.applied["z"] == pytest.approx(12.0, abs=0.11), "where the work was positioned with it"
    assert rig.state == "HOLD" and "T2 was set" in rig.control.memory.reason


async def test_nor_is_the_very_first_tool_set_while_it_is_not_known_which_one_is_there(bench):
    """The program gave up naming T1: its setting would be that of T2, which is followed when T2 comes."""
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        bench.nc.tool_number = 2
        ask(bench, 1, TOOL_CHANGE, 0, 2.0)
        await rig.follow(0.0, -3.0, 20)
        bench.nc.tool_number = 1
        await rig.follow(0.0, -3.0, 5)
        ask(bench, 2, REFERENCE, 3, 0.0)
        await rig.follow(0.0, -3.0, 5)
        assert rig.state == "ACTIVE" and answer(bench) == -2.0
        assert "shows T1, and the NC program has named T2" in rig.control.journal.notices[-1]
        ask(bench, 3, TOOL_CHANGE, 0, 1.0)
        await rig.follow(0.0, -3.0, 5)
        ask(bench, 4, REFERENCE, 3, 0.0)
        await rig.follow(0.0, -3.0, 5)
        assert answer(bench) == 4.0 and [*rig.control.memory.tools] == [1]
