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
from terminal import Terminal
from wires import client_of

from config.records.commissioning import load_commissioning
from daemon.cli.simulate.demo import demo_machine
from daemon.simulation.processes import write_simulation_configuration

TOOLPOINT = [sys.executable, "-P", "-m", "daemon.cli"]
PATIENCE_S = 600.0
READING_TEXTS = {"x": ("0", "5", "0.1"), "y": ("0.3", "5.2", "0.3"), "z": ("-0.1", "4.8", "0")}
READINGS = [word for axis, um in READING_TEXTS.items() for word in ("--reading", f"{axis}={','.join(um)}")]
AXES = ["--axis", "x", "--axis", "y", "--axis", "z"]


class Standing:
    """A simulated machine that stands at a safe point, in a process of its own."""

    def __init__(self, directory: Path) -> None:
        speed = bearable(15.0)
        self.directory = directory
        self.record = directory / "record.json"
        self.config, self.configuration = write_simulation_configuration(
            self._machine(), directory, speed=speed, secure=True
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

    def commission(self, terminal: Terminal, *arguments: str) -> "subprocess.Popen[bytes]":
        command = [*TOOLPOINT, "commission", "--config", self.config, "--simulated-clock", self.clock]
        return terminal.run([*command, *arguments])


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Standing]:
    machine = Standing(tmp_path_factory.mktemp("standing"))
    process = machine.start()
    try:
        yield machine
    finally:
        process.terminate()
        process.communicate()


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    with Terminal() as terminal:
        yield terminal


@pytest.mark.wires
def test_a_person_confirms_readings_and_the_record_is_accepted(standing: Standing, terminal: Terminal) -> None:
    report = standing.directory / "report.html"
    process = standing.commission(
        terminal, "--person", "A. Fitter", "--instrument", "i", *AXES, *READINGS, "--report", str(report)
    )
    terminal.answer("Is this the control", "y", PATIENCE_S)
    for axis, readings in READING_TEXTS.items():
        others = [other for other in READING_TEXTS if other != axis]
        terminal.answer(f"Is the instrument along {axis} in place", "y", PATIENCE_S)
        for moment, reading in enumerate(readings):
            terminal.answer(f"Does the instrument along {axis} read {reading} um", "y", PATIENCE_S)
            for other in others if moment == 0 else ():
                terminal.answer(f"Reading along {other}, which must not move", "", PATIENCE_S)
    terminal.until("Report to sign", PATIENCE_S)
    assert process.wait(PATIENCE_S) == 0, terminal.shown
    record = load_commissioning(standing.record)
    assert (record.person, sorted(record.axes)) == ("A. Fitter", ["x", "y", "z"])
    assert record.axes["z"].measured_um == pytest.approx(4.85)
    assert "A. Fitter" in report.read_text(encoding="utf-8")
    check = subprocess.run(
        [*TOOLPOINT, "commission", "--config", standing.config, "--check"], capture_output=True, text=True, check=False
    )
    assert check.returncode == 0 and "It fits the configuration" in check.stdout, check.stderr


@pytest.mark.wires
def test_what_is_typed_before_anything_moves_is_no_reading_and_control_c_leaves(
    standing: Standing, terminal: Terminal
) -> None:
    process = standing.commission(terminal, "--axis", "z", "--record", str(standing.directory / "other.json"))
    terminal.answer("Your name", "B. Operator", PATIENCE_S)
    terminal.answer("Instrument", "indicator 3", PATIENCE_S)
    terminal.answer("Is this the control", "y", PATIENCE_S)
    terminal.type_ahead("y\n0.2\n\n\n2.3\n\n\n0.25\n\n\n")
    terminal.until("typed before this question does not count", PATIENCE_S)
    terminal.answer("in place", "y", PATIENCE_S)
    terminal.answer("Reading along z, at zero, before the offset", "0.0", PATIENCE_S)
    for axis in "xy":
        terminal.answer(f"Reading along {axis}, which must not move", "", PATIENCE_S)
    terminal.type_ahead("2.3\n0.25\n")
    terminal.until("typed before this question does not count", PATIENCE_S)
    terminal.until("with the offset applied", PATIENCE_S)
    process.send_signal(signal.SIGINT)
    terminal.until("Not commissioned: interrupted", PATIENCE_S)
    assert process.wait(PATIENCE_S) == 130, terminal.shown
    assert "Everything is back at zero" in terminal.shown
    assert not (standing.directory / "other.json").exists()


@pytest.mark.wires
def test_the_daemon_takes_the_record_and_the_block_and_keeps_the_command_away(
    standing: Standing, terminal: Terminal
) -> None:
    daemon = subprocess.Popen(
        [*TOOLPOINT, "run", "--config", standing.config, "--simulated-clock", standing.clock],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        end_s = time.monotonic() + PATIENCE_S
        client = client_of(daemon, standing.configuration.service.socket, PATIENCE_S)
        while client.ask("status")["output"]["since_s"] is None:
            assert time.monotonic() < end_s
            time.sleep(0.05)
        client.ask("enable", axes=["z"])
        state = client.ask("status")["output"]
        assert state["state"] != "FAULT", state
        client.close()
        record = str(standing.directory / "no.json")
        process = standing.commission(terminal, "--yes", "--person", "A. Fitter", "--record", record)
        terminal.until("the daemon is running", PATIENCE_S)
        assert process.wait(PATIENCE_S) == 1
    finally:
        daemon.terminate()
        daemon.wait()
