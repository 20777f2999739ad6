"""Half an hour of a fault campaign: machine and daemon in virtual time, killed, blinded, lied to."""

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from click.testing import Result as ClickResult

from daemon.cli import main
from daemon.cli.simulate.demo import demo_machine
from daemon.cli.simulate.faults import on_one_core
from daemon.history.reader import HistoryReader
from daemon.simulation.faults import campaign
from daemon.simulation.faults.result import Result, failures, numbers, summary
from daemon.simulation.faults.run import run_campaign
from daemon.simulation.faults.script import DAY_S, Happening, Incident
from drivers.sim.faults import FaultKind

pytestmark = pytest.mark.wires

SCRIPT = (
    Happening(kind=FaultKind.FROZEN_CNC, at_s=280.0, duration_s=20.0),
    Happening(kind=Incident.CUT_WRITE, at_s=330.0, amount=2.0, target=0),
    Happening(kind=Incident.KILLED_IN_WRITE, at_s=370.0, duration_s=15.0, amount=1.0),
    Happening(kind=Incident.BLIND, at_s=440.0, duration_s=110.0),
    Happening(kind=Incident.LYING_CNC, at_s=600.0, duration_s=15.0, target=2),
    Happening(kind=Incident.FOREIGN_WRITE, at_s=740.0, target=2),
    Happening(kind=Incident.CLOCK_STEP, at_s=900.0, amount=-3600.0),
    Happening(kind=Incident.FULL_DISK, at_s=940.0, duration_s=60.0),  # killed and started again meanwhile
    Happening(kind=Incident.KILLED_DAEMON, at_s=960.0, duration_s=10.0),
    Happening(kind=FaultKind.LOST_BYTES, at_s=1000.0, duration_s=30.0, target="spindle", amount=0.1),
    Happening(kind=Incident.ZEROED, at_s=1060.0, duration_s=40.0),
    Happening(kind=Incident.POWER_CYCLE, at_s=1150.0),
    # One on each line: every pass is touched, and yet temperatures arrive.
    *(Happening(kind=FaultKind.STUCK_SENSOR, at_s=1255.0, duration_s=120.0, target=i) for i in (26, 193, 281)),
)
END_S = 1400.0
WORK = (
    Happening(kind=Incident.WORK_OFFSET, at_s=300.0, duration_s=20.0),
    Happening(kind=Incident.HAND_REFERENCE, at_s=340.0),
    Happening(kind=Incident.FOREIGN_REQUEST, at_s=480.0, target=1),
    Happening(kind=Incident.MODEL_RELOAD, at_s=700.0),
    Happening(kind=Incident.WRONG_SENSOR, at_s=720.0, duration_s=2300.0, target=99, amount=20.0),
    Happening(kind=Incident.DAMAGED_MODEL, at_s=2200.0, duration_s=10.0),
    Happening(kind=Incident.OTHER_POLICY, at_s=3063.0, duration_s=5.0, target=0),  # the poll of 3062 s is kept
)
"""A part from its positioning to the next one, on which the program probes and changes tools by itself."""
WORK_END_S = 3510.0
IN_WORK = {
    "within_1_um_of_the_twin",
    "nonsense_is_refused",
    "zero_first_at_zero",
    "reference_ends",
    "request_answered",
    "model_taken_up",
    "wrong_sensor_left_out",
    "no_step_at_model",
    "no_step_at_tool",
    "no_step_at_probe",
    "probes_kept",
    "heartbeat",
}


def run(directory: Path, script: tuple[Happening, ...] = SCRIPT, *, end_s: float = END_S, **more: Any) -> Result:
    more = {"progress": lambda text: None, "seed": 4} | more
    return run_campaign(demo_machine(), directory, days=end_s / DAY_S, script=script, **more)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    directory = tmp_path_factory.mktemp("campaign")
    return directory, run(directory)


def test_nothing_is_violated_and_nothing_acknowledged_is_lost(played: tuple[Path, Result]) -> None:
    _, result = played
    assert failures(result) == []
    assert result.lost == 0
    assert result.acknowledged > 300
    counts = result.ledger.counts
    never = {name for name, count in counts.items() if not count.checked}
    assert never <= IN_WORK, "a part of a day checks every invariant"


@pytest.mark.slow
def test_a_part_with_requests_another_model_and_another_policy(tmp_path: Path) -> None:
    result = run(tmp_path, WORK, end_s=WORK_END_S)
    assert failures(result) == []
    assert {name for name in IN_WORK if not result.ledger.counts[name].checked} == set()
    assert set(result.recovery_s) >= {"work_offset", "other_policy", "damaged_model"}
    with HistoryReader(tmp_path / "history.sqlite") as reader:
        texts = [f"{event.kind} {event.text}" for event in reader.events(0.0, 1e11)]
        probes = reader.probes(0.0, 1e11)
    assert any(text.startswith("model default-") for text in texts), "taken up"
    assert any("the model in use stays" in text for text in texts), "refused"
    assert any("takes the offset out before the next positioning" in text for text in texts)
    assert any(text.startswith("tool T2") for text in texts)
    assert probes


MUTANT = """
import sys

from models.control import compensation
from models.control.compensation import Condition
from models.records import OutputState

state, condition, target = sys.argv.pop(1), sys.argv.pop(1), sys.argv.pop(1)
rows = compensation.TRANSITIONS[OutputState[state]]
compensation.TRANSITIONS[OutputState[state]] = tuple(
    (c, OutputState[target]) if c is Condition[condition] else (c, t) for c, t in rows
)
from daemon.simulation.faults.daemon import main

main()
"""


@pytest.mark.parametrize(
    ("row", "found"),
    [
        (("ACTIVE", "BAD_INPUT", "ACTIVE"), "state_after_fault"),
        (("OFF", "WANTED", "ACTIVE"), "changes_of_state_known"),
    ],
)
def test_a_daemon_with_a_wrong_transition_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, row: tuple[str, str, str], found: str
) -> None:
    """The daemon's process runs with one wrong row in the product's table of transitions."""
    program = tmp_path / "mutant.py"
    program.write_text(MUTANT)
    start = subprocess.Popen

    def start_mutant(arguments: list[str], **more: Any) -> Any:
        at = arguments.index("daemon.simulation.faults.daemon")
        return start([*arguments[: at - 1], str(program), *row, *arguments[at + 1 :]], **more)

    monkeypatch.setattr("daemon.simulation.faults.process.subprocess.Popen", start_mutant)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    script = (Happening(kind=Incident.WORK_OFFSET, at_s=220.0, duration_s=20.0),)
    (tmp_path / "campaign").mkdir()
    result = run(tmp_path / "campaign", script, end_s=340.0)
    assert result.lives == 1 and result.blocks > 0, "the mutant works, but for the row"
    assert result.ledger.counts[found].violated > 0, summary(result)


def test_every_incident_happened_and_was_got_over(played: tuple[Path, Result]) -> None:
    _, result = played
    assert set(result.incidents) == {happening.kind.value for happening in SCRIPT}
    assert set(result.recovery_s) == set(result.incidents)
    assert max(max(times) for times in result.recovery_s.values()) <= 15.0, result.recovery_s
    assert result.lives == 3
    assert {"ACTIVE", "HOLD", "FAULT", "OFF", "not running"} <= set(result.states_s)
    assert sum(result.states_s.values()) == pytest.approx(END_S, abs=130.0)


def test_the_store_tells_the_same_story(played: tuple[Path, Result]) -> None:
    directory, _ = played
    with HistoryReader(directory / "history.sqlite") as reader:
        texts = [f"{event.kind} {event.text} {event.person}" for event in reader.events(0.0, 1e11)]
    assert any(text.startswith("fault read-back differs") for text in texts)
    assert any("we wrote" in text and "-> FAULT" in text for text in texts)
    assert any("acknowledge the fault" in text and f"pid {os.getpid()}" in text for text in texts)


def test_the_result_is_json_and_words(played: tuple[Path, Result]) -> None:
    _, result = played
    content = json.loads(json.dumps(numbers(result), allow_nan=False))
    assert {"invariants", "states_s", "recovery_s", "acknowledged_cycles_lost", "rss_growth_mib"} <= set(content)
    assert all(set(count) == {"checked", "violated"} for count in content["invariants"].values())
    assert all(set(times) == {"p50", "max"} for times in content["recovery_s"].values())
    assert "0 violations" in summary(result)


def test_the_same_seed_gives_the_same_run(tmp_path: Path) -> None:
    script = (Happening(kind=FaultKind.NOISE, at_s=200.0, duration_s=60.0, target="saddle", amount=0.02),)
    accounts = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        result = run(folder, script, end_s=300.0)
        accounts.append((result.states_s, result.blocks, result.cycles, result.acknowledged))
        with HistoryReader(folder / "history.sqlite") as reader:
            accounts[-1] += ([(w.time_s, w.compensation_um) for w in reader.writes(0.0, 1e11)],)
    assert accounts[0] == accounts[1]


def test_a_daemon_that_dies_by_itself_and_a_greedy_one_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody else kills the daemon behind the campaign's back, and the limit of memory is none at all."""
    monkeypatch.setattr(campaign, "GROWTH_MIB", -1.0)
    killed: list[int] = []
    start = campaign.Campaign._start

    def start_and_kill(self: campaign.Campaign) -> Any:
        process = start(self)
        if not killed:
            killed.append(process.pid)
            os.kill(process.pid, signal.SIGKILL)
        return process

    monkeypatch.setattr(campaign.Campaign, "_start", start_and_kill)
    result = run(tmp_path, (), end_s=200.0)
    assert {name for name, count in result.ledger.counts.items() if count.violated} == {
        "nothing_unexpected",
        "memory_growth",
    }
    assert any("the daemon ended by itself" in text for text in failures(result))


def toolpoint(*arguments: str) -> ClickResult:
    return CliRunner().invoke(main, ["faults", *arguments])


def test_a_campaign_stays_on_one_core_of_those_that_it_was_given() -> None:
    given = os.sched_getaffinity(0)
    with on_one_core(2**31 - 1):
        (core,) = os.sched_getaffinity(0)
    assert core in given
    assert os.sched_getaffinity(0) == given


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--days", "0"), "0.01<=x<=366"),
        (("--days", "nan"), "finite"),
        (("--seed", "-1"), "0<=x<=2147483647"),
        (("--days", "0.01", "--directory", "/proc/none"), "cannot be used"),
    ],
)
def test_bad_usage_is_refused_in_a_sentence(arguments: tuple[str, ...], sentence: str) -> None:
    done = toolpoint(*arguments)
    assert done.exit_code == 2 and isinstance(done.exception, SystemExit)
    assert sentence in done.stderr
