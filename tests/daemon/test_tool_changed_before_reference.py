"""A tool that comes between a positioning and its late reference is not taken for the one that was positioned with."""

from pathlib import Path

import pytest
from control_rig import running
from nc_requests import REFERENCE, Z_AXIS, ask, requesting_bench


@pytest.mark.parametrize("comes_before_the_reference", [False, True])
async def test_a_tool_that_was_set_stands_where_it_was_set_or_the_output_holds(
    tmp_path: Path, comes_before_the_reference: bool
) -> None:
    """The output is 8 um behind when the work is positioned with T1; T2 is to go on from its own setting."""
    bench = requesting_bench(tmp_path)
    rig = bench.rig()
    nc = bench.nc
    async with running(rig):
        await rig.active()
        nc.tool_number = 2
        await rig.follow(0.0, 0.0, 2)
        ask(bench, 1, REFERENCE, Z_AXIS)
        await rig.follow(0.0, 0.0, 4)
        assert set(rig.control.memory.tools) == {2}
        nc.tool_number = 1
        await rig.follow(0.0, 6.0, 40)
        assert rig.applied["z"] == pytest.approx(-6.0, abs=0.2)
        nc.sequence_number = 100
        await rig.turn(rig.estimate(0.0, 14.0), safe=False)
        (asked,) = [each for each in rig.asked if getattr(each, "source", "") == "O1000 N100"]
        nc.sequence_number = 20
        await rig.turn(rig.estimate(0.0, 14.0), safe=False)
        if comes_before_the_reference:
            nc.tool_number = 2
            await rig.turn(rig.estimate(0.0, 14.0), safe=False)
        rig.set_reference(asked.reference_id)
        await rig.turn(rig.estimate(0.0, 14.0), safe=False)
        await rig.follow(0.0, 0.0, 3)
        nc.tool_number = 2
        await rig.follow(0.0, 0.0, 60)
        if comes_before_the_reference:
            assert rig.state == "HOLD" and "the tool" in rig.control.memory.reason
        else:
            assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(-14.0, abs=0.3)


@pytest.mark.parametrize("number", [1, 2])
async def test_where_no_tool_was_set_it_goes_on(tmp_path: Path, number: int) -> None:
    bench = requesting_bench(tmp_path)
    rig = bench.rig()
    async with running(rig):
        await rig.active()
        bench.nc.sequence_number = 100
        await rig.turn(rig.estimate(0.0, 0.0), safe=False)
        (asked,) = [each for each in rig.asked if getattr(each, "source", "") == "O1000 N100"]
        bench.nc.tool_number, bench.nc.sequence_number = number, 20
        await rig.turn(rig.estimate(0.0, 0.0), safe=False)
        rig.set_reference(asked.reference_id)
        await rig.follow(0.0, 0.0, 4)
        assert rig.state == "ACTIVE"
