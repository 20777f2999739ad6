"""The guard moves an axis after the work was positioned, before its reference counts."""

from pathlib import Path

import pytest
from control_rig import Bench, record_for, running

from config.records.commissioning import CommissionedAxis
from daemon.messages import ReferenceRequest


@pytest.mark.parametrize("lost", [False, True], ids=["answered late", "written late"])
async def test_a_guard_between_the_positioning_and_its_reference_ends_it(tmp_path: Path, lost: bool) -> None:
    """Loading a model or the history keeps the estimation for seconds, and a lost link the new block."""
    bench = Bench(tmp_path)
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -20.0, 8)  # on its way, at its slew
        rig.nc.sequence_number = 100
        await rig.turn(rig.estimate(0.0, -20.0), safe=False)
        asked = next(item for item in reversed(rig.asked) if isinstance(item, ReferenceRequest))
        for _ in range(5):
            await rig.turn(rig.estimate(0.0, -20.0), safe=False)
        stood_um = rig.applied["z"]
        rig.nc.sequence_number = 900
        if lost:
            rig.set_reference(asked.reference_id)
            rig.nc.groups_until_lost = 0
            await rig.turn(rig.estimate(0.0, 0.0))
            await rig.connected()
        else:
            await rig.follow(0.0, -20.0, 2)
            rig.set_reference(asked.reference_id)
        await rig.turn(rig.estimate(0.0, 0.0), safe=False)
        await rig.follow(0.0, 0.0, 20)
        assert lost or abs(rig.applied["z"] - stood_um) > 1.0
        assert rig.state == "HOLD" and "between the positioning and its reference" in rig.control.reference_ended
        rig.nc.sequence_number = 100
        await rig.turn(rig.estimate(0.0, 0.0))
        stood_um = rig.applied["z"]
        rig.set_reference(next(item.reference_id for item in reversed(rig.asked) if isinstance(item, ReferenceRequest)))
        await rig.follow(0.0, 0.0, 12)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(stood_um, abs=0.11)


async def test_what_it_has_moved_meanwhile_counts_as_the_axis_moves_and_not_as_it_is_written(tmp_path: Path) -> None:
    """0.6 um of the macro are 3 um of an axis that moves five times as far."""
    bench = Bench(tmp_path)
    scales = {"y": 1.0, "z": 5.0}
    proved = {a: CommissionedAxis(sign=1, scale=s, written_um=10.0, measured_um=10.0 * s) for a, s in scales.items()}
    async with running(bench.rig(record=record_for(bench.configuration, axes=proved))) as rig:
        await rig.active()
        await rig.follow(0.0, -20.0, 8)
        rig.nc.sequence_number = 100
        await rig.turn(rig.estimate(0.0, -20.0), safe=False)
        asked = next(item for item in reversed(rig.asked) if isinstance(item, ReferenceRequest))
        stood_um = rig.applied["z"]
        rig.nc.sequence_number = 900
        await rig.follow(0.0, -20.0, 3)
        assert 0.2 < abs(rig.applied["z"] - stood_um) < 1.0, "of the macro"
        rig.set_reference(asked.reference_id)
        await rig.follow(0.0, 0.0, 20)
        assert rig.state == "HOLD" and "between the positioning and its reference" in rig.control.reference_ended
