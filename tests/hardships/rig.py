"""The machine and the daemon on real wires, with a relay before the CNC and a small disk under the store."""

import asyncio
import contextlib
import itertools
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from account import Row, Unavailable
from wires import Wires, check_audit, on_wires

from config.loader import load_configuration
from daemon.history.reader import HistoryReader
from daemon.monitor.control_client import DaemonUnreachableError
from daemon.monitor.control_socket import RequestError
from daemon.simulation.processes import free_port
from drivers.sim.wires.tcp_relay import TcpRelay
from models.records import WriteOutcome

SPEED = 4.0
"""Simulated seconds per second: an outage of a start is shorter than a positioning."""
PERIOD_S = 2.0
"""Cycle period of the lines [simulated s]: many cycles and writes per second of the wall clock."""
PATIENCE_S = 120.0
STATES = ("ACTIVE", "HOLD", "ARMED")
DISK_MIB = 96
STEADY_UM = 1.0
EVER = (0.0, 1e11)


class Relay:
    """A TCP relay before the simulated CNC, in a thread with a loop of its own."""

    def __init__(self, target_port: int) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._relay = TcpRelay(port=0, target_port=target_port)

    def __enter__(self) -> "Relay":
        self._thread.start()
        self._run(self._relay.start())
        return self

    def __exit__(self, *_: object) -> None:
        self._run(self._relay.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    @property
    def port(self) -> int:
        return self._relay.port

    def break_connections(self) -> None:
        """Reset every connection and take new ones at once."""
        self._run(self._relay.stop())
        self._run(self._relay.start())

    def abandon(self) -> None:
        """Leave the present connections open and silent for ever; serve new ones."""

        async def abandon() -> None:
            self._relay.abandon()

        self._run(abandon())

    def _run(self, work: Any) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(30)


class Rig(Wires):
    """One simulation whose daemon is started, disturbed and ended by the rows."""

    def __init__(self, wires: Wires, relay: Relay, config_path: Path, arguments: Sequence[str]) -> None:
        super().__init__(wires.running, wires.directory)
        self.relay = relay
        self.config_path = config_path
        self.arguments = list(arguments)
        self.environment: dict[str, str] = {}
        self.configuration = load_configuration(config_path)
        self.store = self.configuration.history.path
        self.log_path = self.directory / "daemon.log"
        self.acknowledged: dict[str, int] = {}
        """What the daemon said last that it had acknowledged, in this life."""
        self._spawned_utc_s = 0.0
        self._log_start = 0

    # --- lives of the daemon ---------------------------------------------------------------

    def spawn(self, arguments: Sequence[str] | None = None, **more: Any) -> None:
        """Start a process; it is not waited for."""
        self._log_start = self.log_path.stat().st_size if self.log_path.exists() else 0
        self._spawned_utc_s = time.time()
        self.acknowledged = {}
        with self.log_path.open("ab") as log:
            self.running.daemon = subprocess.Popen(
                self.arguments if arguments is None else arguments,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"} | self.environment,
                **more,
            )

    def start(self) -> float:
        """Start the daemon and connect; return the time to `daemon.ready` [s]."""
        self.spawn()
        self.connect()
        while True:
            for entry in self.entries(self._log_start):
                if entry["event"] == "daemon.ready":
                    return datetime.fromisoformat(entry["timestamp"]).timestamp() - self._spawned_utc_s
            assert self.running.daemon.poll() is None, (
                f"the daemon ended with {self.running.daemon.returncode}: {self.tail()}"
            )
            time.sleep(0.01)

    def status(self) -> dict[str, Any]:
        try:
            status = super().status()
        except DaemonUnreachableError:
            self.connect()
            status = super().status()
        self.acknowledged = status["history"]["acknowledged"]
        return status

    def kill(self) -> None:
        self.running.daemon.kill()
        self.running.daemon.wait()

    def ensure_following(self) -> None:
        """See to it that a daemon runs and that its output is ACTIVE, by a reference by hand where there is none."""
        if self.running.daemon.poll() is not None:
            self.start()
        status = self.wait("the link and the estimate", lambda status: link(status, "cnc")["up"])
        deadline_s, asked_s = time.monotonic() + PATIENCE_S, 0.0
        while status["output"]["state"] != "ACTIVE":
            assert time.monotonic() < deadline_s, f"not ACTIVE again: {status['output']}, {status['reference_ended']}"
            if time.monotonic() > asked_s + 15.0:
                asked_s = time.monotonic()
                with contextlib.suppress(RequestError):
                    self.running.client.ask("reference")
                    self.running.client.ask("enable")
            time.sleep(0.1)
            status = self.status()

    def ensure_link_up(self) -> None:
        """Wait for the link to the CNC and for temperatures."""
        self.wait("the link", lambda status: link(status, "cnc")["up"] and status["temperatures"] is not None)

    def back(self, row: Row, since_s: float) -> dict[str, Any]:
        """Wait until the output follows, or holds with a reason and a link; note the time since `since_s`."""

        def settled(status: dict[str, Any]) -> bool:
            output = status["output"]
            links = all(one["up"] for one in status["links"])
            return links and (output["state"] == "ACTIVE" or (output["state"] in STATES and bool(output["reason"])))

        status = self.wait("links and output", settled, PATIENCE_S)
        row.back_s.append(time.monotonic() - since_s)
        row.check("after it the output follows, or holds with a reason", status["output"]["state"] in STATES)
        return status

    # --- what it said, what it stored ------------------------------------------------------

    def entries(self, offset: int) -> list[dict[str, Any]]:
        """Return what was logged from a byte of the log on."""
        with self.log_path.open("rb") as log:
            log.seek(offset)
            lines = log.read().splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.startswith(b"{") and line.endswith(b"\n")]

    def tail(self) -> str:
        return self.log_path.read_text("utf-8", "replace")[self._log_start :][-600:]

    def check_log(self, row: Row, offset: int, *, fault: bool = False) -> int:
        """Check that nothing unexpected was logged from a byte on; return how much was [byte]."""
        with self.log_path.open("rb") as log:
            log.seek(offset)
            text = log.read().decode("utf-8", "replace")
        at = text.find("Traceback")
        row.check("no traceback", at < 0, text[max(0, at - 200) :][:600] if at >= 0 else "")
        events = self.entries(offset)
        defects = [entry for entry in events if entry["event"].endswith(".defect")]
        row.check("no defect", not defects, defects[:1])
        if not fault:
            faults = [entry for entry in events if entry["event"] == "output.fault"]
            row.check("no FAULT", not faults, faults[:1])
        return len(text)

    def check_store(self, row: Row, said: dict[str, int], *, whole: bool = True) -> None:
        """Check that the store holds every acknowledged cycle, and is whole."""
        with HistoryReader(self.store) as reader:
            stored = reader.acknowledged()
        lost = sum(max(0, number - stored.get(line, 0)) for line, number in said.items())
        row.acknowledged += sum(said.values())
        row.lost += lost
        row.check("every acknowledged cycle is in the store", lost == 0, f"said {said}, stored {stored}")
        if whole:
            with contextlib.closing(sqlite3.connect(f"file:{self.store}?mode=ro", uri=True)) as connection:
                found = connection.execute("PRAGMA quick_check").fetchall()
            row.check("the store is whole", found == [("ok",)], found[:3])

    def last_write(self) -> int:
        with HistoryReader(self.store) as reader:
            return reader.last_write_id() or 0

    def last_estimate_utc_s(self) -> float:
        with HistoryReader(self.store) as reader:
            times = reader.estimates(*EVER).time_s
        return float(times[-1]) if len(times) else 0.0

    def check_estimates(self, row: Row, since_s: float) -> None:
        """Check that what is estimated goes on, over swaps and restarts, as the machine does: within 1 um and the slew.

        A value that is believed of the wrong sensor is off by um per K of it, and goes back when it is told apart.
        """
        with HistoryReader(self.store) as reader:
            found = reader.estimates(since_s, EVER[1])
        for axis in self.configuration.compensation.axes.values():
            if axis.estimate is None:
                continue
            values_um = found.thermal_error_um[axis.estimate]
            for k, (then, now) in enumerate(itertools.pairwise(found.reference_id), start=1):
                gap_min = (found.time_s[k] - found.time_s[k - 1]) / 60.0
                jump_um = abs(values_um[k] - values_um[k - 1])
                allowed_um = STEADY_UM + axis.slew_um_per_min * gap_min
                if then == now and found.model_id[k] == found.model_id[k - 1]:
                    row.check("the estimate goes on without a jump", jump_um <= allowed_um, (jump_um, found.time_s[k]))

    def check_writes(self, row: Row, after: int, *, unverified: int, slew: bool = True) -> None:
        """Check bound, slew and standstill of what was written after a write."""
        with HistoryReader(self.store) as reader:
            writes = [one for one in reader.writes(*EVER) if one.compensation_um and one.write_id > after]
        if writes and writes[-1].outcome is WriteOutcome.INTENDED:
            writes.pop()
        row.notes["blocks"] = row.notes.get("blocks", 0) + len(writes)
        if not writes:
            return
        if slew:
            with row.holds("bound, slew rate and standstill in HOLD of every block"):
                check_audit(writes, self.configuration, unverified=unverified, begun_s=self.begun_s())
            return
        bounds = {name: axis.absolute_bound_um for name, axis in self.configuration.compensation.axes.items()}
        bad = [one for one in writes if any(abs(one.compensation_um[a] or 0.0) > b for a, b in bounds.items())]
        row.check("bound of every block", not bad, bad[:1])


def link(status: dict[str, Any], name: str) -> dict[str, Any]:
    return next(one for one in status["links"] if one["name"] == name)


def at_work(content: dict[str, Any]) -> None:
    """Make the lines fast, so that much is under way whenever something happens."""
    for line in content["temperatures"]["lines"]:
        line["cycle_period_s"] = PERIOD_S
        line["baud"] = 115200
    content["compensation"]["reference"]["mean_s"] = 6.0 * PERIOD_S
    content["compensation"]["reference"]["max_outage_s"] = 3600.0
    content["service"]["http_port"] = free_port()


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Put a small file system under a folder, where this account may; otherwise the folder stays what it is."""
    folder.mkdir()
    if os.geteuid() == 0 and shutil.which("mount"):
        command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "toolpoint-hardships", str(folder)]
        subprocess.run(command, check=False, capture_output=True)
    try:
        yield
    finally:
        if folder.is_mount():
            subprocess.run(["umount", "--lazy", str(folder)], check=False)


def need_small_disk(rig: Rig) -> Path:
    """Return the folder of the store if it is a file system of its own; raises Unavailable."""
    if not rig.store.parent.is_mount():
        raise Unavailable("a small file system can be mounted by root only")
    return rig.store.parent


@contextlib.contextmanager
def machine_and_daemon(
    *,
    speed: float = SPEED,
    change: Callable[[dict[str, Any]], None] = at_work,
    faults: Sequence[dict[str, Any]] = (),
) -> Iterator[Rig]:
    """Start simulated machine and daemon; the daemon reaches the CNC through a relay."""
    with contextlib.ExitStack() as stack:
        directory = Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="hardships-", ignore_cleanup_errors=True))
        )
        stack.enter_context(small_disk(directory / "state"))

        def changed(content: dict[str, Any]) -> None:
            content["history"]["path"] = str(directory / "state/history.sqlite")
            change(content)

        wires = stack.enter_context(on_wires(directory, speed=speed, change=changed, faults=faults))
        wires.kill_daemon()
        content = yaml.safe_load((directory / "toolpoint.yaml").read_text("utf-8"))
        opcua = content["cnc"]["opcua"]
        direct = int(opcua["endpoint"].rpartition(":")[2].partition("/")[0])
        relay = stack.enter_context(Relay(direct))
        opcua["endpoint"] = opcua["endpoint"].replace(f":{direct}/", f":{relay.port}/")
        path = directory / "relayed.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False), "utf-8")
        arguments = [
            str(path) if part == str(directory / "toolpoint.yaml") else part for part in wires.running.daemon.args
        ]
        rig = Rig(wires, relay, path, arguments)
        wires.running.configuration = rig.configuration
        rig.start()
        try:
            yield rig
        finally:
            if rig.running.daemon.poll() is None:
                rig.running.daemon.kill()
                rig.running.daemon.wait()


PYTHON = [sys.executable, "-P"]
