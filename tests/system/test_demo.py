"""The demonstration as a newcomer meets it: what stands there when it is over, whoever ended it, through a pipe too."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.simulation.processes import free_port

pytestmark = [pytest.mark.wires, pytest.mark.slow]
PATIENCE_S = 120.0


def toolpoint(*words: object) -> "subprocess.Popen[str]":
    """Start a command whose output is a pipe, as leader of the processes that a terminal's Ctrl-C would reach."""
    command = [sys.executable, "-P", "-m", "daemon.cli", *map(str, words)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def wait_until_on(folder: Path) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        try:
            client = ControlClient(folder / "control.sock")
            on = client.ask("status")["axes"]["z"]["wanted"]
            client.close()
        except DaemonUnreachableError:
            on = False
        if on:
            return
        time.sleep(0.2)
    raise TimeoutError("the demonstration was not switched on")


def test_ctrl_c_before_the_time_is_over_leaves_the_result_and_no_logs(tmp_path: Path) -> None:
    with toolpoint("demo", "--minutes", 600, "--speed", 20, "--web-port", free_port(), "--directory", tmp_path) as demo:
        wait_until_on(tmp_path)
        time.sleep(2.0)
        os.killpg(demo.pid, signal.SIGINT)
        said = demo.communicate(timeout=PATIENCE_S)[1]
    assert demo.returncode == 0, said
    assert "of the machine's time; the output is A" in said and "writes read back and equal" in said
    assert "ended with status" not in said and "logs are in" not in said


def test_without_a_view_and_with_sensors_on_another_wire_the_result_is_told_too(tmp_path: Path) -> None:
    words = ("demo", "--sensors", "modbus", "--headless", "--minutes", 1, "--speed", 5, "--directory", tmp_path)
    with toolpoint(*words) as demo:
        said = demo.communicate(timeout=PATIENCE_S)[1]
    assert "seen until 1 min of the machine's time; the output is A" in said and "writes read back and equal" in said
    assert "the pages were at" not in said
