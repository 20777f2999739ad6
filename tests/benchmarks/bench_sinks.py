"""What a sink costs: sending a day of a full machine, the room that it takes there, and the sender that only waits.

python tests/benchmarks/bench_sinks.py [--hours 24] [--waiting-s 20] [--noise-k 0.04] [--only mqtt]
python tests/benchmarks/bench_sinks.py --only parquet --temperatures-only [--simulated]

A machine of 302 sensors on three lines every 10 s, a poll of the CNC every second, an estimate, a write and
displacements every 10 s. PostgreSQL is a server of its own on this computer, and so is mosquitto, whose own client
subscribes to everything.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import history_records as make
import numpy as np
from history_records import EPOCH_S, FULL, StillClock
from mosquitto import mosquitto
from postgresql import PASSWORD, Server, postgresql
from tidied_store import housekeeping

from config.loader import load_configuration
from config.machines import shipped_file
from config.schema.service import HistoryConfig
from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor
from daemon.history.writer import HistoryWriter
from daemon.sinks.running import SinkRunner
from drivers.sim.machine.body import MachineBody
from drivers.sim.machine.day import Day
from drivers.sim.nc.program import demo_program

MIDNIGHT_S = EPOCH_S - EPOCH_S % 86_400.0


def processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


Degc = Callable[[int, str], np.ndarray]
"""Temperatures of a cycle's number and a line."""


def warming_up(noise_k: float) -> Degc:
    """A machine that warms up, with sensors of 1/16 K."""
    random = np.random.default_rng(1)

    def degc(k: int, line: str) -> np.ndarray:
        members = len(FULL.lines[line])
        warm = 20.0 + 10.0 * (1.0 - np.exp(-k / 1000.0)) * np.linspace(0.2, 1.0, members)
        return np.round((warm + random.normal(0.0, noise_k, members)) / 0.0625) * 0.0625

    return degc


def simulated_day(hours: float) -> Degc:
    """A day of the simulated machine, whose sensors have 0.02 K and 0.03 K of noise, from a cold start."""
    sensors = load_configuration(shipped_file("cfrpmt.yaml")).temperatures.sensors
    body = MachineBody(Day.draw(3, start="cold"), demo_program(), sensors, machine_seed=3)
    rows = []
    for k in range(int(hours * 360)):
        body.advance(10.0 * k, leaving=lambda _segment: None, entered=lambda: None)
        rows.append(body.sensors.degc(body.register_codes()))
    return lambda k, line: rows[k][[sensor_id - 1 for sensor_id in FULL.lines[line]]]


def fill(store: Path, hours: float, degc_of: Degc, *, temperatures_only: bool) -> None:
    random = np.random.default_rng(2)
    writer = HistoryWriter(store, clock=StillClock(), machine=FULL)
    writer.start()
    with closing(writer):
        for k in range(int(hours * 360)):
            now_s = MIDNIGHT_S + 10.0 * k
            writer._clock.utc_s = now_s
            for line in FULL.lines:
                first_s = round(now_s + random.normal(0.0, 0.004), 3)
                writer.temperatures(None, make.cycle(line, k + 1, first_s, degc_of(k, line)))
            if temperatures_only:
                continue
            for second in range(10):
                writer.cnc_sample(make.cnc_sample(now_s + second, macros={600: k / 1e3, 601: k / 2e3, 602: 0.0}))
            um = np.round(random.normal(0.0, 0.1, 3) + k / 100.0, 3)
            writer.estimate(make.estimate(now_s + 2.0, um))
            written = make.macros(k + 1, um)
            write_id = writer.write_intent(make.command(um), written, "cycle")
            writer.write_outcome(write_id, make.receipt(now_s, written))
            writer.displacement(make.displacement(now_s, np.round(random.normal(0.0, 1.0, 5), 2)))
            if k % 500 == 499:
                writer.event("note", "filling").result(60.0)
    housekeeping(store, HistoryConfig(), MIDNIGHT_S + hours * 3600.0)


def send(config: SinkConfig, store: Path, wait: Callable[[threading.Event], Callable[[float], object]]) -> Cursor:
    stop = threading.Event()
    runner = SinkRunner(config, store, "mill", stop, wait=wait(stop))
    runner.run()
    assert runner.cursor.problem == "", runner.cursor.problem
    return runner.cursor


def into_postgresql(server: Server, store: Path, folder: Path, hours: float, waiting_s: float) -> None:
    (folder / "password").write_text(PASSWORD)
    (folder / "password").chmod(0o600)
    there = {"host": "127.0.0.1", "port": server.port, "tls": False, "password_file": folder / "password"}
    config = SinkConfig.model_validate({"name": "plant", "driver": "postgresql", "postgresql": there})
    began_s, used_s = time.monotonic(), processor_s()
    cursor = send(config, store, lambda stop: lambda _duration_s: stop.set())
    took_s, used_s = time.monotonic() - began_s, processor_s() - used_s
    print(
        f"sent {cursor.sent_rows} rows of {hours:g} h in {took_s:.1f} s, {used_s:.1f} s of processor time of the sender"
    )
    print(f"  that is {took_s / hours / 36.0:.2f} % of the time in which they were recorded")
    with server.connection() as connection:
        connection.execute("VACUUM (ANALYZE)")
    (size,) = server.ask(
        "SELECT sum(pg_total_relation_size(c.oid))::bigint FROM pg_class AS c JOIN pg_namespace AS n "
        "ON n.oid = c.relnamespace WHERE n.nspname = 'toolpoint' AND c.relkind = 'r'"
    )[0]
    print(f"  {size / 2**20:.1f} MiB in the database with its indexes, {size * 8766 / hours / 2**30:.1f} GiB per year")
    print_waiting(config, store, waiting_s)


def print_waiting(config: SinkConfig, store: Path, waiting_s: float) -> None:
    """Print what a sender costs that has nothing to send."""
    used_s, began_s = processor_s(), time.monotonic()

    def waiting(stop: threading.Event) -> Callable[[float], object]:
        def wait(duration_s: float) -> None:
            if time.monotonic() - began_s > waiting_s:
                stop.set()
            time.sleep(duration_s)

        return wait

    send(config, store, waiting)
    took_s = time.monotonic() - began_s
    print(f"with nothing to send: {(processor_s() - used_s) / took_s:.2%} of a core over {took_s:.0f} s")
    print(f"  most memory of this process, with NumPy and the bench: {resource.getrusage(0).ru_maxrss / 1024:.0f} MiB")


def to_broker(driver: str, store: Path, folder: Path, hours: float, waiting_s: float) -> None:
    (folder / driver).mkdir()
    with (
        mosquitto(folder / driver, "allow_anonymous true", "max_queued_messages 0") as port,
        counting(port, "#", folder / driver / "heard") as heard,
    ):
        there = {"host": "127.0.0.1", "port": port, "tls": False, "resend_s": 0.0, "timeout_s": 60.0}
        config = SinkConfig.model_validate({"name": driver, "driver": driver, driver: there})
        began_s, used_s = time.monotonic(), processor_s()
        cursor = send(config, store, lambda stop: lambda _duration_s: stop.set())
        took_s, used_s = time.monotonic() - began_s, processor_s() - used_s
        print(f"{driver}: sent {cursor.sent_rows} rows of {hours:g} h in {took_s:.1f} s, {used_s:.1f} s used")
        print(f"  {heard() / 2**20:.1f} MiB arrived with their topics")
        print_waiting(config, store, waiting_s)


@contextmanager
def counting(port: int, topic: str, path: Path) -> Iterator[Callable[[], int]]:
    """Let mosquitto's own client write to a file what comes; yields what tells its bytes once no more come."""
    command = ["mosquitto_sub", "-h", "127.0.0.1", "-p", str(port), "-V", "mqttv5", "-q", "1", "-t", topic, "-v"]
    with path.open("wb") as file, subprocess.Popen(command, stdout=file) as process:
        time.sleep(2.0)

        def size() -> int:
            before = -1
            while before != (before := path.stat().st_size):
                time.sleep(2.0)
            return before

        yield size
        process.kill()


def into_files(store: Path, folder: Path, hours: float) -> None:
    """Sizes are of temperatures, which are most of it."""
    (folder / "files").mkdir()
    section = {"name": "files", "driver": "parquet", "parquet": {"folder": str(folder / "files")}}
    used_s = processor_s()
    cursor = send(SinkConfig.model_validate(section), store, lambda stop: lambda _duration_s: stop.set())
    used_s = processor_s() - used_s
    made = sorted((folder / "files").rglob("*.parquet"))
    size = sum(path.stat().st_size for path in made)
    whole = [path.stat().st_size for path in made if path.parts[-3] == "temperatures"]
    print(f"{len(made)} Parquet files of {cursor.sent_rows} rows, {size / 2**20:.2f} MiB, {used_s:.1f} s used")
    day = max(whole) * 24.0 / min(hours, 24.0)
    print(f"  temperatures: {day / 1e6:.2f} MB a day, {day * 365.25 / 1e9:.2f} GB per machine-year")
    print(f"  most memory of this process: {resource.getrusage(0).ru_maxrss / 1024:.0f} MiB")


IN_THE_DAEMON = """
import pathlib, sys, time
import daemon.app
def kib(): return 4 * int(pathlib.Path("/proc/self/statm").read_text().split()[1])
before = kib()
import daemon.sinks.watching
from daemon.history.cursors import Cursor, cursor_path
more, path, used_s = kib() - before, cursor_path(pathlib.Path(sys.argv[1]), "plant"), time.process_time()
for _ in range(1000):
    assert Cursor.read(path) is not None
used_s = (time.process_time() - used_s) / 1000
print(f"in the daemon: {more} KiB more, {used_s * 1e6:.0f} us of processor time every 10 s")
"""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--waiting-s", type=float, default=20.0)
    parser.add_argument("--noise-k", type=float, default=0.04, help="of a reading, before it is rounded to 1/16 K")
    parser.add_argument("--simulated", action="store_true", help="temperatures of the simulated machine")
    parser.add_argument("--temperatures-only", action="store_true", help="no other kind of record")
    parser.add_argument("--only", choices=("postgresql", "parquet", "mqtt", "sparkplug"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store = folder / "history.sqlite"
        degc_of = simulated_day(given.hours) if given.simulated else warming_up(given.noise_k)
        fill(store, given.hours, degc_of, temperatures_only=given.temperatures_only)
        print(f"store: {store.stat().st_size / 2**20:.1f} MiB for {given.hours:g} h")
        if given.only in (None, "postgresql"):
            with postgresql() as server:
                into_postgresql(server, store, folder, given.hours, given.waiting_s)
            subprocess.run([sys.executable, "-c", IN_THE_DAEMON, str(store)], check=True)
        if given.only in (None, "parquet"):
            into_files(store, folder, given.hours)
        for driver in ("mqtt", "sparkplug"):
            if given.only in (None, driver):
                to_broker(driver, store, folder, given.hours, given.waiting_s)


if __name__ == "__main__":
    main()
