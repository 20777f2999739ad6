"""The daemon's process in a fault campaign: started, limited, killed; what it acknowledges and logs."""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import threading
from array import array
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from daemon.simulation.faults.script import Happening
from daemon.simulation.faults.virtual_world import channel_pair

FILE_LIMIT_BYTES = 4096
"""On a full disk no file grows beyond this; the store's files are all longer."""
KEPT_LINES = 40
STOP_PATIENCE_S = 60.0
PAGES_PER_MIB = 2**20 / os.sysconf("SC_PAGE_SIZE")
NUMBER_BITS = 20


def cycle_key(number: int, utc_ms: int) -> int:
    return utc_ms << NUMBER_BITS | number


class DaemonProcess:
    def __init__(self, config_path: Path, *, epoch_utc_s: float, seed: str, log_path: Path) -> None:
        self.channel, far = channel_pair()
        self._acknowledged, write_end = os.pipe()
        os.set_blocking(self._acknowledged, False)
        arguments = [str(config_path), str(far.fileno()), str(write_end), repr(epoch_utc_s), seed]
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "daemon.simulation.faults.daemon", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            pass_fds=(far.fileno(), write_end),
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            process_group=0,  # a Ctrl-C is for the campaign, which then stops the daemon in order
        )
        far.close()
        os.close(write_end)
        self.defects: list[str] = []
        self.last_lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._rest = b""
        self._log = threading.Thread(target=self._read_log, args=(log_path,), daemon=True)
        self._log.start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def rss_mib(self) -> float:
        """Return its resident memory [MiB]."""
        with contextlib.suppress(OSError):
            return int(Path(f"/proc/{self.pid}/statm").read_text("ascii").split()[1]) / PAGES_PER_MIB
        return float("nan")

    def fill_disk(self) -> None:
        """Let no file of it grow."""
        resource.prlimit(self.pid, resource.RLIMIT_FSIZE, (FILE_LIMIT_BYTES, resource.RLIM_INFINITY))

    def free_disk(self) -> None:
        resource.prlimit(self.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))

    def reload_model(self) -> None:
        self._process.send_signal(signal.SIGHUP)

    def ask_to_stop(self) -> None:
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def wait(self) -> int:
        """Wait for an end that was asked for; return its status."""
        try:
            return self._process.wait(STOP_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.kill()
            return -signal.SIGKILL

    def acknowledged(self) -> Iterator[tuple[str, int]]:
        """Yield line and key of the cycles whose commits were reported since the last call."""
        while True:
            try:
                data = os.read(self._acknowledged, 1 << 16)
            except BlockingIOError:
                return
            if not data:
                return
            *lines, self._rest = (self._rest + data).split(b"\n")
            for text in lines:
                name, number, utc_ms = text.decode("ascii").rsplit(" ", 2)
                yield name, cycle_key(int(number), int(utc_ms))

    def close(self) -> None:
        """Release what belongs to it, after its end."""
        self._log.join(STOP_PATIENCE_S)
        if self._process.stderr is not None:
            self._process.stderr.close()
        self.channel.close()
        os.close(self._acknowledged)

    def _read_log(self, path: Path) -> None:
        assert self._process.stderr is not None
        with path.open("ab") as file:
            for raw in self._process.stderr:
                file.write(raw)
                line = raw.decode("utf-8", "replace").rstrip()
                self.last_lines.append(line)
                if _is_defect(line):
                    self.defects.append(line)


def _is_defect(line: str) -> bool:
    """Return whether a line of the log reports something unexpected."""
    if not line.startswith("{"):
        return line.startswith("Traceback")
    try:
        entry: dict[str, Any] = json.loads(line)
    except json.JSONDecodeError:
        return False
    return str(entry.get("event", "")).endswith(".defect")


class Acknowledgements:
    """All cycles that the daemon has acknowledged, by line."""

    def __init__(self) -> None:
        self.keys: dict[str, array[int]] = {}

    def take(self, process: DaemonProcess) -> None:
        for line, key in process.acknowledged():
            self.keys.setdefault(line, array("q")).append(key)

    @property
    def count(self) -> int:
        return sum(map(len, self.keys.values()))


WARM_UP_S = 3600.0
MEMORY_LOOK_S = 600.0


class KillPlan:
    """Kills at once, or after some groups of a block."""

    def __init__(self, sequence_a: int) -> None:
        self._sequence_a = sequence_a
        self._after_groups: tuple[int, Happening] | None = None
        self.due: Happening | None = None
        """Why the daemon is to be killed now; None while it may run."""

    def in_write(self, happening: Happening) -> None:
        """Kill after so many groups of the next block."""
        self._after_groups = (int(happening.amount), happening)

    def clear(self) -> None:
        """Clear what is planned: the daemon has ended."""
        self.due = self._after_groups = None

    def before(self, group: tuple[tuple[int, float], ...]) -> bool:
        if self._after_groups is None:
            return False
        left, happening = self._after_groups
        begins = group[0][0] == self._sequence_a
        if not begins and left == int(happening.amount):
            return False
        if left == 0:
            self.due = happening
            return True
        self._after_groups = (left - 1, happening)
        return False


class MemoryWatch:
    """Follows the resident memory of each life from the first hour on, releases of models included."""

    def __init__(self, warm_up_s: float) -> None:
        self._warm_up_s = warm_up_s
        self._began_s = self._next_s = 0.0
        self._at_start_mib: float | None = None
        self.rss_mib = 0.0
        self.growth_mib = 0.0
        """The most that it has grown in one life [MiB]."""

    def restarted(self, time_s: float) -> None:
        self._began_s = self._next_s = time_s
        self._at_start_mib = None

    def due(self, time_s: float) -> bool:
        """Tell whether it is time to look again; if so, the next time is a while later."""
        if time_s < self._next_s:
            return False
        self._next_s = time_s + MEMORY_LOOK_S
        return True

    def look(self, time_s: float, process: DaemonProcess) -> None:
        if time_s - self._began_s < self._warm_up_s:
            return
        self.rss_mib = process.rss_mib()
        if self._at_start_mib is None:
            self._at_start_mib = self.rss_mib
        self.growth_mib = max(self.growth_mib, self.rss_mib - self._at_start_mib)
