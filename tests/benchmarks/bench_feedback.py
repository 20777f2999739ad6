"""From the last byte of a line's cycle to the macro that was read back, in real time, with the whole daemon.

    python tests/benchmarks/bench_feedback.py [--cycles 5000] [--period 0.25] [--secure] [--busy] [--nice N] [--sink ..]

Simulated machine and daemon are two processes as in the demo, at speed 1. --period shortens the lines'
cycle (the dissertation's is 10 s) to gather more samples, and with it the mean before the model, so that a cycle
costs what it costs at 10 s; at 0.25 s 5000 cycles take 9.5 minutes. The three lines then meet each other and the polls
more often than in operation, so that the tail is rather too long than too short. --busy loads every core besides.
The daemon runs at the priority of its systemd unit, and so does the simulated machine, which stands for another
computer; --nice 0 leaves both at the usual one. Negative ones need root.
Prints start-up time, percentiles of the feedback delay and of each stage on the way (from the audit), and memory and
CPU of the daemon.

In the last quarter of every twenty seconds a third process makes the same calls bare: it reads the block, writes as
many macros that nobody uses in three requests, and reads back. What falls into these times does not count for the
daemon, and a bare call that met one of the daemon's does not count either; the ratio of the two is printed. It makes
them twice as often as the daemon, whose caches are colder. --bare none leaves it out.

--sink postgresql or sparkplug lets `toolpoint sink run` send the history meanwhile to a server of its own on this
computer, as low in priority as its unit sets it. Every twenty seconds it is halted or goes on (then with what has
waited); the delays of both are printed with their ratio, instead of those of the bare calls.

A short period has a short silence, a quarter of it, after which a pass counts as over. On a computer that
stalls the simulated wires for as long, passes are cut in two; those incomplete cycles are counted apart.
"""

import argparse
import asyncio
import contextlib
import gc
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import numpy as np
import psutil
from mosquitto import mosquitto
from postgresql import PASSWORD, postgresql

from config.loader import load_configuration
from daemon.cli.simulate.demo import demo_machine
from daemon.history.reader import HistoryReader
from daemon.simulation.demonstration import switch_on, watch
from daemon.simulation.processes import start_simulation, write_simulation_configuration
from drivers.clock import SystemClock
from drivers.opcua.cnc import OpcUaCnc

STAGES = ("cleansed", "estimated", "written", "read_back")
SETTLING_S = 15.0
"""The reference is set by hand after this long, so that estimates begin [s]."""
TURN_S, ALONE_S = 20.0, 15.0
"""In each turn the daemon is alone at first, then the bare calls are beside it [s]."""
APART_S = 0.5
"""So far from any bare call the daemon counts as alone [s]."""
UNUSED = range(531, 540)
"""Macros of the shipped machine that nobody uses."""
LINES = 3
UNIT = Path(__file__).parents[2] / "systemd" / "toolpoint.service"


def _unit_nice() -> int:
    """Return the priority at which the service manager runs the daemon."""
    (line,) = (line for line in UNIT.read_text(encoding="utf-8").splitlines() if line.startswith("Nice="))
    return int(line.removeprefix("Nice="))


def _renice(pid: int, niceness: int) -> None:
    """Give all threads of a process a priority; those that come later take it over."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        os.setpriority(os.PRIO_PROCESS, int(thread.name), niceness)


def _started_s(pid: int) -> float:
    """Return when a process was started, to a hundredth of a second [s since 1970].

    That of psutil counts from a boot time in whole seconds.
    """
    ticks = int(Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()[19])
    age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    return time.time() - age_s


def _ready_s(log: Path) -> float:
    """Return when the daemon said that it was ready [s since 1970]."""
    for line in log.read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        if record["event"] == "daemon.ready":
            return datetime.fromisoformat(record["timestamp"]).timestamp()
    raise ValueError(f"{log}: the daemon was never ready")


async def _call_bare(path: Path, period_s: float, begin_s: float) -> None:
    """Make the daemon's calls for every other turn, and print when each pass began and ended [monotonic s]."""
    config = load_configuration(path).cnc
    macros, cnc = config.macros, OpcUaCnc(config, SystemClock())
    ours = (macros.sequence_a, *macros.values.values(), macros.valid_until, macros.enable, macros.sequence_b)
    ours += () if macros.check is None else (macros.check,)
    back = (*ours, *macros.echo_applied.values(), macros.echo_time, macros.echo_status, macros.echo_guard_version)
    await cnc.connect()
    gc.freeze()
    number = 0.0
    while True:
        into_s = (time.monotonic() - begin_s) % TURN_S
        await asyncio.sleep(max(0.0, ALONE_S - into_s) + period_s / LINES * random.uniform(0.25, 0.75))
        if (time.monotonic() - begin_s) % TURN_S < ALONE_S:
            continue
        number += 1.0
        first, *content, last = ((macro, number) for macro in UNUSED[: len(ours)])
        began_s = time.monotonic()
        await cnc.read_macros(ours)
        await cnc.write_macros(((first,), tuple(content), (last,)))
        await cnc.read_macros(back)
        print(began_s, time.monotonic(), flush=True)


@contextlib.contextmanager
def _bare_calls(path: Path, period_s: float, found: list[tuple[float, float]], *, wanted: bool) -> Iterator[None]:
    """Let a process of its own make the bare calls meanwhile; `found` gets when each began and ended."""
    if not wanted:
        yield
        return
    command = [sys.executable, __file__, "--bare", f"{path}:{period_s}:{time.monotonic()}"]
    with tempfile.TemporaryFile("w+") as output, subprocess.Popen(command, stdout=output) as process:
        try:
            yield
        finally:
            process.terminate()
            process.wait()
        output.seek(0)
        found += [(float(began), float(ended)) for began, ended in map(str.split, output)]


@contextlib.contextmanager
def _server(kind: str | None, directory: Path) -> Iterator[dict[str, Any]]:
    """Run what a sink sends to; yields the section of the sink."""
    if kind is None:
        yield {}
    elif kind == "postgresql":
        password = directory / "password"
        password.write_text(PASSWORD)
        with postgresql() as server:
            yield {"host": "127.0.0.1", "port": server.port, "tls": False, "password_file": str(password)}
    else:
        with mosquitto(directory, "allow_anonymous true") as port:
            yield {"host": "127.0.0.1", "port": port, "tls": False}


@contextlib.contextmanager
def _sending(path: Path, halted: list[tuple[float, float]], *, wanted: bool) -> Iterator[None]:
    """Let a process send the history meanwhile, in every other turn; `halted` gets when it did not [monotonic s]."""
    if not wanted:
        yield
        return
    over = threading.Event()
    command = ["nice", "-n", "15", sys.executable, "-P", "-m", "daemon.cli", "sink", "run", "--config", str(path)]
    with (
        (path.parent / "sink.log").open("wb") as log,
        subprocess.Popen(command, stdout=log, stderr=log) as process,
    ):

        def take_turns() -> None:
            while not over.wait(TURN_S):
                process.send_signal(signal.SIGSTOP)
                began_s = time.monotonic()
                over.wait(TURN_S)
                halted.append((began_s, time.monotonic()))
                process.send_signal(signal.SIGCONT)

        thread = threading.Thread(target=take_turns)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            used = psutil.Process(process.pid).cpu_times()
            print(f"sender: {used.user + used.system:.1f} s of processor time, with its start")
            process.terminate()


def _with_and_without(feedback: list[tuple[float, float]], halted: list[tuple[float, float]]) -> None:
    """Print the delays while the sink sends and while it is halted [begin and end in s]; neither across a change."""
    changes = np.array(halted)
    inside = [((changes[:, 0] + APART_S < begin_s) & (changes[:, 1] > end_s)).any() for begin_s, end_s in feedback]
    clear = [(np.abs(changes - end_s) > APART_S).all() for _, end_s in feedback]
    ms = 1e3 * np.diff(np.array(feedback), axis=1)[:, 0]
    is_halted, counts = np.array(inside), np.array(clear)
    both = [ms[counts & ~is_halted], ms[counts & is_halted]]
    quantiles = [np.percentile(each, [50, 99]) for each in both]
    for name, (p50, p99), each in zip(("while a sink sends", "while it is halted"), quantiles, both, strict=True):
        print(f"{name:>22}: p50 {p50:6.2f}, p99 {p99:6.2f} ms, {len(each)} times")
    print("{:>22}: p50 {:6.3f}, p99 {:6.3f}".format("ratio", *(quantiles[0] / quantiles[1])))


def _ratio(feedback: list[tuple[float, float]], bare: list[tuple[float, float]]) -> None:
    """Print the daemon's delays and those of the bare calls [begin and end in s], and their ratio."""
    busy = np.array(feedback)
    apart = [b for b in bare if not ((busy[:, 0] < b[1]) & (busy[:, 1] > b[0])).any()]
    edges = np.sort(np.array(bare).ravel())
    nearest = np.searchsorted(edges, [begin_s for begin_s, _ in feedback])
    padded = np.concatenate([[-np.inf], edges, [np.inf]])
    alone = [
        f
        for f, i in zip(feedback, nearest, strict=True)
        if f[0] - padded[i] > APART_S and padded[i + 1] - f[1] > APART_S
    ]
    ms = [np.diff(np.array(times), axis=1)[:, 0] * 1e3 for times in (alone, apart)]
    quantiles = [np.percentile(each, [50, 99, 99.9]) for each in ms]
    for name, values, each in zip(
        ("feedback, last byte to read back", "the same calls bare"), quantiles, ms, strict=True
    ):
        print("{:>33}: p50 {:6.2f}, p99 {:6.2f}, p99.9 {:6.2f} ms, {} times".format(name, *values, len(each)))
    print("{:>33}: p50 {:6.2f}, p99 {:6.2f}, p99.9 {:6.2f}".format("ratio", *(quantiles[0] / quantiles[1])))


def _stages(
    store: Path, to_monotonic_s: float, bare: list[tuple[float, float]], halted: list[tuple[float, float]]
) -> None:
    """Print where the time goes from the last byte of a complete cycle on [ms], for writes that an estimate caused."""
    with contextlib.closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True)) as connection:
        incomplete = {ms for (ms,) in connection.execute("SELECT utc_ms FROM temperature_cycles WHERE NOT complete")}
    with HistoryReader(store) as reader:
        writes = [record for record in reader.writes(0.0, time.time() + 1e6) if record.cause == "estimate"]
    whole = [record for record in writes if round((record.cycle_time_s or 0.0) * 1e3) not in incomplete]
    print(
        f"{len(writes)} writes for estimates, {len(writes) - len(whole)} of them for incomplete cycles, left out here:"
    )
    cycles = [record.delay_s for record in whole if all(stage in record.delay_s for stage in STAGES)]
    if not cycles:
        print("the audit holds no write with a whole trace")
        return
    stages = np.array([[delay_s[stage] for stage in STAGES] for delay_s in cycles]) * 1e3
    names = ("last byte to cleansed", "cleansed to estimated", "estimated to written", "written to read back")
    for name, column in zip((*names, "all"), (*np.diff(stages, axis=1, prepend=0.0).T, stages[:, -1]), strict=True):
        p50, p99, p999 = np.percentile(column, [50, 99, 99.9])
        print(f"{name:>22}: p50 {p50:6.2f}, p99 {p99:6.2f}, p99.9 {p999:6.2f}, max {column.max():6.2f} ms")
    order = np.argsort(stages[:, -1])[::-1][:5]
    print("slowest (write, ms to each stage):", [(int(i), stages[i].round(1).tolist()) for i in order])
    if bare or halted:
        ends = [
            (record.outcome_time_s + to_monotonic_s, record.delay_s["read_back"])
            for record in whole
            if record.outcome_time_s is not None and "cleansed" in record.delay_s and "read_back" in record.delay_s
        ]
        feedback = [(end_s - delay_s, end_s) for end_s, delay_s in ends]
        if bare:
            _ratio(feedback, bare)
        else:
            _with_and_without(feedback, halted)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cycles", type=int, default=5000, help="that many with the daemon alone")
    parser.add_argument("--period", type=float, default=0.25)
    parser.add_argument("--secure", action="store_true")
    parser.add_argument("--busy", action="store_true")
    parser.add_argument("--bare", default="paired", help="none, or (for this program itself) file:period:begin")
    parser.add_argument("--sink", choices=("postgresql", "sparkplug"))
    parser.add_argument("--nice", type=int, default=_unit_nice())
    options = parser.parse_args()
    if options.sink is not None:
        options.bare = "none"
    if ":" in options.bare:
        path, period_s, begin_s = options.bare.rsplit(":", 2)
        asyncio.run(_call_bare(Path(path), float(period_s), float(begin_s)))
    base = demo_machine()
    base["compensation"]["reference"]["mean_s"] = 60.0 * options.period / 10.0
    for line in base["temperatures"]["lines"]:
        line["cycle_period_s"] = options.period
        line["baud"] = 460800
    share = 1.0 if options.bare == "none" else (ALONE_S - 2 * APART_S) / TURN_S
    until_s = max(options.cycles / (LINES / options.period) / share * 1.02, TURN_S)
    print(f"priority {options.nice} of the daemon and the simulated machine")
    burners = [
        subprocess.Popen([sys.executable, "-c", "while True: sum(range(1000))"])
        for _ in range((os.cpu_count() or 1) if options.busy else 0)
    ]
    bare: list[tuple[float, float]] = []
    halted: list[tuple[float, float]] = []
    try:
        with contextlib.ExitStack() as stack:
            directory = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            there, epoch_utc_s = stack.enter_context(_server(options.sink, directory)), time.time()
            if options.sink is not None:
                base["sinks"] = [{"name": "bench", "driver": options.sink, options.sink: there}]
            path, _ = write_simulation_configuration(base, directory, speed=1.0, http_port=0, secure=options.secure)
            with start_simulation([], path, speed=1.0, epoch_utc_s=epoch_utc_s, directory=directory) as running:
                switch_on(running)
                daemon = psutil.Process(running.daemon.pid)
                ready_s = _ready_s(directory / "daemon.log") - _started_s(daemon.pid)
                print(f"daemon ready {ready_s:.2f} s after its start")
                for pid in (daemon.pid, running.simulator.pid):
                    _renice(pid, options.nice)
                watch(running, SETTLING_S, lambda _: None, 1.0)
                running.client.ask("reference")
                before, wall_s = daemon.cpu_times(), time.monotonic()
                with (
                    _bare_calls(path, options.period, bare, wanted=options.bare == "paired"),
                    _sending(path, halted, wanted=options.sink is not None),
                ):
                    watch(running, SETTLING_S + until_s, lambda _: None, 10.0)
                after, wall_s = daemon.cpu_times(), time.monotonic() - wall_s
                status = running.client.ask("status")
                cpu_s = after.user + after.system - before.user - before.system
                feedback = status["latency_s"]["feedback"]
                print(f"cycle period {options.period:g} s, secure {options.secure}, busy {options.busy}")
                print("feedback [ms]:", {k: round(v * 1e3, 2) for k, v in feedback.items() if k != "samples"})
                print("samples:", feedback["samples"], "writes:", status["writes"], "cycles:", status["cycles"])
                print(
                    f"daemon: RSS {daemon.memory_info().rss / 2**20:.1f} MiB, "
                    f"CPU {100 * cpu_s / wall_s:.2f} % of a core"
                )
            _stages(directory / "history.sqlite", running.epoch_real_s - epoch_utc_s, bare, halted)
    finally:
        for burner in burners:
            burner.kill()


if __name__ == "__main__":
    main()
