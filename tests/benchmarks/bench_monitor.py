"""What the monitor costs and how fast it answers.

    python tests/benchmarks/bench_monitor.py series             a year of one sensor, a day of eight
    python tests/benchmarks/bench_monitor.py viewer [--minutes 4] [--period 0.5]

`series` makes a store with a year of packed hours of the published machine (302 sensors on three lines) and a day of
cycles, and times the queries of the API with their JSON. `viewer` runs the demo's daemon at speed 1; in turns of ten
seconds nobody, one page or fifty pages follow the events, or a thousand connections begin a request and do not end it,
so that all are measured in one run on the same computer. Prints feedback percentiles and processor time of the daemon,
each beside those with nobody, the age of what the viewers got, and memory.
"""

import argparse
import asyncio
import json
import resource
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import numpy as np
import psutil
from tidied_store import housekeeping

from config.loader import load_configuration
from config.machines import shipped_file
from daemon.cli.simulate.demo import demo_machine
from daemon.history.columns.packing import temperature_extremes
from daemon.history.columns.temperature_chunks import CycleBlock
from daemon.history.decimation import SeriesReader, decimated
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.monitor.web.recorded import encoded, series_document
from daemon.simulation.demonstration import switch_on
from daemon.simulation.processes import free_port, start_simulation, write_simulation_configuration
from drivers.clock import SystemClock
from models.records import Instant, TemperatureCycle, Trace

HOUR_S = 3600.0
YEAR_HOURS = 8760
TURN_S = 10.0
Feedback = Callable[[float, float], list[float]]
"""Delays [s] of the cycles between two times of the machine."""


def cycle(line: str, number: int, time_s: float, degc: np.ndarray) -> TemperatureCycle:
    now = Instant(monotonic_s=time_s, utc_s=time_s, real_s=time_s)
    codes = np.zeros(degc.size, dtype=np.uint8)
    trace = Trace(first_byte=now, last_byte=now)
    return TemperatureCycle(
        line=line, number=number, degc=degc, quality=codes, reason=codes.copy(), complete=True, trace=trace
    )


def make_store(path: Path, end_s: float) -> None:
    """Write a day of cycles every 10 s, and the extremes of the year before it."""
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    layout = MachineLayout.from_configuration(configuration)
    rng = np.random.default_rng(1)
    writer = HistoryWriter(path, clock=SystemClock(), machine=layout)
    writer.start()
    for number, time_s in enumerate(np.arange(end_s - 86400.0, end_s, 10.0).tolist()):
        for line, ids in layout.lines.items():
            writer.temperatures(None, cycle(line, number, time_s, 20.0 + rng.integers(0, 80, len(ids)) / 16.0))
        while writer.waiting > 5000:
            time.sleep(0.05)
    writer.close()
    housekeeping(path, configuration.history, end_s + 3.0 * HOUR_S)
    with closing(sqlite3.connect(path)) as connection:
        layouts = connection.execute("SELECT layout_id, members FROM layouts WHERE kind = 'line'").fetchall()
        first_ms = int((end_s - 86400.0) // HOUR_S) * 3_600_000 - YEAR_HOURS * 3_600_000
        for layout_id, members in layouts:
            counts = rng.integers(3200, 4800, (6, len(json.loads(members)))).astype(np.int16)
            codes = np.zeros(counts.shape, dtype=np.uint8)
            data = temperature_extremes(CycleBlock(cycles=None, counts=counts, quality=codes, reason=codes))  # type: ignore[arg-type]
            rows = []
            for hour in range(YEAR_HOURS):
                hour_ms = first_ms + hour * 3_600_000
                rows.append(("temperatures", layout_id, hour_ms, hour_ms, hour_ms, 360, b"", hour))
            connection.executemany(
                "INSERT INTO chunks (kind, layout_id, start_ms, end_ms, row_count, data) VALUES (?, ?, ?, ?, ?, ?)",
                [row[:2] + (row[2], row[3] + 3_599_000, row[5], row[6]) for row in rows],
            )
            connection.execute(
                "INSERT INTO extremes SELECT kind, layout_id, start_ms, chunk_id, ? FROM chunks "
                "WHERE layout_id = ? AND length(data) = 0",
                (data, layout_id),
            )
        connection.commit()
        size = connection.execute("SELECT sum(length(data)) FROM extremes").fetchone()[0]
    print(f"extremes of a year and a day of {len(layout.sensor_ids)} sensors: {size / 1e6:.1f} MB")


def series() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path, end_s = Path(folder) / "history.sqlite", time.time()
        make_store(path, end_s)
        for words, names, span_s in (
            ("a year of one sensor", ["temperature.1"], 365.0 * 86400.0),
            ("24 h of eight sensors", [f"temperature.{i}" for i in (1, 20, 60, 100, 140, 200, 250, 300)], 86400.0),
        ):
            took, used = [], []
            for _ in range(5):
                begun, cpu = time.perf_counter(), time.process_time()
                with SeriesReader(path) as reader:
                    found = decimated(reader, names, end_s - span_s, end_s, 800)
                text = encoded({name: series_document(each) for name, each in found.items()}, packed=True)
                took.append(time.perf_counter() - begun)
                used.append(time.process_time() - cpu)
            points = [each.t.size for each in found.values()]
            print(
                f"{words}: {min(took) * 1e3:.0f} ms at best, {max(took) * 1e3:.0f} ms at worst, "
                f"{min(used) * 1e3:.0f} ms of processor time; {min(points)} points each, {len(text) / 1e3:.0f} kB"
            )


async def follow(port: int, ages_s: list[float], ahead_s: float) -> None:
    """Follow the events as a page does; note how old each status has become when the next is here."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 20)
    shown_s = None
    try:
        writer.write(b"GET /api/v1/events?temperatures=1 HTTP/1.1\r\nHost: localhost\r\n\r\n")
        while line := await reader.readline():
            if line.startswith(b'data: {"machine"'):
                if shown_s is not None:
                    ages_s.append(time.time() - ahead_s - shown_s)
                shown_s = json.loads(line[6:])["time"]
    finally:
        writer.transport.abort()


async def half_request(port: int) -> None:
    """Begin a request that never ends, until the daemon ends the connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(b"GET /api/v1/status HTTP/1.1\r\nHost: local")
        await reader.read()
    except ConnectionError:
        pass
    finally:
        writer.transport.abort()


@dataclass
class Turn:
    """What was measured while so many looked."""

    words: str
    viewers: int = 0
    half_requests: int = 0
    delays_s: list[float] = field(default_factory=list)
    cores: list[float] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)

    @property
    def p99_s(self) -> float:
        return float(np.percentile(self.delays_s, 99)) if self.delays_s else float("nan")

    def in_words(self, nobody: "Turn") -> str:
        median_ms = 1e3 * float(np.median(self.delays_s)) if self.delays_s else float("nan")
        times, cores = self.p99_s / nobody.p99_s, 100.0 * float(np.mean(self.cores))
        words = f"{self.words}: {len(self.delays_s)} cycles, feedback median {median_ms:.2f} ms, "
        words += f"p99 {1e3 * self.p99_s:.2f} ms ({times:.2f} times that of nobody); daemon {cores:.2f} % of a core "
        words += f"({cores - 100.0 * float(np.mean(nobody.cores)):+.2f})"
        if self.ages_s:
            age_s = np.array(self.ages_s)
            words += f"; status at most {age_s.max():.2f} s old, p99 {np.percentile(age_s, 99):.2f} s"
        return words


async def turns(port: int, process: psutil.Process, feedback: Feedback, minutes: float, ahead_s: float) -> None:
    kinds = [
        Turn("nobody"),
        Turn("1 viewer", viewers=1),
        Turn("50 viewers", viewers=50),
        Turn("1000 half requests", half_requests=1000),
    ]
    until_s = time.monotonic() + 60.0 * minutes
    while time.monotonic() < until_s:
        for turn in kinds:
            others = [asyncio.create_task(follow(port, turn.ages_s, ahead_s)) for _ in range(turn.viewers)]
            others += [asyncio.create_task(half_request(port)) for _ in range(turn.half_requests)]
            await asyncio.sleep(1.0)
            begin_s, used = time.time(), process.cpu_times()
            await asyncio.sleep(TURN_S)
            after, end_s = process.cpu_times(), time.time()
            turn.cores.append((after.user + after.system - used.user - used.system) / (end_s - begin_s))
            turn.delays_s += feedback(begin_s - ahead_s, end_s - ahead_s)
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)
    for turn in kinds:
        print(turn.in_words(kinds[0]))
    print(f"memory of the daemon: {process.memory_info().rss / 2**20:.1f} MiB")


def viewer(minutes: float, period_s: float) -> None:
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    content = demo_machine()
    for line in content["temperatures"]["lines"]:
        line["cycle_period_s"] = period_s
        line["baud"] = 115200
    content["compensation"]["reference"]["mean_s"] = 60.0 * period_s / 10.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, configuration = write_simulation_configuration(content, folder, speed=1.0, http_port=free_port())
        with start_simulation([], path, speed=1.0, epoch_utc_s=time.time(), directory=folder) as running:
            switch_on(running)
            time.sleep(30.0)
            running.client.ask("reference")
            process = psutil.Process(running.daemon.pid)

            def feedback(from_s: float, to_s: float) -> list[float]:
                with SeriesReader(configuration.history.path) as reader:
                    writes = reader.writes(from_s, to_s)
                return [each.delay_s["read_back"] for each in writes if "read_back" in each.delay_s]

            port = configuration.service.http_port
            assert port is not None
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # for the connections of this process
            ahead_s = time.time() - running.client.ask("status")["time_utc_s"]
            asyncio.run(turns(port, process, feedback, minutes, ahead_s))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("series", "viewer"))
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--period", type=float, default=0.5)
    given = parser.parse_args()
    if given.what == "series":
        series()
    else:
        viewer(given.minutes, given.period)


if __name__ == "__main__":
    main()
