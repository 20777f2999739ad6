"""What happens to the process: killed, stopped, without descriptors or a peer, beside others."""

import contextlib
import os
import pty
import random
import resource
import signal
import socket
import subprocess
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import yaml
from account import Row
from rig import PATIENCE_S, PERIOD_S, PYTHON, SPEED, STATES, Rig, link

from daemon.simulation.processes import free_port

WHILE_STARTING = 0.15
"""Share of the kills that come while the daemon starts."""
LONGEST_LIFE_S = 2.5
WHOLE_EVERY = 20
"""The whole store is looked through after so many kills."""
HALF_SENT = 1100
DESCRIPTORS = 1024
MOST_LOG_BYTES = 100_000
REBUILT_WITHIN_S = 30.0
SWAPPED_S = 20.0
DROPPED = "bytes dropped"
FLOOD_KB_PER_S = 300.0


def kills(rig: Rig, row: Row, count: int, moments: random.Random) -> None:
    """Kill the daemon at random moments of its life, its start included."""
    rig.ensure_following()
    offset, after = rig.log_path.stat().st_size, rig.last_write()
    states: Counter[str] = Counter()
    for k in row.rounds(count):
        row.runs += 1
        if moments.random() < WHILE_STARTING:
            if rig.running.daemon.poll() is not None:
                rig.spawn()
            time.sleep(moments.uniform(0.0, 2.0))
        else:
            if rig.running.daemon.poll() is not None:
                row.start_s.append(rig.start())
            end_s = time.monotonic() + moments.uniform(0.0, LONGEST_LIFE_S)
            status = rig.status()
            while time.monotonic() < end_s:
                time.sleep(min(0.05, max(0.0, end_s - time.monotonic())))
                status = rig.status()
            begun = status["output"]["since_s"] is not None
            states[status["output"]["state"] if begun else "start"] += 1
            row.check("no OFF, no FAULT", in_order(status["output"]), status["output"])
        rig.kill()
        rig.check_store(row, rig.acknowledged, whole=k % WHOLE_EVERY == 0)
        if k % WHOLE_EVERY == WHOLE_EVERY - 1 and k + 1 < count:
            rig.ensure_following()
    row.start_s.append(rig.start())
    rig.back(row, time.monotonic())
    rig.check_log(row, offset)
    rig.check_writes(row, after, unverified=count)
    rig.check_store(row, rig.acknowledged)
    row.notes |= {f"killed in {state}": number for state, number in sorted(states.items())}


def in_order(output: dict[str, Any]) -> bool:
    """Return whether the output is neither in FAULT nor OFF; at a start it is OFF until its first step."""
    return output["since_s"] is None or output["state"] in STATES or output["reason"] == "started"


def stopped(rig: Rig, row: Row, seconds: float) -> None:
    """Stop the daemon as a debugger or a hung computer does, and let it go on."""
    rig.ensure_following()
    offset, after = rig.log_path.stat().st_size, rig.last_write()
    row.runs += 1
    said = rig.status()["history"]["acknowledged"]
    rig.running.daemon.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    rig.running.daemon.send_signal(signal.SIGCONT)
    gone_on_s = time.monotonic()
    rig.wait("new cycles", lambda status: more(status["history"]["acknowledged"], said), PATIENCE_S)
    rig.back(row, gone_on_s)
    rig.check_log(row, offset)
    rig.check_writes(row, after, unverified=2)
    rig.check_store(row, rig.acknowledged)


def more(now: dict[str, int], before: dict[str, int]) -> bool:
    """Return whether cycles of every line have been acknowledged since."""
    return all(now.get(line, 0) > number for line, number in before.items())


def descriptors_exhausted(rig: Rig, row: Row, count: int) -> None:
    """Leave the daemon no free descriptor while its link to the CNC breaks."""
    for _ in row.rounds(count):
        rig.ensure_following()
        offset, after = rig.log_path.stat().st_size, rig.last_write()
        row.runs += 1
        pid = rig.running.daemon.pid
        limits = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        used = {int(entry.name) for entry in Path(f"/proc/{pid}/fd").iterdir()}
        free = next(number for number in range(len(used) + 1) if number not in used)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (free, limits[1]))
        rig.relay.break_connections()
        time.sleep(5.0)
        row.check("it lives without descriptors", rig.running.daemon.poll() is None)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)
        rig.back(row, time.monotonic())
        size = rig.check_log(row, offset)
        row.check("the log stays below 100 kB", size < MOST_LOG_BYTES, size)
        rig.check_writes(row, after, unverified=2)
        rig.check_store(row, rig.acknowledged)


def half_sent(rig: Rig, row: Row, count: int) -> None:
    """Hold 1100 half-sent requests open on each socket of the daemon while its link to the CNC breaks."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 3 * HALF_SENT), hard))
    try:
        for _ in row.rounds(count):
            rig.ensure_following()
            pid, offset, after = rig.running.daemon.pid, rig.log_path.stat().st_size, rig.last_write()
            resource.prlimit(pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
            row.runs += 1
            with contextlib.ExitStack() as stack:
                _hold(rig, stack)
                broken_s = time.monotonic()
                rig.relay.break_connections()
                up = _came_up_again(rig, offset, broken_s)
                row.check(
                    "the link to the CNC is rebuilt meanwhile", up is not None, f"not within {REBUILT_WITHIN_S} s"
                )
                if up is not None:
                    row.notes["link rebuilt after s"] = round(max(up, row.notes.get("link rebuilt after s", 0.0)), 2)
                used = len(list(Path(f"/proc/{pid}/fd").iterdir()))
                row.check("most descriptors stay free", used < DESCRIPTORS / 2, used)
            rig.back(row, time.monotonic())
            size = rig.check_log(row, offset)
            row.notes["log bytes"] = max(size, row.notes.get("log bytes", 0))
            row.check("the log stays below 100 kB", size < MOST_LOG_BYTES, size)
            rig.check_writes(row, after, unverified=2)
            rig.check_store(row, rig.acknowledged)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def _hold(rig: Rig, stack: contextlib.ExitStack) -> None:
    """Send halves of requests to both sockets, whether they are taken or not."""
    service = rig.configuration.service
    for family, address, words in (
        (socket.AF_INET, ("127.0.0.1", service.http_port), b"GET /metrics HTTP/1.1\r\nHost"),
        (socket.AF_UNIX, str(service.socket), b'{"command": "sta'),
    ):
        for _ in range(HALF_SENT):
            peer = stack.enter_context(socket.socket(family, socket.SOCK_STREAM))
            peer.settimeout(10.0)
            with contextlib.suppress(OSError):
                peer.connect(address)
                peer.sendall(words)


def _came_up_again(rig: Rig, offset: int, broken_s: float) -> float | None:
    """Return how long after its end the link to the CNC was there again, by the log; None when it was not in time."""
    while time.monotonic() < broken_s + REBUILT_WITHIN_S:
        events = [entry["event"] for entry in rig.entries(offset) if entry.get("link") == "cnc"]
        if "link.lost" in events and "link.up" in events[events.index("link.lost") :]:
            return time.monotonic() - broken_s
        time.sleep(0.02)
    return None


def half_open(rig: Rig, row: Row, count: int) -> None:
    """Let the CNC's end of the connection vanish without a word; new connections are served."""
    for _ in row.rounds(count):
        rig.ensure_following()
        offset, after = rig.log_path.stat().st_size, rig.last_write()
        row.runs += 1
        silent_s = time.monotonic()
        rig.relay.abandon()
        up = _came_up_again(rig, offset, silent_s)
        row.check(
            "the silent connection is given up and built anew", up is not None, f"not within {REBUILT_WITHIN_S} s"
        )
        rig.back(row, silent_s)
        rig.check_log(row, offset)
        rig.check_writes(row, after, unverified=2)
        rig.check_store(row, rig.acknowledged)


@contextlib.contextmanager
def spinning(count: int = 4) -> Iterator[None]:
    """Keep so many processes busy with nothing."""
    burners = [subprocess.Popen([*PYTHON, "-c", "while True: sum(range(1000))"]) for _ in range(count)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def spinners(rig: Rig, row: Row, seconds: float) -> None:
    """Let four processes take the processor."""
    rig.ensure_following()
    offset, after = rig.log_path.stat().st_size, rig.last_write()
    row.runs += 1
    with spinning():
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            state = rig.status()["output"]["state"]
            row.check("no OFF, no FAULT", state in STATES, state)
            time.sleep(0.2)
    status = rig.back(row, time.monotonic())
    feedback = status["latency_s"]["feedback"]
    if feedback["samples"]:
        row.notes["feedback p99 ms"] = round(1e3 * feedback["p99"], 1)
    rig.check_log(row, offset)
    rig.check_writes(row, after, unverified=2)
    rig.check_store(row, rig.acknowledged)


def second_daemon(rig: Rig, row: Row, count: int) -> None:
    """Start a second daemon on the same CNC with a store of its own, and on the same store with another CNC."""
    rig.ensure_following()
    offset, after = rig.log_path.stat().st_size, rig.last_write()
    content = yaml.safe_load(rig.config_path.read_text("utf-8"))
    for _ in range(count):
        for name, sentence in (("cnc", "writes to this CNC already"), ("store", "writes this store")):
            row.runs += 1
            other = content | {
                "service": content["service"] | {"socket": str(rig.directory / "other.sock"), "http_port": None}
            }
            if name == "cnc":
                other["history"] = content["history"] | {"path": str(rig.directory / "other/history.sqlite")}
            else:
                connection = content["cnc"]["opcua"]
                endpoint = f"opc.tcp://127.0.0.1:{free_port()}/toolpoint/"
                other["cnc"] = content["cnc"] | {"opcua": connection | {"endpoint": endpoint}}
            path = rig.directory / f"second-{name}.yaml"
            path.write_text(yaml.safe_dump(other, sort_keys=False), "utf-8")
            arguments = [str(path) if part == str(rig.config_path) else part for part in rig.arguments]
            done = subprocess.run(arguments, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
            said = done.stdout + done.stderr
            row.check(
                f"a second daemon on one {name} ends by itself", done.returncode not in (0, -signal.SIGKILL), said
            )
            row.check(f"it says that another process {sentence}", sentence in said, said[-400:])
            row.check("it says so in a sentence, without a traceback", "Traceback" not in said, said[:400])
            row.check("it names the process", str(rig.running.daemon.pid) in said, said[-400:])
    rig.back(row, time.monotonic())
    row.check("the first daemon goes on", rig.status()["output"]["state"] == "ACTIVE", rig.status()["output"])
    rig.check_log(row, offset)
    rig.check_writes(row, after, unverified=1)
    rig.check_store(row, rig.acknowledged)


def flooded(rig: Rig, row: Row, seconds: float) -> None:
    """Let one line bring its frames as fast as they are taken, a hundred times its baud rate; then pull it out."""
    rig.ensure_following()
    port = rig.directory / "fixed.tty"
    device = port.readlink()
    offset, after, usual_mib = rig.log_path.stat().st_size, rig.last_write(), _rss_mib(rig)
    row.runs += 1
    rig.kill()
    frames = _listen(device)
    with contextlib.ExitStack() as stack:
        master, near = pty.openpty()
        stack.callback(os.close, near)
        tty.setraw(near)
        _lead_to(port, Path(os.ttyname(near)))
        stack.callback(_lead_to, port, device)
        hose = stack.enter_context(Hose(master, frames))
        rig.start()
        rig.ensure_link_up()
        rss_mib, answers_s, said, sent = [_rss_mib(rig)], [0.0], "", hose.sent
        before_mib = max(usual_mib, rss_mib[0])  # a daemon that has just started is still loading
        began_s = time.monotonic()
        while time.monotonic() < began_s + seconds:
            asked_s = time.monotonic()
            status = rig.status()
            answers_s.append(time.monotonic() - asked_s)
            rss_mib.append(_rss_mib(rig))
            said = said or next(
                (one for one in status["temperatures"]["line_faults"].get("fixed", ()) if DROPPED in one), ""
            )
            row.check("the link to the CNC stands", link(status, "cnc")["up"], link(status, "cnc"))
            output = status["output"]
            row.check("no OFF, no FAULT", in_order(output), output)
            time.sleep(0.1)
        rate = (hose.sent - sent) / (time.monotonic() - began_s) / 1e3
        row.notes |= {
            "kB/s": round(rate),
            "RSS before MiB": round(before_mib, 1),
            "RSS at most MiB": round(max(rss_mib), 1),
            "slowest answer s": round(max(answers_s), 2),
            "loss of bytes said": float(bool(said)),
        }
        row.check("memory stays within 24 MiB of what it was", max(rss_mib) - before_mib <= 24.0, max(rss_mib))
        row.check("it says that bytes are dropped", bool(said) or rate < FLOOD_KB_PER_S, rate)
    pulled_s, flooded = time.monotonic(), rig.status()["history"]["acknowledged"].get("fixed", 0)
    rig.wait("the loss", lambda status: link(status, "latsis fixed")["losses"] > 0, PATIENCE_S)
    rig.wait("the line", lambda status: link(status, "latsis fixed")["up"], PATIENCE_S)
    rig.back(row, pulled_s)
    # A line that is opened again numbers its cycles anew: compare within the new numbers alone.
    rig.wait("its new numbers", lambda status: status["history"]["acknowledged"]["fixed"] < flooded, PATIENCE_S)
    events = [entry["event"] for entry in rig.entries(offset) if entry.get("link") == "latsis fixed"]
    row.check("loss and return of the line are logged", events[-2:] == ["link.lost", "link.up"], events[-4:])
    size = rig.check_log(row, offset)
    row.check("the log stays below 100 kB", size < MOST_LOG_BYTES, size)
    rig.check_writes(row, after, unverified=2)
    rig.check_store(row, rig.acknowledged)


class Hose:
    """Writes the same bytes into a port again and again, in a thread."""

    def __init__(self, master: int, data: bytes) -> None:
        self._master, self._data, self._end = master, data, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.sent = 0

    def __enter__(self) -> "Hose":
        os.set_blocking(self._master, False)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        os.close(self._master)

    def _run(self) -> None:
        while not self._end.is_set():
            try:
                self.sent += os.write(self._master, self._data)
            except BlockingIOError:
                self._end.wait(0.001)


def _listen(device: Path) -> bytes:
    """Return what a line brings within two passes."""
    heard, end_s = b"", time.monotonic() + 2 * PERIOD_S / SPEED
    port = os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        while time.monotonic() < end_s or not heard:
            with contextlib.suppress(BlockingIOError):
                heard += os.read(port, 65536)
            time.sleep(0.01)
    finally:
        os.close(port)
    return heard


def _lead_to(name: Path, device: Path) -> None:
    name.unlink()
    name.symlink_to(device)


def _rss_mib(rig: Rig) -> float:
    return psutil.Process(rig.running.daemon.pid).memory_info().rss / 2**20


def ports_swapped(rig: Rig, row: Row, count: int) -> None:
    """Give two lines each other's port while the daemon is down, as a new numbering of adapters does; then back."""
    first, second = (rig.directory / f"{name}.tty" for name in ("saddle", "fixed"))
    for _ in row.rounds(count):
        rig.ensure_following()
        offset, after, began_utc_s = rig.log_path.stat().st_size, rig.last_write(), rig.last_estimate_utc_s()
        row.runs += 1
        rig.kill()
        _swap(first, second)
        try:
            rig.start()
            end_s = time.monotonic() + SWAPPED_S
            while time.monotonic() < end_s:
                status = rig.status()
                row.check("no OFF, no FAULT", in_order(status["output"]), status["output"])
                time.sleep(0.2)
            said = {link["name"]: link["problem"] for link in status["links"] if link["problem"]}
            said |= status["temperatures"]["line_faults"]
            row.check(
                "it says what is wrong with the lines", "latsis saddle" in said or "saddle" in said, status["links"]
            )
            rig.kill()
        finally:
            _swap(first, second)
        rig.start()
        rig.ensure_following()
        rig.back(row, time.monotonic())
        rig.check_estimates(row, began_utc_s)
        rig.check_log(row, offset)
        rig.check_writes(row, after, unverified=2)
        rig.check_store(row, rig.acknowledged)


def _swap(first: Path, second: Path) -> None:
    there, here = first.readlink(), second.readlink()
    _lead_to(first, here)
    _lead_to(second, there)
