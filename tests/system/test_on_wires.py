"""One daemon on real wires from its start to its end: kills, a model that is released, a shift of commands.

Machine and daemon are started once: that takes longer than what they do here, one thing after the other.
"""

import csv
import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from heaps import thread_heaps
from wires import EVER, FIRST_REFERENCE_S, FOREVER_S, Wires, check_audit, on_wires

from config.machines import shipped_file
from daemon.cli import main
from daemon.history.reader import HistoryReader
from models.thermal.family import model_from_json
from models.thermal.linear import LinearModel

pytestmark = [pytest.mark.wires, pytest.mark.slow]


def configured(path: Path) -> str:
    return str(path / "toolpoint.yaml")


@pytest.fixture(scope="module")
def wires(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Wires]:
    folder = tmp_path_factory.mktemp("wires")
    first = folder / "first.json"
    first.write_text(shipped_file("simulated_machine_model.json").read_text("utf-8"), "utf-8")

    def change(content: dict[str, Any]) -> None:
        # The simulation's time runs fast, and the store hears of it every ten seconds of the wall clock only.
        content["compensation"]["reference"]["max_outage_s"] = 3600.0
        content["compensation"]["model_file"] = str(folder / "models/model.json")
        Path(configured(folder)).write_text(json.dumps(content), encoding="utf-8")
        of_models("release", str(first), "--note", "first", folder=folder)

    # Slow enough that the start of a daemon is a short outage of the machine, also where the computer is slow: what a
    # sensor did meanwhile is doubted by how far it has gone.
    with on_wires(folder, speed=20.0, change=change) as started:
        started.switch_on()
        yield started


def toolpoint(*arguments: str, folder: Path) -> Result:
    return CliRunner().invoke(main, [*arguments, "--config", configured(folder)])


def told(*arguments: str, folder: Path) -> str:
    finished = toolpoint(*arguments, folder=folder)
    assert finished.exit_code == 0, finished.stderr
    return finished.stdout


def of_models(*arguments: str, folder: Path) -> Any:
    """Run `toolpoint model ...`; return what it writes as JSON."""
    answer = folder / "answer.json"
    told("model", *arguments, "--json", str(answer), folder=folder)
    return json.loads(answer.read_text(encoding="utf-8"))


def test_killed_at_any_moment_it_loses_nothing_and_goes_on(wires: Wires) -> None:
    moments = random.Random(7)
    status = wires.status()
    assert status["model"]["release"] == 1 and "uid" in status["model"]["released_by"]
    assert "allow_writable_model_directory" in status["model"]["warning"]
    assert status["output"]["writable_model_directory"] is True
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


def other_model() -> LinearModel:
    """Return the shipped model with every coefficient half as large again: its estimate would jump by half."""
    shipped = model_from_json(shipped_file("simulated_machine_model.json").read_text("utf-8"), "shipped")
    assert isinstance(shipped, LinearModel) and not shipped.drift_um_per_min.any()
    solutions = tuple(replace(one, weights=1.5 * one.weights) for one in shipped.solutions)
    vectors = tuple(replace(v, thermal_error_um=1.5 * v.thermal_error_um) for v in shipped.test_vectors)
    return replace(shipped, model_id="half-as-much-again", solutions=solutions, test_vectors=vectors)


def said_of_models(store: Path, last: str) -> list[str]:
    """Return the events about models once the last one begins so: the daemon commits them while we look."""
    end_s = time.monotonic() + FOREVER_S
    while True:
        with HistoryReader(store) as reader:
            said = [event.text for event in reader.events(*EVER) if event.kind == "model"]
        if (said and said[-1].startswith(last)) or time.monotonic() > end_s:
            return said
        time.sleep(0.05)


def test_a_model_released_meanwhile_is_taken_up_at_work(wires: Wires) -> None:
    folder = wires.directory
    second = folder / "second.json"
    second.write_text(other_model().to_json(), "utf-8")

    of_models("release", str(second), folder=folder)
    wires.running.daemon.send_signal(signal.SIGHUP)
    after = wires.wait(
        "the new model", lambda s: s["estimate"] is not None and s["estimate"]["model"] == "half-as-much-again"
    )
    assert after["model"]["release"] == 2
    wires.wait_for_state("ACTIVE")

    active = folder / "models/releases/0002/model.json"
    active.write_text("{}", encoding="utf-8")
    wires.running.daemon.send_signal(signal.SIGHUP)
    broken = wires.wait("the refusal", lambda status: status["model"]["problem"] != "")
    assert "not the file that" in broken["model"]["problem"]
    assert broken["model"]["model_id"] == "half-as-much-again", "the one in use stays"
    listed = of_models("list", folder=folder)
    assert listed["active"] == 2 and [record["number"] for record in listed["releases"]] == [1, 2]
    said = said_of_models(wires.configuration.history.path, "refused: ")
    back = of_models("rollback", "--to", "1", folder=folder)
    assert back["action"] == "rollback" and back["number"] == 3
    wires.running.daemon.send_signal(signal.SIGHUP)
    wires.wait("the model of before", lambda status: status["model"]["release"] == 3)
    assert thread_heaps(wires.running.daemon.pid) == 0, "what one thread has freed serves the others"
    wires.check_nothing_broke()
    check_audit(wires.writes(), wires.configuration, unverified=3, begun_s=wires.begun_s())
    # A simulation whose processes were not ready in time starts its daemon once more.
    first_said, second_said, third_said = said[-3:]
    assert first_said.startswith("ridge-") and "release 1 by " in first_said
    assert second_said.startswith("half-as-much-again, sha256 ") and "release 2 by " in second_said
    assert third_said.startswith("refused: ") and "the model in use stays" in third_said


def second_daemon(config: str) -> subprocess.CompletedProcess[str]:
    """Start one as a process of its own; it is to end by itself."""
    command = [sys.executable, "-P", "-m", "daemon.cli", "run", "--config", config]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_a_whole_shift_of_commands(wires: Wires) -> None:
    folder = wires.directory
    told("disable", "--zero", folder=folder)
    wires.wait_for_state("OFF")
    status = json.loads(told("status", "--json", "-", folder=folder))
    assert status["output"]["state"] == "OFF"
    sent, blocks = status["writes"]["sent"], blocks_of(folder)

    refused = toolpoint("enable", "x", folder=folder)
    assert refused.exit_code == 1 and "no model" in refused.stderr
    refused = toolpoint("enable", "w", folder=folder)
    assert refused.exit_code == 1 and "no axis w" in refused.stderr

    told("enable", "z", folder=folder)
    status = wires.wait_for_state("ACTIVE")
    assert status["axes"]["z"]["wanted"] and not status["axes"]["y"]["wanted"]
    assert "ACTIVE" in told("status", folder=folder)

    first = status["reference"]["id"]
    told("reference", folder=folder)
    status = wires.wait("the reference", lambda status: status["reference"] and status["reference"]["id"] != first)
    assert "hand" in status["reference"]["source"] and "uid" in status["reference"]["source"]

    told("disable", "--zero", folder=folder)
    wires.wait_for_state("OFF")
    assert told("acknowledge", folder=folder).startswith("OFF: "), "there is no FAULT, so nothing is asked"
    wires.check_nothing_broke()

    second = second_daemon(configured(folder))
    assert second.returncode == 1 and "writes this store" in second.stderr
    other = folder / "other.yaml"
    text = Path(configured(folder)).read_text(encoding="utf-8").replace("history.sqlite", "other.sqlite")
    other.write_text(text, encoding="utf-8")
    second = second_daemon(str(other))
    assert second.returncode == 1 and "writes to this CNC already" in second.stderr
    assert str(wires.running.daemon.pid) in second.stderr and "Traceback" not in second.stderr
    assert wires.status()["output"]["state"] == "OFF", "and the first one still answers"

    assert told("history", folder=folder).strip()
    assert blocks_of(folder) - blocks == wires.status()["writes"]["sent"] - sent > 0


def blocks_of(folder: Path) -> int:
    """Return how many blocks were written, by the audit, while the daemon runs."""
    header, *audit = rows_of(folder, folder / "writes.csv")
    return sum(row[header.index("cause")] != "handshake" for row in audit)


def rows_of(folder: Path, path: Path) -> list[list[str]]:
    """Export the audit of writes while the daemon runs."""
    between = ("--from", "2020-01-01", "--to", "2100-01-01")
    told("export", "--what", "writes", *between, "--output", str(path), folder=folder)
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


def test_at_its_end_it_leaves_no_socket_and_no_write_unsettled(wires: Wires) -> None:
    told("enable", "z", folder=wires.directory)
    assert toolpoint("enable", "w", folder=wires.directory).exit_code == 1
    daemon = wires.running.daemon
    daemon.send_signal(signal.SIGTERM)
    assert daemon.wait(30) == 0
    assert not wires.configuration.service.socket.exists()
    assert "Traceback" not in (wires.directory / "daemon.log").read_text(encoding="utf-8")
    with HistoryReader(wires.configuration.history.path) as reader:
        assert reader.unsettled_writes() == []
        events = reader.events(0.0, 1e11)
    assert events[-1].text == "stopped"
    assert [event for event in events if event.kind == "request" and "enable z" in event.text]
    assert [event for event in events if event.kind == "refused"]
    late = toolpoint("status", folder=wires.directory)
    assert late.exit_code == 1 and "is it running" in late.stderr
