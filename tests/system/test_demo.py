"""The demonstration as a newcomer meets it: what stands there when it is over, whoever ended it, through a pipe too."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from config.machines import shipped_file
from daemon.history.reader import HistoryReader
from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.simulation.processes import free_port

pytestmark = [pytest.mark.wires, pytest.mark.slow]
PATIENCE_S = 120.0


def toolpoint(*words: object) -> "subprocess.Popen[str]":
    """Start a command whose output is a pipe, as leader of the processes that a terminal's Ctrl-C would reach."""
    command = [sys.executable, "-P", "-m", "daemon.cli", *map(str, words)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def wait_until(folder: Path, reached: Callable[[dict[str, Any]], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        try:
            client = ControlClient(folder / "control.sock")
            status = client.ask("status")
            client.close()
        except DaemonUnreachableError:
            status = None
        if status is not None and reached(status):
            return
        time.sleep(0.05)
    raise TimeoutError(f"the demonstration did not come so far: {status}")


def is_on(status: dict[str, Any]) -> bool:
    return bool(status["axes"]["z"]["wanted"])


def simulator_of(demo: int) -> int:
    """Return the process of the simulated machine, a child of the demonstration."""
    return child_of(demo, b"simulate")


def child_of(demo: int, command: bytes) -> int:
    children = Path(f"/proc/{demo}/task/{demo}/children").read_text(encoding="ascii").split()
    (found,) = (int(pid) for pid in children if command in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"))
    return found


def test_a_machine_that_stood_still_is_switched_on_again_and_ctrl_c_leaves_the_result_and_no_logs(
    tmp_path: Path,
) -> None:
    """A busy computer that stood still for twelve seconds left the demonstration off for good."""
    words = ("demo", "--minutes", 6000, "--speed", 60, "--web-port", free_port(), "--no-spindle-speed")
    with toolpoint(*words, "--directory", tmp_path) as demo:
        wait_until(tmp_path, lambda status: status["output"]["state"] == "ACTIVE")
        simulator = simulator_of(demo.pid)
        os.kill(simulator, signal.SIGSTOP)
        wait_until(tmp_path, lambda status: not is_on(status) or "switch it on again" in str(status["output"]))
        os.kill(simulator, signal.SIGCONT)
        wait_until(tmp_path, is_on)
        os.killpg(demo.pid, signal.SIGINT)
        said = demo.communicate(timeout=PATIENCE_S)[1]
    assert demo.returncode == 0, said
    assert "of the machine's time; the output is " in said and "writes read back and equal" in said
    assert "ended with status" not in said and "logs are in" not in said
    with HistoryReader(tmp_path / "history.sqlite") as reader:
        asked = [event.text for event in reader.events(0.0, 2.0**40) if event.kind == "request"]
    assert asked == ["enable y, z", "enable y, z"]


def test_a_daemon_that_stood_still_for_twelve_seconds_does_not_end_it(tmp_path: Path) -> None:
    words = ("demo", "--minutes", 6000, "--speed", 1, "--web-port", free_port(), "--directory", tmp_path)
    with toolpoint(*words) as demo:
        wait_until(tmp_path, lambda status: status["output"]["since_s"] is not None)
        daemon = child_of(demo.pid, b"run")
        os.kill(daemon, signal.SIGSTOP)
        time.sleep(12.0)
        os.kill(daemon, signal.SIGCONT)
        time.sleep(2.0)
        assert demo.poll() is None, demo.communicate()[1]
        os.killpg(demo.pid, signal.SIGINT)
        said = demo.communicate(timeout=PATIENCE_S)[1]
    assert demo.returncode == 0, said


def test_without_a_view_and_with_sensors_on_another_wire_the_result_is_told_too(tmp_path: Path) -> None:
    words = ("demo", "--sensors", "modbus", "--headless", "--minutes", 1, "--speed", 5, "--directory", tmp_path)
    with toolpoint(*words) as demo:
        said = demo.communicate(timeout=PATIENCE_S)[1]
    assert "seen until 1 min of the machine's time; the output is A" in said and "writes read back and equal" in said
    assert "the pages were at" not in said
    # a commissioning tried here with a wrong reading took away the record that ships: no demo started any more
    record = Path(
        yaml.safe_load((tmp_path / "toolpoint.yaml").read_text("utf-8"))["compensation"]["commissioning_file"]
    )
    assert record.parent == tmp_path
    assert record.read_bytes() == shipped_file("simulated_machine_commissioning.json").read_bytes()


def test_the_spindle_speed_follows_the_pockets_over_real_wires(tmp_path: Path) -> None:
    """Sensors, bearings, lobes, verification, macros, the shipped NC program and the simulated spindle, as shipped."""
    words = ("demo", "--headless", "--spindle-speed", "--minutes", 15, "--speed", 15, "--directory", tmp_path / "run")
    with toolpoint(*words, "--json", tmp_path / "result.json") as demo:
        said = demo.communicate(timeout=3 * PATIENCE_S)[1]
    tuned = json.loads((tmp_path / "result.json").read_text("utf-8"))["spindle_speed"]
    assert tuned["programmed_rpm"] == 12000.0, said
    assert 10200.0 <= tuned["applied_rpm"] < 11500.0
    assert tuned["limiting_depth_mm"] > 2.0
    with HistoryReader(tmp_path / "run" / "history.sqlite") as reader:
        events = [event.text for event in reader.events(0.0, 2.0**40) if event.kind == "speed"]
        speeds_rpm = reader.cnc(0.0, 2.0**40).spindle_speed_rpm.tolist()
    assert any(text.startswith("jumps from 12000 to ") for text in events)
    assert tuned["applied_rpm"] in speeds_rpm
