"""The daemon is killed in the middle and comes back."""

import random

import pytest
from wires import FIRST_REFERENCE_S, check_audit, on_wires

from daemon.history import HistoryReader

pytestmark = [pytest.mark.wires, pytest.mark.slow]


def patient(content):
    """The time of the simulation runs fast and the store hears of it every ten seconds of the wall clock only."""
    content["compensation"]["reference"]["max_outage_s"] = 3600.0


def test_killed_at_any_moment_it_loses_nothing_and_goes_on(tmp_path):
    moments = random.Random(7)
    with on_wires(tmp_path, speed=60.0, change=patient) as wires:
        status = wires.switch_on()
        reference = status["reference"]["id"]
        wires.wait_until(FIRST_REFERENCE_S + 90.0)
        for _ in range(3):
            wires.let_pass(moments.uniform(3.0, 36.0))
            acknowledged = wires.status()["history"]["acknowledged"]
            wires.kill_daemon()
            with HistoryReader(wires.configuration.history.path) as reader:
                stored = reader.acknowledged()
                before = [record for record in reader.writes(0.0, 1e11) if record.compensation_um][-1]
            for line, number in acknowledged.items():
                assert stored[line] >= number, line
            wires.start_daemon()
            status = wires.wait_for_state("ACTIVE")
            assert status["reference"]["id"] == reference
            last = before.write_id
            wires.wait("a block", lambda _, last=last: any(record.write_id > last for record in wires.writes()))
            after = next(record for record in wires.writes() if record.write_id > last)
            for axis, limits in wires.configuration.compensation.axes.items():
                moved = abs(after.compensation_um[axis] - before.compensation_um[axis])
                assert moved <= limits.step_um, (axis, before, after)
        wires.check_nothing_broke()
        check_audit(wires.writes(), wires.configuration, unverified=3, begun_s=wires.begun_s())
        assert not [entry for entry in wires.log if entry["event"] == "output.fault"]
