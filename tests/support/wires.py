"""A simulated machine and a daemon as processes on real wires, and what must hold of them afterwards."""

import contextlib
import itertools
import json
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
from pace import bearable

from config.schema import Configuration
from daemon.cli.simulate.demo import demo_machine
from daemon.history.reader import HistoryReader
from daemon.history.series import WriteRecord
from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.simulation.demonstration import switch_on
from daemon.simulation.processes import RunningSimulation, start_simulation, write_simulation_configuration
from models.records import WriteOutcome

EVER = (0.0, 1e11)
FOREVER_S = 300.0
ASK_AGAIN_S = 0.1
"""The status of hundreds of sensors takes the daemon and the test some milliseconds each time."""
NOISE_UM = 1e-6
FIRST_REFERENCE_S = 150.0
"""Simulated time of the first work positioning [s]."""


def client_of(daemon: subprocess.Popen[Any], socket: Path, patience_s: float, log: Path | None = None) -> ControlClient:
    """Return a connection to a daemon that is starting: its socket is there before somebody answers on it."""
    end_s = time.monotonic() + patience_s
    while True:
        try:
            client = ControlClient(socket)
            client.ask("status")
            return client
        except DaemonUnreachableError:
            said = log.read_text("utf-8", "replace")[-600:] if log is not None else ""
            assert daemon.poll() is None, f"the daemon ended: {said}"
            assert time.monotonic() < end_s, f"the daemon does not answer: {said}"
            time.sleep(0.02)


class Wires:
    """One simulation whose daemon a test may end and start again."""

    def __init__(self, running: RunningSimulation, directory: Path) -> None:
        self.running = running
        self.directory = directory
        self.configuration: Configuration = running.configuration

    @property
    def log(self) -> list[dict[str, Any]]:
        """The daemon's log so far."""
        lines = (self.directory / "daemon.log").read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines if line.startswith("{")]

    def status(self) -> dict[str, Any]:
        self.running.check_alive()
        return self.running.client.ask("status")

    def wait(
        self, what: str, condition: Callable[[dict[str, Any]], bool], timeout_s: float = FOREVER_S
    ) -> dict[str, Any]:
        """Return the first status that meets the condition."""
        end_s = time.monotonic() + timeout_s
        status = self.status()
        while not condition(status):
            assert time.monotonic() < end_s, f"waited in vain for {what}: {status['output']}, {status['links']}"
            time.sleep(ASK_AGAIN_S)
            status = self.status()
        return status

    def wait_for_state(self, state: str) -> dict[str, Any]:
        return self.wait(state, lambda status: status["output"]["state"] == state)

    def wait_until(self, time_s: float) -> None:
        """Return when the simulated time is reached."""
        self.running.check_alive()
        self.let_pass(time_s - self.running.time_s)

    def let_pass(self, seconds: float) -> None:
        """Return after so much simulated time."""
        time.sleep(max(0.0, seconds / self.running.speed))

    def switch_on(self) -> dict[str, Any]:
        """Enable every axis with a model; return the status when the output is ACTIVE.

        The program's request follows at once on the poll that sees the positioning, and its reference is the one that
        stays in force.
        """
        switch_on(self.running, FOREVER_S)
        return self.wait("the reference that the program asks for", _by_request)

    def start_daemon(self, preexec_fn: Callable[[], None] | None = None) -> None:
        """Start the daemon anew, as it was started first, and connect."""
        arguments = self.running.daemon.args
        with (self.directory / "daemon.log").open("ab") as log:
            self.running.daemon = subprocess.Popen(  # type: ignore[call-overload]
                arguments,
                stdout=log,
                stderr=log,
                preexec_fn=preexec_fn,  # noqa: PLW1509 - it only sets signals
            )
        self.connect()

    def connect(self) -> None:
        """Connect to the daemon's socket anew; it may be busy, or starting."""
        with contextlib.suppress(AttributeError):
            self.running.client.close()
        log = self.directory / "daemon.log"
        self.running.client = client_of(self.running.daemon, self.configuration.service.socket, FOREVER_S, log)

    def kill_daemon(self) -> None:
        self.running.daemon.kill()
        self.running.daemon.wait()
        self.running.client.close()

    def check_nothing_broke(self) -> None:
        """Neither process has ended, and no task met what nobody expected."""
        self.running.check_alive()
        defects = [entry for entry in self.log if entry["event"].endswith(".defect")]
        assert not defects, defects[0]
        text = (self.directory / "daemon.log").read_text(encoding="utf-8")
        assert "Traceback" not in text, text[text.index("Traceback") - 500 :][:3000]

    def begun_s(self) -> list[float]:
        """Return when a daemon started or a reference came into force [s]."""
        with HistoryReader(self.configuration.history.path) as reader:
            return [event.time_s for event in reader.events(*EVER) if event.kind in ("daemon", "reference")]

    def writes(self) -> list[WriteRecord]:
        """Return the blocks in the audit, without answers to the NC program.

        The latest one may be on its way, and is left out then.
        """
        with HistoryReader(self.configuration.history.path) as reader:
            records = [record for record in reader.writes(*EVER) if record.compensation_um]
        return records[:-1] if records and records[-1].outcome is WriteOutcome.INTENDED else records


@contextlib.contextmanager
def on_wires(
    directory: Path,
    *,
    speed: float,
    faults: Sequence[dict[str, Any]] = (),
    change: Callable[[dict[str, Any]], None] = lambda content: None,
    arguments: Sequence[str] = (),
) -> Iterator[Wires]:
    """Start simulated machine and daemon; `change` may change the configuration, `faults` is a script.

    On a computer that is busy with other things the simulation is as much slower as it must be.
    """
    speed = bearable(speed)
    content = demo_machine()
    path, _ = write_simulation_configuration(content, directory, speed=speed)
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["service"]["retry_min_s"], content["service"]["retry_max_s"] = 0.05, 0.5
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    more = list(arguments)
    if faults:
        script = directory / "faults.yaml"
        script.write_text(yaml.safe_dump(list(faults)), encoding="utf-8")
        more += ["--faults", str(script)]
    with start_simulation(more, path, speed=speed, epoch_utc_s=time.time(), directory=directory) as running:
        yield Wires(running, directory)


def _by_request(status: dict[str, Any]) -> bool:
    reference = status["reference"]
    return status["output"]["state"] == "ACTIVE" and reference and reference["source"].startswith("request")


def _is_there(value_um: float, before: WriteRecord, after: WriteRecord, axis: str) -> bool:
    """Whether the tool stood there at some moment between the read-backs of two blocks.

    A daemon that starts begins from the CNC's echo, and so does a new reference: from where the guard has taken the
    block before meanwhile. The guard goes from one to the other without turning.
    """
    ends = [um for um in (before.applied_um.get(axis), after.applied_um.get(axis)) if um is not None]
    return bool(ends) and min(ends) - NOISE_UM <= value_um <= max(ends) + NOISE_UM


def check_audit(
    writes: Sequence[WriteRecord], configuration: Configuration, *, unverified: int = 0, begun_s: Sequence[float] = ()
) -> None:
    """Check bound, slew rate and standstill in HOLD of everything that was written.

    `begun_s`: when a daemon started or a reference came into force, and the command began again from the CNC's echo.
    """
    axes = configuration.compensation.axes
    assert writes
    failed = [record for record in writes if record.outcome is not WriteOutcome.VERIFIED]
    assert len(failed) <= unverified, failed[:3]
    for before, after in itertools.pairwise(writes):
        elapsed_min = max(after.time_s - before.time_s, 0.0) / 60.0
        for axis, limits in axes.items():
            value, last = after.compensation_um[axis], before.compensation_um[axis]
            assert value is not None and last is not None
            assert abs(value) <= limits.absolute_bound_um + 1e-9, after
            begins = any(before.time_s <= time_s <= after.time_s for time_s in begun_s)
            if before.applied_um.get(axis) in (None, value) or (begins and _is_there(value, before, after, axis)):
                continue  # the command began again at what the tool point already has
            # The step's time is taken before the intent's: a little more than the slew rate may show.
            slack_um = 0.1 * limits.slew_um_per_min
            assert abs(value - last) <= limits.slew_um_per_min * elapsed_min + slack_um, (axis, before, after)
            if after.state == before.state == "HOLD":
                assert value == last, (axis, before, after)
