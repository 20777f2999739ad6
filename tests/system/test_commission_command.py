"""`toolpoint commission` as a person runs it: two processes, encrypted OPC UA, a record, a report, a daemon."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pace import bearable

from config.records.commissioning import load_commissioning
from daemon.cli.simulate.demo import demo_machine
from daemon.monitor.control_socket import ControlClient
from daemon.simulation.processes import write_simulation_configuration

TOOLPOINT = [sys.executable, "-P", "-m", "daemon.cli"]
PATIENCE_S = 600.0
READINGS = ["--reading", "x=0,5,0.1", "--reading", "y=0.3,5.2,0.3", "--reading", "z=-0.1,4.8,0"]

AXES = ["--axis", "x", "--axis", "y", "--axis", "z"]


class Standing:
    """A simulated machine that stands at a safe point, in a process of its own."""

    def __init__(self, directory: Path) -> None:
        speed = bearable(15.0)
        self.directory = directory
        self.record = directory / "record.json"
        self.config, self.configuration = write_simulation_configuration(
            self._machine(), directory, speed=speed, http=False, secure=True
        )
        self.clock = f"{time.monotonic()!r}:{time.time()!r}:{speed!r}"

    def _machine(self) -> dict[str, Any]:
        content = demo_machine()
        content["compensation"]["commissioning_file"] = str(self.record)
        for axis in content["compensation"]["axes"].values():
            axis["slew_um_per_min"] = 100.0
        return content

    def start(self) -> "subprocess.Popen[str]":
        arguments = ["--config", self.config, "--directory", self.directory, "--simulated-clock", self.clock]
        process = subprocess.Popen(
            [
                *TOOLPOINT,
                "simulate",
                *arguments,
                "--standing",
                "--report-s",
                "1000000",
                "--server-key",
                self.directory / "cnc.pem",
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["ready"]
        return process

    def commission(self, *arguments: str) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [*TOOLPOINT, "commission", "--config", self.config, "--simulated-clock", self.clock, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Standing]:
    machine = Standing(tmp_path_factory.mktemp("standing"))
    process = machine.start()
    try:
        yield machine
    finally:
        process.terminate()
        process.communicate()


@pytest.mark.wires
def test_a_person_confirms_readings_and_the_record_is_accepted(standing: Standing) -> None:
    report = standing.directory / "report.html"
    process = standing.commission(
        "--person", "A. Fitter", "--instrument", "i", *AXES, *READINGS, "--report", str(report)
    )
    # the control; per axis: in place, seen before, no instrument along the two others, seen with the offset, seen after
    said, _ = process.communicate(input="y\n" + 3 * "y\ny\n\n\ny\ny\n", timeout=PATIENCE_S)
    assert process.returncode == 0, said
    record = load_commissioning(standing.record)
    assert (record.person, sorted(record.axes)) == ("A. Fitter", ["x", "y", "z"])
    assert record.axes["z"].measured_um == pytest.approx(4.85)
    assert "A. Fitter" in report.read_text(encoding="utf-8")
    check = subprocess.run(
        [*TOOLPOINT, "commission", "--config", standing.config, "--check"], capture_output=True, text=True, check=False
    )
    assert check.returncode == 0 and "It fits the configuration" in check.stdout, check.stderr


@pytest.mark.wires
def test_a_person_answers_at_the_keyboard_and_leaves_with_control_c(standing: Standing) -> None:
    process = standing.commission("--axis", "z", "--record", str(standing.directory / "other.json"))
    assert process.stdin is not None and process.stdout is not None
    # name, instrument, the control, in place, reading before; then nothing: the offset is applied
    process.stdin.write("B. Operator\nindicator 3\ny\ny\n0.0\n\n\n")
    process.stdin.flush()
    said = ""
    while "with the offset applied" not in said:
        piece = process.stdout.read(1)
        assert piece, said
        said += piece
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, said + rest
    assert "Everything is back at zero" in rest and "Not commissioned: interrupted" in rest
    assert not (standing.directory / "other.json").exists()


@pytest.mark.wires
def test_the_daemon_takes_the_record_and_the_block_and_keeps_the_command_away(standing: Standing) -> None:
    daemon = subprocess.Popen(
        [*TOOLPOINT, "run", "--config", standing.config, "--simulated-clock", standing.clock],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        end_s = time.monotonic() + PATIENCE_S
        while not standing.configuration.service.socket.is_socket():
            assert daemon.poll() is None and time.monotonic() < end_s
            time.sleep(0.05)
        client = ControlClient(standing.configuration.service.socket)
        while client.ask("status")["output"]["since_s"] is None:
            assert time.monotonic() < end_s
            time.sleep(0.05)
        client.ask("enable", axes=["z"])
        state = client.ask("status")["output"]
        assert state["state"] != "FAULT", state
        client.close()
        process = standing.commission("--yes", "--person", "A. Fitter", "--record", str(standing.directory / "no.json"))
        said, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1 and "the daemon is running" in said
    finally:
        daemon.terminate()
        daemon.wait()
