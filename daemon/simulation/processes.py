"""A simulated machine and a daemon as two processes on real wires, started by a third.

`toolpoint demo` and `toolpoint replay` both stand on this: they differ in the machine.
"""

import contextlib
import json
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from config.loader import load_configuration
from config.schema import Configuration
from config.schema.base import drivers_of
from config.schema.cnc import CncConfig
from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.simulation import SimulationError
from drivers.contract import SIMULATED_CNC_IDENTITY
from drivers.opcua.new_certificate import create_application_certificate

LEAD_PER_LOADING = 2.5
"""The simulated time starts when the daemon is ready, after so many times what the simulated machine took to load:
a busy computer needs longer for both. Doubled when they were not ready."""
LEAST_LEAD_S = 2.5
MOST_LEADS = 4
LOADED_WITHIN_S = 60.0
REQUEST_REAL_S = 2.0
"""A request of the NC program waits at least this long for its answer [s of the wall clock]."""
PLANNED_REAL_S = 5.0
"""The spindle speed may follow dynamics that are this old [s of the wall clock]."""
LOOK_AHEAD = 1.5
"""The guard accepts blocks this much longer than they are written for, polls included."""
POSITIONING_S = 15.0
"""The simulated part programs stand at work positioning for longer than this [s]."""
TOOL_MACRO = 149
"""Where the builder of the simulated machine keeps the tool in the spindle; #4120 would be the latest T word."""
SILENT_S = 60.0
"""The daemon may stand still so long, on a computer that sleeps or swaps [s of the wall clock]."""
STOP_PATIENCE_S = 15.0
PORTS_TRIED = 100
LAST_PORT = 65535


def free_port() -> int:
    """Return a free TCP port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def port_from(wanted: int) -> int:
    """Return the first free TCP port of the loopback interface from `wanted` on; raises SimulationError."""
    for port in range(wanted, min(wanted + PORTS_TRIED, LAST_PORT + 1)):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one that was served a moment ago is free
            probe.bind(("127.0.0.1", port))
            return port
    raise SimulationError(f"no port from {wanted} on is free; name another: --web-port")


def write_simulation_configuration(
    base: dict[str, Any],
    directory: Path,
    *,
    speed: float,
    http_port: int | None = None,
    secure: bool = False,
    driver: str = "opcua",
) -> tuple[Path, Configuration]:
    """Write a configuration for wires, sockets and store inside `directory`; return it loaded.

    The monitor is served at `http_port` of this computer alone, None: not at all.
    Waiting times that stand for the speed of the wires grow with the speed of the simulation,
    because a pause of this computer is then a long time for the machine.
    """
    for line in base["temperatures"].get("lines", []):
        line["port"] = str(directory / f"{line['name']}.tty")
    if base.get("displacements"):
        base["displacements"]["file"] = {"path": str(directory / "displacement.csv"), "header": "time"}
    for other in drivers_of(CncConfig):
        base["cnc"].pop(other, None)
    base["cnc"] |= _control(driver, directory, secure=secure)
    base["cnc"]["allow_insecure_writes"] = not secure
    base["cnc"]["stale_after_s"] = max(3.0, speed)
    base["cnc"].setdefault("guard", {})["dialect"] = "sinumerik" if driver == "sinumerik" else "fanuc"
    base["cnc"]["guard"]["request_timeout_s"] = max(10.0, REQUEST_REAL_S * speed)
    base["compensation"]["allow_writable_model_directory"] = True
    reference = base["compensation"].setdefault("reference", {})
    reference["positioning_dwell_s"] = max(POSITIONING_S, 2.0 * base["cnc"].get("poll_period_s", 0.5))
    output = base["compensation"].setdefault("output", {})
    slowest_poll_s = base["cnc"].get("poll_period_s", 0.5)
    output["validity_s"] = min(max(30.0, speed), 100.0)
    base["cnc"]["guard"]["max_validity_s"] = max(120.0, LOOK_AHEAD * (output["validity_s"] + slowest_poll_s))
    output["stale_after_s"] = min(max(60.0, speed), 300.0)
    output["alarm_after_s"] = 300.0
    if tuning := base.get("spindle_speed"):
        tuning |= {"validity_s": output["validity_s"], "stale_after_s": max(60.0, PLANNED_REAL_S * speed)}
    base["history"] = {"path": str(directory / "history.sqlite")}
    base["service"] = {"socket": str(directory / "control.sock"), "http_port": http_port, "log_level": "info"}
    path = directory / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(base, sort_keys=False, width=120), encoding="utf-8")
    return path, load_configuration(path)


def _control(driver: str, directory: Path, *, secure: bool) -> dict[str, Any]:
    """Return driver and section for the simulated control on a free port; raises SimulationError.

    `driver` may be sinumerik too: the OPC UA driver at a simulated SINUMERIK.
    """
    if driver in ("opcua", "sinumerik"):
        section = {
            "endpoint": f"opc.tcp://127.0.0.1:{free_port()}/toolpoint/",
            "security": _keys(directory) if secure else None,
        }
        kind = {"preset": "sinumerik"} if driver == "sinumerik" else {"namespace_uri": "urn:toolpoint:cnc"}
        return {"driver": "opcua", "opcua": section | kind}
    if secure:
        raise SimulationError(f"driver {driver} cannot encrypt: leave --secure out, or use --cnc opcua")
    if driver == "mtconnect":
        return {"driver": driver, driver: {"url": f"http://127.0.0.1:{free_port()}"}}
    tool = {"tool_macro": TOOL_MACRO} if driver == "focas" else {}
    return {"driver": driver, driver: {"host": "127.0.0.1", "port": free_port()} | tool}


def _keys(directory: Path) -> dict[str, str]:
    """Make certificates, keys and a password for both sides; return the daemon's security section."""
    for name, uri in (("daemon", "urn:toolpoint:daemon"), ("cnc", SIMULATED_CNC_IDENTITY)):
        create_application_certificate(
            directory / f"{name}.der",
            directory / f"{name}.pem",
            application_uri=uri,
            host_name="localhost",
            server=name == "cnc",
        )
    password = directory / "password"
    password.touch(mode=0o600)
    password.write_text(secrets.token_urlsafe(24) + "\n", encoding="ascii")
    return {
        "user_name": "toolpoint",
        "password_file": str(password),
        "certificate": str(directory / "daemon.der"),
        "private_key": str(directory / "daemon.pem"),
        "server_certificate": str(directory / "cnc.der"),
    }


@contextlib.contextmanager
def folder_for(directory: Path | None) -> Iterator[Path]:
    """Yield a new or empty folder that stays, or a temporary one that does not; raises SimulationError."""
    if directory is None:
        with tempfile.TemporaryDirectory(prefix="toolpoint-", ignore_cleanup_errors=True) as name:
            yield Path(name)
        return
    try:
        directory.mkdir(parents=True, exist_ok=True)
        empty = not any(directory.iterdir())
    except OSError as error:
        raise SimulationError(f"{directory} cannot be used: {error.strerror}; name an empty or a new folder") from error
    if not empty:
        raise SimulationError(f"{directory} is not empty; name an empty or a new folder")
    yield directory.resolve()


@dataclass(slots=True)
class RunningSimulation:
    """Two running processes and what they have said."""

    configuration: Configuration
    simulator: "subprocess.Popen[str]"
    daemon: "subprocess.Popen[bytes]"
    client: ControlClient
    epoch_real_s: float
    speed: float
    reports: list[dict[str, Any]] = field(default_factory=list)

    @property
    def time_s(self) -> float:
        """Simulated time [s]."""
        return (time.monotonic() - self.epoch_real_s) * self.speed

    def check_alive(self) -> None:
        """Raise SimulationError when one of the two has ended."""
        for name, process in (("the simulated machine", self.simulator), ("the daemon", self.daemon)):
            if process.poll() is not None:
                raise SimulationError(f"{name} ended with status {process.returncode}")

    def wait_for_report(self, wanted: str, timeout_s: float) -> dict[str, Any]:
        """Return the first report that carries the key `wanted`."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            for report in self.reports:
                if wanted in report:
                    return report
            self.check_alive()
            time.sleep(0.02)
        raise SimulationError(f"the simulated machine did not report {wanted!r} within {timeout_s:.0f} s")


@contextlib.contextmanager
def start_simulation(
    simulate_arguments: Sequence[str], config_path: Path, *, speed: float, epoch_utc_s: float, directory: Path
) -> Iterator[RunningSimulation]:
    """Start both processes so that the daemon is ready before the simulated time begins, and stop them."""
    with _ended_by_signals():
        for times in range(MOST_LEADS):
            lead = LEAD_PER_LOADING * 2**times
            running = _start(simulate_arguments, config_path, speed, lead, epoch_utc_s, directory)
            try:
                if running is not None:
                    yield running
                    return
            finally:
                if running is not None:
                    _stop(running)
    raise SimulationError(f"daemon and simulated machine were not ready in {MOST_LEADS} starts: end other programs")


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end this process as Ctrl-C does, so that no daemon stays behind a closed terminal."""

    def end(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _start(
    simulate_arguments: Sequence[str], config_path: Path, speed: float, lead: float, epoch_utc_s: float, directory: Path
) -> RunningSimulation | None:
    """Start both, the time `lead` times the loading of the simulated machine later; None when they were not ready."""
    toolpoint = [sys.executable, "-P", "-m", "daemon.cli"]
    config = ["--config", str(config_path)]
    configuration = load_configuration(config_path)
    keys = ["--server-key", str(directory / "cnc.pem")] if configuration.cnc.connection.encrypted else []
    began_s = time.monotonic()
    with (directory / "simulator.log").open("ab") as log:
        simulator = subprocess.Popen(
            [
                *(*toolpoint, "simulate", *config, "--simulated-clock", "-"),
                *("--directory", str(directory), *keys, *simulate_arguments),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
    reports: list[dict[str, Any]] = []
    threading.Thread(target=_collect, args=(simulator, reports), daemon=True).start()
    started: list[subprocess.Popen[Any]] = [simulator]
    try:
        _wait_for_reports(1, reports, simulator, began_s + LOADED_WITHIN_S)
        loaded_s = time.monotonic()
        epoch_real_s = loaded_s + max(LEAST_LEAD_S, lead * (loaded_s - began_s))
        clock = f"{epoch_real_s!r}:{epoch_utc_s!r}:{speed!r}"
        _tell(simulator, clock)
        _wait_for_reports(2, reports, simulator, epoch_real_s)
        with (directory / "daemon.log").open("ab") as log:
            daemon = subprocess.Popen([*toolpoint, "run", *config, "--simulated-clock", clock], stdout=log, stderr=log)
        started.append(daemon)
        client = _connect(configuration.service.socket, daemon, epoch_real_s)
        running = RunningSimulation(configuration, simulator, daemon, client, epoch_real_s, speed, reports)
        while time.monotonic() < epoch_real_s - 0.1:
            running.check_alive()
            links = client.ask("status")["links"]
            if all(link["up"] for link in links if link["name"] == "cnc"):
                return running
            time.sleep(0.05)
    except DaemonUnreachableError:
        pass
    except BaseException:
        _kill(*started)
        raise
    _kill(*started)
    return None


def _tell(simulator: "subprocess.Popen[str]", clock: str) -> None:
    assert simulator.stdin is not None
    with contextlib.suppress(BrokenPipeError), simulator.stdin as file:  # it has ended, which is found out next
        file.write(clock + "\n")


def _wait_for_reports(
    count: int, reports: list[dict[str, Any]], simulator: "subprocess.Popen[str]", until_s: float
) -> None:
    while len(reports) < count and simulator.poll() is None and time.monotonic() < until_s:
        time.sleep(0.02)


def _connect(path: Path, daemon: "subprocess.Popen[bytes]", until_s: float) -> ControlClient:
    while time.monotonic() < until_s:
        try:
            return ControlClient(path, SILENT_S)
        except DaemonUnreachableError:
            if daemon.poll() is not None:
                raise SimulationError(f"the daemon ended with status {daemon.returncode}") from None
            time.sleep(0.05)
    raise DaemonUnreachableError(f"{path}: no daemon in time")


def _collect(simulator: "subprocess.Popen[str]", reports: list[dict[str, Any]]) -> None:
    assert simulator.stdout is not None
    for line in simulator.stdout:
        reports.append(json.loads(line))


def _stop(running: RunningSimulation) -> None:
    with contextlib.suppress(OSError):
        running.client.close()
    for process in (running.daemon, running.simulator):
        process.terminate()
    for process in (running.daemon, running.simulator):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(STOP_PATIENCE_S)
    _kill(running.simulator, running.daemon)


def _kill(*processes: "subprocess.Popen[Any]") -> None:
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.wait()
