"""The demonstration on a computer that is too slow for it: said, with a speed that it may keep."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from daemon.cli.simulate.demo import CNC_WIRES, demo_machine
from daemon.simulation.demonstration import result, switch_on_again, too_slow
from daemon.simulation.processes import write_simulation_configuration


@pytest.mark.parametrize("driver", CNC_WIRES)
def test_every_simulated_control_tells_the_tool_in_the_spindle(tmp_path: Path, driver: str) -> None:
    """Its program names no tool: where the latest T word was all, the demonstration of a FANUC followed nothing."""
    content = demo_machine()
    assert content["compensation"]["axes"]["z"]["tool_term"]
    _, configuration = write_simulation_configuration(content, tmp_path, speed=1.0, driver=driver)
    assert not configuration.cnc.tells_prepared_tool


@pytest.mark.parametrize(
    ("late_s", "advice"), [(0.120, "use --speed 5"), (0.0, "use --speed 30"), (5.0, "end other programs")]
)
def test_a_computer_that_is_too_slow_is_told_which_speed_it_may_keep(late_s: float, advice: str) -> None:
    told = too_slow(late_s, speed=60.0, cycle_period_s=5.0, lines=True)
    assert told.startswith("this computer is too slow, or too busy, for --speed 60: ")
    assert f"waited up to {late_s * 1e3:.0f} ms for its turn, and a line that is silent for 50 ms has ended" in told
    assert told.endswith(advice)
    alone = too_slow(late_s, speed=60.0, cycle_period_s=5.0, lines=False)
    assert "line" not in alone and "the next reading of a source is due after 83 ms" in alone


@pytest.mark.parametrize(
    ("sent", "received", "told"),
    [
        ({"bed": 900}, 899, True),
        ({"bed": 900, "box": 150}, 1048, False),
        ({"bed": 900, "box": 150}, 1047, True),
        ({"bed": 900, "box": 150}, 1052, False),
        ({"bed": 900, "box": 150}, 1053, True),
        ({"bed": 900}, 901, True),
    ],
)
def test_a_cycle_of_a_line_must_arrive_once_and_of_a_source_one_of_a_hundred_may_be_merged_or_split(
    sent: dict[str, int], received: int, told: bool
) -> None:
    """Runs failed by one cycle of a source that a busy computer had merged with the next one, or split."""
    failures = result(final_of(sent), status_with(received=received), 60.0, 5.0)[1]
    assert failures[1:] == ([f"{sum(sent.values())} cycles were sent, {received} arrived"] if told else [])


def final_of(sent: dict[str, int], late_real_s: float = 0.0) -> dict[str, Any]:
    return {"truth": {}, "cycles_sent": sent, "cycles_disturbed": {"bed": 0}, "late_real_s": late_real_s}


def status_with(received: int, incomplete: int = 0, slowest_s: float | None = 0.0) -> dict[str, Any]:
    delay = dict.fromkeys(("mean", "p50", "p99", "max"), slowest_s)
    return {
        "axes": {},
        "spindle_speed": None,
        "cycles": {"received": received, "incomplete": incomplete},
        "estimates": 9,
        "writes": {"sent": 1, "verified": 1},
        "latency_s": {"feedback": delay, "total": delay},
        "output": {"state": "ACTIVE", "reason": ""},
        "written_axes": [],
    }


def test_why_cycles_did_not_arrive_is_said_first() -> None:
    final, slow = final_of({"bed": 900, "box": 150}, 0.120), too_slow(0.120, speed=60.0, cycle_period_s=5.0, lines=True)
    said = result(final, status_with(received=1000), 60.0, 5.0)[1]
    assert said == [slow, "1050 cycles were sent, 1000 arrived"]
    assert result(final, status_with(received=1050), 60.0, 5.0)[1] == []
    without_lines = final_of({"box": 150}, 0.120) | {"cycles_disturbed": {}}
    assert "of a source is due" in result(without_lines, status_with(received=100), 60.0, 5.0)[1][0]


@pytest.mark.parametrize(("slowest_s", "told"), [(0.41, True), (0.05, False), (None, False)])
def test_a_daemon_that_stood_for_a_cycle_of_the_machine_s_time_is_why_the_output_went_off(
    slowest_s: float | None, told: bool
) -> None:
    """At sixty times the speed 0.41 s without a poll are 25 s, which end a reference; nothing said so."""
    status = status_with(received=900, slowest_s=slowest_s)
    status["output"] = {"state": "FAULT", "reason": "for the test"}
    said = result(final_of({"bed": 900}), status, 60.0, 5.0)[1]
    assert said[-1] == "the output ended in FAULT: for the test"
    assert (said[:-1] == [too_slow(0.41, speed=60.0, cycle_period_s=5.0, lines=True)]) == told == (len(said) == 2)


@pytest.mark.parametrize(
    ("reason", "again"),
    [
        (
            "held too long, so a person must switch it on again; the reason then: temperatures are stale (612 s old)",
            True,
        ),
        ("switched off", False),
        ("following the estimate", False),
    ],
)
def test_what_was_held_too_long_is_switched_on_again_and_what_a_person_switched_off_stays_off(
    reason: str, again: bool
) -> None:
    asked: list[str] = []
    running: Any = SimpleNamespace(client=SimpleNamespace(ask=asked.append))
    assert switch_on_again(running, {"output": {"state": "OFF", "reason": reason}}) == again
    assert asked == ["enable"] * again


def test_a_run_in_which_nobody_switches_on_fails_for_nothing_that_follows_from_it() -> None:
    """It ended with 1 because the error had not become less, and on a busy computer with 1 and no check that failed."""
    final = final_of({"bed": 900}, late_real_s=0.41)
    final["truth"] = {"z": {"uncompensated_max_um": 23.7, "compensated_max_um": 23.7}}
    status = status_with(received=900)
    status["writes"] = {"sent": 0, "verified": 0}
    axis = {"estimate_from": "Z1", "applied_um": None, "bound_um": 60.0, "wanted": False}
    status["axes"] = {"z": axis}
    numbers, failures = result(final, status, 60.0, 5.0, enabled=False)
    assert failures == []
    assert numbers["error_um"]["z"]["verdict"] == "not_judged"
    assert len(result(final, status, 60.0, 5.0)[1]) == 5
    status |= {"writes": {"sent": 9, "verified": 7}, "axes": {"z": axis | {"applied_um": 0.0}}}
    said = result(final, status, 60.0, 5.0, enabled=False)[1]
    assert said[1:] == ["2 writes were not verified", "axis z: 23.7 um left of 23.7 um"]
    assert said[0].startswith("this computer is too slow")
