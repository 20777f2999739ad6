"""What the history costs: size per machine-year, time to read, time taken from the event loop.

    python tests/benchmarks/bench_history.py [--hours 24] [--store FILE] [--noise-steps 1]

A day of a made-up machine goes through the writer itself: 302 sensors every 10 s on three lines with
noise of up to one step of 0.0625 degC either way, CNC samples at 2 Hz, an estimate and a macro write
per line cycle. Then it is packed and read. Sizes are extrapolated from whole packed hours.
"""

import argparse
import asyncio
import sqlite3
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "support"))

import history_records as make
from history_records import AXES, BLOCK, EPOCH_S, FULL, StillClock
from tidied_store import housekeeping

from config.schema.service import HistoryConfig
from daemon.history.database import connect_reader, connect_writer
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from models.records import Instant, Trace

YEAR_H = 8766.0
PERIOD_S = 10.0
LINE_TIMES_S = {"spindle": (0.0, 1.0), "saddle": (3.3, 0.5), "fixed": (6.1, 0.8)}
"""Start within the period and duration of each line's pass."""
LABELS = ("A", "B", "C", "D", "E", "F", "IR", "Room")
READ_SENSORS = (3, 50, 101, 131, 150, 199, 240, 302)
"""Eight sensors in eight different groups, on all three lines."""


class Day:
    """A machine that warms and cools, with the jitter of real clocks."""

    def __init__(self, hours: float, noise_steps: int) -> None:
        self.random = np.random.default_rng(42)
        self.noise_steps = noise_steps
        self.cycles = int(hours * 3600 / PERIOD_S)
        self._rise = 8.0 * self.random.random(302) ** 2
        self._room = self.random.uniform(0.3, 1.0, 302)
        self._weights = self.random.normal(0, 2.0, (5, 302)) / 20
        self._applied = np.zeros(3)
        self._sent = np.zeros(3)
        self.latest_degc = self.true_degc(0)

    def jitter_s(self, scale_s: float) -> float:
        return float(abs(self.random.normal(0, scale_s)))

    def true_degc(self, time_s: float) -> np.ndarray:
        load = 0.5 - 0.5 * np.cos(2 * np.pi * time_s / 28_800)
        room = 21.0 + 1.5 * np.sin(2 * np.pi * time_s / 86_400)
        return room * self._room + 21.0 * (1 - self._room) + self._rise * load

    def measured_degc(self, time_s: float) -> np.ndarray:
        steps = np.rint(self.true_degc(time_s) / 0.0625)
        return (steps + self.random.integers(-self.noise_steps, self.noise_steps + 1, 302)) * 0.0625

    def error_um(self, degc: np.ndarray) -> np.ndarray:
        # One-minute means leave a sixth of the variance of the sensors' noise.
        smooth = self.true_degc(0) + (degc - self.true_degc(0)) / np.sqrt(6)
        return self._weights @ (smooth - 21.0)

    def spindle_rpm(self, time_s: float) -> float:
        speed = (0, 6000, 12_000, 3000)[int(time_s // 240) % 4]
        return float(speed + (self.random.integers(-2, 3) if speed else 0))

    def send(self, request_um: np.ndarray) -> np.ndarray:
        """Bounded by a deadband, as the output is: full float64, but often unchanged."""
        moved = np.abs(request_um - self._sent) > 0.1
        self._sent = np.where(moved, request_um, self._sent)
        return self._sent

    def applied_um(self, time_s: float) -> np.ndarray:
        """Taken over at a safe point every two minutes."""
        if time_s % 120 < PERIOD_S:
            self._applied = self._sent.copy()
        return self._applied


def moment(utc_s: float, real_s: float | None = None) -> Instant:
    machine = make.instant(utc_s)
    return Instant(monotonic_s=machine.monotonic_s, utc_s=utc_s, real_s=machine.real_s if real_s is None else real_s)


def trace_of(day: Day, first_s: float, duration_s: float) -> Trace:
    last = moment(first_s + duration_s)
    delays_s = np.cumsum([0.0003, 0.0005, 0.0025, 0.0015] * day.random.lognormal(0, 0.3, 4))
    stages = [moment(last.utc_s + d, last.real_s + d) for d in delays_s]
    names = ("cleansed", "estimated", "written", "read_back")
    return Trace(first_byte=moment(first_s), last_byte=last, **dict(zip(names, stages, strict=True)))


def write_period(writer: HistoryWriter, clock: StillClock, day: Day, index: int) -> None:
    """Ten seconds of everything."""
    start_s = EPOCH_S + index * PERIOD_S
    for k in range(20):
        time_s = start_s + 0.5 * k + 0.001 + day.jitter_s(0.0015)
        writer.cnc_sample(
            make.cnc_sample(
                time_s,
                sequence_number=10 * (int(time_s / 2.7) % 400),
                spindle_speed_rpm=day.spindle_rpm(time_s - EPOCH_S),
                motor_temperature_degc=round(float(day.true_degc(time_s - EPOCH_S)[0]) + 10.0, 1),
                clock_s=round(time_s - EPOCH_S + 77.0 - day.jitter_s(0.001), 3),
                macros=dict(
                    zip(
                        (600, 601, 602, 603, 604, 605),
                        (*day.applied_um(time_s - EPOCH_S) / 1000, start_s // 120, 0.0, 3.0),
                        strict=True,
                    )
                ),
            )
        )
    for number, (line, (offset_s, duration_s)) in enumerate(LINE_TIMES_S.items()):
        write_line(writer, clock, day, 3 * index + number, line, start_s + offset_s + day.jitter_s(0.003), duration_s)
    if index % 6 == 0:
        writer.displacement(make.displacement(start_s, np.round(day.random.normal(0, 10, 5), 2)))


def write_line(
    writer: HistoryWriter, clock: StillClock, day: Day, count: int, line: str, first_s: float, duration_s: float
) -> None:
    """One line's cycle, its estimate and its write."""
    position = FULL.line_positions[line]
    degc = day.latest_degc
    degc[position] = day.measured_degc(first_s - EPOCH_S)[position]
    trace = trace_of(day, first_s, duration_s + day.jitter_s(0.002))
    writer.temperatures(None, make.cycle(line, count // 3 + 1, first_s, degc[position], trace=trace))
    error_um = day.error_um(degc)
    labels = {label: float(degc[40 * k : 40 * k + 7].mean()) for k, label in enumerate(LABELS)}
    writer.estimate(
        make.estimate(
            first_s,
            error_um,
            line=line,
            channels=FULL.displacement_channels,
            band_um=np.full(5, 2.5),
            label_degc=labels,
            label_increment_degc={label: value - 21.0 for label, value in labels.items()},
            confidence=1.0,
            imputed=(),
            trace=trace,
        )
    )
    sent_um = day.send(-error_um[:3])
    sequence = float(count % 999_999 + 1)
    bits_and_time = (round(first_s - EPOCH_S + 107.0, 3), 7.0)
    written = tuple(zip(BLOCK, (sequence, *(sent_um / 1000).tolist(), *bits_and_time, sequence), strict=True))
    clock.utc_s = first_s + duration_s
    command = make.command(sent_um, requested_um=-error_um[:3], limits_hit=(), enable=(True,) * len(AXES))
    write_id = writer.write_intent(command, written, "cycle")
    receipt = make.receipt(first_s, written, applied_um=day.applied_um(first_s - EPOCH_S), trace=trace)
    writer.write_outcome(write_id, receipt)


def fill(path: Path, hours: float, noise_steps: int) -> None:
    clock, day = StillClock(), Day(hours, noise_steps)
    writer = HistoryWriter(path, clock=clock, machine=FULL, queue_limit=10**7, on_problem=print)
    writer.start()
    started_s = time.perf_counter()
    for index in range(day.cycles):
        write_period(writer, clock, day, index)
        if index % 60 == 0:
            writer.submit(lambda _: None).result()
    writer.close()
    elapsed_s = time.perf_counter() - started_s
    share = elapsed_s / hours / 36
    print(f"written    {hours:g} h in {elapsed_s:.1f} s: {share:.2f} % of real time, making the records included")


def sizes(path: Path) -> Iterator[tuple[str, float, int]]:
    """Yield kind, hours packed and bytes."""
    with closing(connect_reader(path)) as connection:
        yield from connection.execute(
            "SELECT kind, count(DISTINCT start_ms / 3600000), sum(length(data)) FROM chunks GROUP BY kind ORDER BY kind"
        )


def report_sizes(path: Path) -> None:
    total = 0.0
    for kind, hours, size in sizes(path):
        year_gb = size / hours * YEAR_H / 1e9
        total += year_gb
        print(f"size       {kind:14s} {size / hours / 1024:8.1f} KiB/h   {year_gb:.3f} GB per machine-year")
    (hours,) = {hours for kind, hours, _ in sizes(path) if kind == "temperatures"}
    empty = path.with_name("empty.sqlite")
    connect_writer(empty).close()
    grown = file_size(path) - file_size(empty)
    empty.unlink()
    file_gb = grown / hours * YEAR_H / 1e9
    print(
        f"size       all chunks {total:.3f} GB; with pages and indices {file_gb:.3f} GB per machine-year (at most 0.8)"
    )


def file_size(path: Path) -> int:
    """Size without free pages."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("VACUUM")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return path.stat().st_size


def report_reading(path: Path, hours: float, name: str) -> None:
    to_s = EPOCH_S + hours * 3600
    durations_ms = []
    for _ in range(25):
        started_s = time.perf_counter()
        with HistoryReader(path) as reader:
            found = reader.temperatures(READ_SENSORS, to_s - 86_400, to_s)
        durations_ms.append((time.perf_counter() - started_s) * 1e3)
    p50, p90 = np.quantile(durations_ms, [0.5, 0.9])
    span = f"{min(hours, 24):g} h of 8 sensors, {found.time_s.size} cycles"
    print(f"reading    {span}, {name}: p50 {p50:.1f}  p90 {p90:.1f} ms (at most 50)")


async def loop_delays_ms(seconds: float) -> np.ndarray:
    """How late the loop wakes after sleeping 2 ms."""
    delays = []
    end_s = time.perf_counter() + seconds
    while (started_s := time.perf_counter()) < end_s:
        await asyncio.sleep(0.002)
        delays.append((time.perf_counter() - started_s - 0.002) * 1e3)
    return np.array(delays)


async def report_loop(folder: Path, seconds: float) -> None:
    """The loop alone; with the writer at ten times the real rate; and with packing beside it."""
    clock, day = StillClock(), Day(24, 1)
    path = folder / "loop.sqlite"
    writer = HistoryWriter(path, clock=clock, machine=FULL, on_problem=print)
    writer.start()
    for index in range(360):
        write_period(writer, clock, day, index)
    await writer.flushed()

    async def measure(name: str) -> None:
        p50, p99, p999 = np.quantile(await loop_delays_ms(seconds), [0.5, 0.99, 0.999])
        print(f"loop       {name:42s} late by p50 {p50:.2f}  p99 {p99:.2f}  p99.9 {p999:.2f} ms")

    await measure("alone")
    writer_only = asyncio.create_task(trickle(writer, clock, day))
    await measure("records at ten times the real rate")
    writer_only.cancel()
    clock.utc_s = EPOCH_S + 86_400
    packing = asyncio.create_task(writer.request_housekeeping(HistoryConfig()))
    await measure("packing an hour meanwhile")
    print(f"           {await packing}")
    await asyncio.to_thread(writer.close)


async def trickle(writer: HistoryWriter, clock: StillClock, day: Day) -> None:
    """Put one line's records every third of a second, the CNC's every 50 ms; making them costs the loop little."""
    for count in range(10**6):
        time_s = EPOCH_S + 3600 + count * 0.5
        writer.cnc_sample(make.cnc_sample(time_s))
        if count % 7 == 0:
            write_line(writer, clock, day, count, list(LINE_TIMES_S)[count // 7 % 3], time_s, 1.0)
        await asyncio.sleep(0.05)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=int, default=24)
    parser.add_argument("--store", type=Path, default=None)
    parser.add_argument("--noise-steps", type=int, default=1)
    parser.add_argument("--loop-seconds", type=float, default=10.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = options.store or Path(folder) / "history.sqlite"
        fill(path, options.hours, options.noise_steps)
        report_reading(path, options.hours, "raw")
        end_s = EPOCH_S + options.hours * 3600
        started_s, cpu_s = time.perf_counter(), time.process_time()
        housekeeping(path, HistoryConfig(pack_after_s=7200.0), end_s)
        hours = options.hours - 2
        elapsed = (time.perf_counter() - started_s) / hours, (time.process_time() - cpu_s) / hours
        print(f"packing    {elapsed[0] * 1e3:.0f} ms per hour of records ({elapsed[1] * 1e3:.0f} ms of processor)")
        report_reading(path, options.hours, "packed, the last two hours raw")
        housekeeping(path, HistoryConfig(pack_after_s=1.0), end_s + 1.0)
        report_reading(path, options.hours, "all packed")
        report_sizes(path)
        asyncio.run(report_loop(Path(folder), options.loop_seconds))


if __name__ == "__main__":
    main()
