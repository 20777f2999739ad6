"""What goes wrong on the wires, while the whole daemon runs: the output holds, recovers, and never jumps."""

import pytest
from wires import check_audit, on_wires

from daemon.history.reader import HistoryReader

pytestmark = [pytest.mark.wires, pytest.mark.slow]


def link(status, name):
    return next(link for link in status["links"] if link["name"] == name)


def test_disturbed_lines_do_not_disturb_the_output(tmp_path):
    """Lost bytes, noise, a port that is pulled out and put back, nodes that are renumbered.

    So few bytes are lost that no sensor is silent for a minute: the nose warms by 1.5 K meanwhile, as it did not
    before, and one of its two sensors that is back before the other would be doubted until the next positioning.
    """
    faults = [
        {"kind": "lost_bytes", "at_s": 260, "duration_s": 100, "target": "spindle", "amount": 0.03},
        {"kind": "noise", "at_s": 260, "duration_s": 100, "target": "saddle", "amount": 0.05},
        {"kind": "unplugged", "at_s": 400, "duration_s": 60, "target": "fixed"},
        {"kind": "renumbered", "at_s": 500, "duration_s": 200, "target": "saddle", "amount": 5},
    ]
    with on_wires(tmp_path, speed=60.0, faults=faults) as wires:
        wires.switch_on()
        wires.wait_until(400.0)
        status = wires.status()
        assert status["cycles"]["incomplete"] > 0
        assert status["output"]["state"] in ("ACTIVE", "HOLD")
        wires.wait("the port to be gone", lambda status: not link(status, "latsis fixed")["up"])
        wires.wait("the port to be back", lambda status: link(status, "latsis fixed")["up"])
        wires.wait_until(530.0)
        wires.wait(
            "the quarantine",
            lambda status: any("quarantine" in why for why in status["temperatures"]["not_good"].values()),
        )
        wires.wait_for_state("ACTIVE")
        wires.check_nothing_broke()
        check_audit(wires.writes(), wires.configuration, begun_s=wires.begun_s())
        assert wires.status()["writes"]["refused"] == 0


def test_one_dead_line_is_imputed_and_three_hold_the_output(tmp_path):
    faults = [{"kind": "dead_line", "at_s": 250, "duration_s": 350, "target": "fixed"}]
    faults += [{"kind": "dead_line", "at_s": 380, "duration_s": 220, "target": name} for name in ("spindle", "saddle")]
    with on_wires(tmp_path, speed=60.0, faults=faults) as wires:
        wires.switch_on()
        wires.wait_until(376.0)
        status = wires.status()
        assert status["temperatures"]["usable"] < status["temperatures"]["total"]
        assert status["estimate"]["imputed"] and status["estimate"]["confidence"] < 1.0
        held = wires.wait("stale temperatures", lambda status: "stale" in status["output"]["reason"])
        assert held["output"]["state"] == "HOLD"
        frozen = {axis: state["written_um"] for axis, state in held["axes"].items()}
        while True:
            status = wires.status()
            if wires.running.time_s > 590.0:
                break
            assert status["output"]["state"] == "HOLD", status["output"]
            assert {axis: state["written_um"] for axis, state in status["axes"].items()} == frozen
            wires.let_pass(6.0)
        wires.wait_for_state("ACTIVE")
        wires.wait("every sensor", lambda status: status["temperatures"]["usable"] == status["temperatures"]["total"])
        wires.check_nothing_broke()
        check_audit(wires.writes(), wires.configuration, begun_s=wires.begun_s())


def test_a_cnc_that_freezes_or_dies_is_found_again(tmp_path):
    faults = [
        {"kind": "frozen_cnc", "at_s": 260, "duration_s": 150},
        {"kind": "killed_cnc", "at_s": 480, "duration_s": 60},
    ]
    with on_wires(tmp_path, speed=60.0, faults=faults) as wires:
        reference = wires.switch_on()["reference"]["id"]
        for _ in ("frozen", "killed"):
            held = wires.wait_for_state("HOLD")
            assert "CNC" in held["output"]["reason"]
            assert held["reference"]["id"] == reference
            status = wires.wait_for_state("ACTIVE")
            assert link(status, "cnc")["up"] and status["reference"]["id"] == reference
        wires.check_nothing_broke()
        assert not [entry for entry in wires.log if entry["event"] == "output.fault"]
        check_audit(wires.writes(), wires.configuration, unverified=3, begun_s=wires.begun_s())
        with HistoryReader(wires.configuration.history.path) as reader:
            unsettled = [record.write_id for record in reader.unsettled_writes()]
            assert all(write_id >= reader.writes(0.0, 1e11)[-2].write_id for write_id in unsettled), "one is on its way"
