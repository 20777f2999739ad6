"""The commands, on a running daemon and without one."""

import csv
import json
import signal
import subprocess
import sys

import pytest
from click.testing import CliRunner
from wires import on_wires

from config.sample import sample_configuration
from daemon.cli import main
from daemon.history import HistoryReader

pytestmark = pytest.mark.wires


def toolpoint(*arguments, config):
    return CliRunner().invoke(main, [*arguments, "--config", str(config)])


def told(*arguments, config):
    finished = toolpoint(*arguments, config=config)
    assert finished.exit_code == 0, finished.stderr
    return finished.stdout


def second_daemon(config):
    """Start one as a process of its own; it is to end by itself."""
    command = [sys.executable, "-P", "-m", "daemon.cli", "run", "--config", str(config)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_a_whole_shift_of_commands(tmp_path):
    with on_wires(tmp_path, speed=60.0) as wires:
        config = tmp_path / "toolpoint.yaml"
        wires.wait("the CNC", lambda status: status["output"]["since_s"] is not None)
        assert json.loads(told("status", "--json", "-", config=config))["output"]["state"] == "OFF"

        refused = toolpoint("enable", "x", config=config)
        assert refused.exit_code == 1 and "no model" in refused.stderr
        refused = toolpoint("enable", "w", config=config)
        assert refused.exit_code == 1 and "no axis w" in refused.stderr

        told("enable", "z", config=config)
        status = wires.wait_for_state("ACTIVE")
        assert status["axes"]["z"]["wanted"] and not status["axes"]["y"]["wanted"]
        assert "ACTIVE" in told("status", config=config)

        first = status["reference"]["id"]
        told("reference", config=config)
        status = wires.wait("the reference", lambda status: status["reference"] and status["reference"]["id"] != first)
        assert "hand" in status["reference"]["source"] and "uid" in status["reference"]["source"]

        told("disable", "--zero", config=config)
        wires.wait_for_state("OFF")
        assert told("acknowledge", config=config).startswith("OFF: "), "there is no FAULT, so nothing is asked"
        wires.check_nothing_broke()

        second = second_daemon(config)
        assert second.returncode == 1 and "writes this store" in second.stderr
        other = tmp_path / "other.yaml"
        text = config.read_text(encoding="utf-8").replace("history.sqlite", "other.sqlite")
        other.write_text(text, encoding="utf-8")
        second = second_daemon(other)
        assert second.returncode == 1 and "writes to this CNC already" in second.stderr
        assert wires.status()["output"]["state"] == "OFF", "and the first one still answers"

        assert told("history", config=config).strip()
        header, *audit = rows_of(config, tmp_path / "writes.csv")
        blocks = [row for row in audit if row[header.index("cause")] != "handshake"]
        assert len(blocks) == wires.status()["writes"]["sent"]

        daemon = wires.running.daemon
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(30) == 0
        assert not wires.configuration.service.socket.exists()
        assert "Traceback" not in (tmp_path / "daemon.log").read_text(encoding="utf-8")
        with HistoryReader(wires.configuration.history.path) as reader:
            assert reader.unsettled_writes() == []
            events = reader.events(0.0, 1e11)
        assert events[-1].text == "stopped"
        assert [event for event in events if event.kind == "request" and "enable z" in event.text]
        assert [event for event in events if event.kind == "refused"]

        late = toolpoint("status", config=config)
        assert late.exit_code == 1 and "is it running" in late.stderr


def rows_of(config, path):
    """Export the audit of writes while the daemon runs."""
    told(
        *("export", "--what", "writes", "--from", "2020-01-01", "--to", "2100-01-01", "--output", str(path)),
        config=config,
    )
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


@pytest.mark.parametrize("command", ["status", "enable", "disable", "reference", "acknowledge"])
def test_without_a_daemon_every_command_says_so(tmp_path, command):
    finished = CliRunner().invoke(main, [command, "--socket", str(tmp_path / "nobody")])
    assert finished.exit_code == 1 and "is it running" in finished.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("demo", "--headles"),
        ("demo", "--headless", "--minutes", "-3"),
        ("nonsense",),
        ("run", "--simulated-clock", "now"),
        ("disable", "--zero", "z", "--socket", "/nonexistent"),
    ],
)
def test_bad_usage_ends_with_2(arguments):
    finished = CliRunner().invoke(main, arguments)
    assert finished.exit_code == 2 and isinstance(finished.exception, SystemExit)
    assert finished.stderr and finished.stdout == ""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("cycle_period_s: ", "cycle_periode_s: "), ("cycle_periode_s", "unknown")),
        (("absolute_bound_um: ", "absolute_bound_um: much #"), ("absolute_bound_um",)),
        (("machine:", "machine: [\nx:"), ()),
    ],
)
def test_a_broken_configuration_names_file_line_column_and_key(tmp_path, change, words):
    text = sample_configuration()
    assert change[0] in text
    path = tmp_path / "broken.yaml"
    path.write_text(text.replace(*change, 1), encoding="utf-8")
    line = text[: text.index(change[0])].count("\n") + 1
    for command in ("run", "check"):
        finished = CliRunner().invoke(main, [command, "--config", str(path)])
        assert finished.exit_code == 2 and isinstance(finished.exception, SystemExit)
        assert str(path) in finished.stderr
        if words:
            assert f"{path}:{line}:" in finished.stderr
        for word in words:
            assert word in finished.stderr.lower(), finished.stderr
