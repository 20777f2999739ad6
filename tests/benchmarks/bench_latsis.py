"""The LATSIS driver; run by hand: `python tests/benchmarks/bench_latsis.py [--seconds 30] [--frames 100000]`.

Prints the time per frame of parser and assembler, then what three lines with 302 sensors cost when their
bytes trickle in one at a time, at 9600 baud, over pseudo-terminals: share of one core, and how long after
the last byte was written the cycle was at hand. Last, frames with a checksum come late, twice, swapped, cut, with a
flipped bit or behind garbage, without a wire: it counts values that a sensor took from another one. Nothing here passes
or fails.
"""

import argparse
import asyncio
import gc
import os
import random
import statistics
import subprocess
import sys
import threading
import time
import tty
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "support"))

from latsis_line import Line, instant

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.clock import SystemClock
from drivers.contract import LinkError
from drivers.latsis.cycle import CycleAssembler
from drivers.latsis.frames import FrameParser, sum8
from drivers.latsis.source import LatsisSerialSource
from models.quality import Quality
from models.records import Instant
from models.units import TMP102_DEGC_PER_LSB

BAUD = 9600
PERIOD_S = 10.0
LINES = ((1, 132), (133, 102), (235, 68))
"""First sensor and count of each line: 302 sensors."""


def pass_bytes(profile: str, count: int) -> bytes:
    frames = []
    for wire_id in range(count, 0, -1):
        if profile == "bare":
            frames.append(b"%02X190\r\n" % wire_id)
        else:
            body = b"%03X,190,00" % wire_id
            frames.append(b":%b*%02X\r\n" % (body, sum8(body)))
    return b"".join(frames)


def line_config(index: int, profile: str, port: str) -> LineConfig:
    first, count = LINES[index]
    return LineConfig.model_validate(
        {"name": f"line{index + 1}", "port": port, "profile": profile, "chain": [f"{first}-{first + count - 1}"]}
    )


def sensors() -> list[SensorConfig]:
    return [SensorConfig(id=sensor_id, component="bench") for sensor_id in range(1, 303)]


def bench_parser(profile: str) -> None:
    line = line_config(0, profile, "none")
    data = pass_bytes(profile, LINES[0][1])
    passes = 200
    parser = FrameParser(line.frame_grammar, {})
    started_s = time.perf_counter()
    for _ in range(passes):
        parser.feed(data)
    parsed_s = time.perf_counter() - started_s
    assembler = CycleAssembler(line, sensors())
    started_s = time.perf_counter()
    for number in range(passes):
        at_s = number * PERIOD_S
        assembler.feed(data, Instant(monotonic_s=at_s, utc_s=at_s, real_s=at_s))
    assembled_s = time.perf_counter() - started_s
    frames = passes * LINES[0][1]
    print(
        f"{profile:8} parser {parsed_s / frames * 1e6:5.1f} us per frame, "
        f"with assembly of cycles {assembled_s / frames * 1e6:5.1f} us per frame"
    )


def write_lines(profile: str, masters: list[int], seconds: float) -> None:
    """Child process: write every line byte by byte at the baud rate; print when the last byte went out."""

    def write_line(index: int) -> None:
        data = pass_bytes(profile, LINES[index][1])
        begin_s = time.monotonic() + 0.5 + index * PERIOD_S / len(LINES)
        end_s = begin_s + seconds
        while begin_s < end_s:
            for at, byte in enumerate(data):
                time.sleep(max(0.0, begin_s + at * 10 / BAUD - time.monotonic()))
                if at == len(data) - 1:
                    print(f"line{index + 1} {time.monotonic():.6f}", flush=True)
                os.write(masters[index], bytes([byte]))
            begin_s += PERIOD_S

    threads = [threading.Thread(target=write_line, args=(index,)) for index in range(len(masters))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


async def follow(source: LatsisSerialSource, seen: dict[str, list[tuple[float, float]]]) -> None:
    try:
        async for cycle in source.cycles():
            seen[source.name].append((cycle.trace.last_byte.real_s, time.monotonic()))
    except LinkError as error:
        print(error)


async def bench_lines(profile: str, seconds: float) -> None:
    pairs = [os.openpty() for _ in LINES]
    for _, slave in pairs:
        tty.setraw(slave)
    masters = [master for master, _ in pairs]
    sources = [
        LatsisSerialSource(line_config(index, profile, os.ttyname(pairs[index][1])), sensors(), SystemClock())
        for index in range(len(LINES))
    ]
    seen: dict[str, list[tuple[float, float]]] = {source.name: [] for source in sources}
    tasks = [asyncio.create_task(follow(source, seen)) for source in sources]
    await asyncio.sleep(0.3)
    command = [sys.executable, "-P", __file__, "--writer", profile, str(seconds), *map(str, masters)]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, pass_fds=masters)
    cpu_s, wall_s = time.process_time(), time.monotonic()
    written = (await asyncio.to_thread(child.communicate))[0].decode().split("\n")
    await asyncio.sleep(0.2)
    cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - wall_s
    for source in sources:
        await source.close()
    await asyncio.gather(*tasks)
    report(profile, written, seen, cpu_s / wall_s)
    for master, slave in pairs:
        os.close(master)
        os.close(slave)


def report(profile: str, written: list[str], seen: dict[str, list[tuple[float, float]]], share: float) -> None:
    stamped_ms, delivered_ms = [], []
    for name, cycles in seen.items():
        sent_s = [float(row.split()[1]) for row in written if row.startswith(name)]
        for at_s, (stamp_s, delivery_s) in zip(sent_s, cycles, strict=True):
            stamped_ms.append((stamp_s - at_s) * 1e3)
            delivered_ms.append((delivery_s - at_s) * 1e3)
    print(
        f"{profile:8} 302 sensors per 10 s: {share * 100:.3f} % of one core; after the last byte was written: "
        f"stamped {statistics.mean(stamped_ms):.2f} ms (max {max(stamped_ms):.2f}), "
        f"delivered {statistics.mean(delivered_ms):.2f} ms (max {max(delivered_ms):.2f}), {len(stamped_ms)} cycles"
    )


KINDS = ("late", "twice", "swapped", "cut", "bits", "garbage", "lost")
NODES = 12
PASSES_TOLD = 16
"""A code tells the node and, among so many, the pass that it was measured in."""
FIRST_CODE = 0x140


class FrameFuzz:
    """A chain whose frames are disturbed; every value tells which node sent it, and in which pass."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._line = Line(NODES, profile="checked")
        self._passes = 0
        self._past: list[list[bytes]] = []
        self.frames = Counter[str]()
        self.taken = self.wrong = self.old = 0

    def one_pass(self) -> None:
        """Send one pass, a quarter of them undisturbed, and judge the cycles that it brings."""
        line, rng = self._line, self._random
        self._passes += 1
        told = self._passes % PASSES_TOLD
        sent = [
            line.frame(wire_id, FIRST_CODE + PASSES_TOLD * (wire_id - line.offset) + told, status=0)
            for wire_id in line.ids
        ]
        share = rng.choice((0.0, 0.05, 0.2, 0.5))
        cycles = []
        for frame in self._disturbed(sent, share):
            cycles += line.assembler.feed(frame, instant(line.at_s))
            line.at_s += len(frame) * 10 / BAUD
        cycles += line.rest()
        self._past = [*self._past[-3:], sent]
        for cycle in cycles:
            self._judge(cycle.degc, cycle.quality, told)

    def _disturbed(self, sent: list[bytes], share: float) -> list[bytes]:
        rng, out = self._random, list[bytes]()
        for place, frame in enumerate(sent):
            kind = rng.choice(KINDS) if rng.random() < share else "right"
            self.frames[kind] += 1
            if kind == "late" and self._past:
                out.append(rng.choice(rng.choice(self._past)))
            elif kind == "twice":
                out += [frame, frame]
            elif kind == "swapped" and out:
                out.insert(rng.randrange(len(out)), frame)
            elif kind == "cut":
                out.append(frame[: rng.randrange(len(frame))])
            elif kind == "bits":
                spoiled = bytearray(frame)
                spoiled[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
                out.append(bytes(spoiled))
            elif kind == "garbage":
                out += [rng.randbytes(rng.randrange(1, 20)), sent[rng.randrange(place + 1)][-4:], frame]
            elif kind != "lost":
                out.append(frame)
        return out

    def _judge(self, degc: np.ndarray, quality: np.ndarray, told: int) -> None:
        good = quality == Quality.GOOD
        codes = np.rint(degc[good] / TMP102_DEGC_PER_LSB).astype(int) - FIRST_CODE
        self.taken += len(codes)
        self.wrong += int((codes // PASSES_TOLD != np.flatnonzero(good) + 1).sum())
        self.old += int((codes % PASSES_TOLD != told).sum())


def resident_kb() -> float:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1024


def bench_frames(count: int, seed: int) -> None:
    fuzz = FrameFuzz(seed)
    for _ in range(200):
        fuzz.one_pass()
    before_kb, started_s = resident_kb(), time.process_time()
    while sum(fuzz.frames.values()) < count:
        fuzz.one_pass()
    used_s = time.process_time() - started_s
    print(f"{sum(fuzz.frames.values())} frames ({dict(fuzz.frames)}) in {used_s:.0f} s of a core")
    print(
        f"{fuzz.taken} values taken, {fuzz.wrong} of another sensor, {fuzz.old} of an earlier pass; memory grew by "
        f"{resident_kb() - before_kb:.0f} kB"
    )


def main() -> None:
    if sys.argv[1:2] == ["--writer"]:
        write_lines(sys.argv[2], [int(text) for text in sys.argv[4:]], float(sys.argv[3]))
        return
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=float, default=30.0, help="length of the measurement per profile, 0: none")
    arguments.add_argument("--frames", type=int, default=100_000, help="frames of the fuzz, 0: none")
    arguments.add_argument("--seed", type=int, default=1)
    options = arguments.parse_args()
    for profile in ("bare", "checked") if options.seconds else ():
        bench_parser(profile)
    for profile in ("bare", "checked") if options.seconds else ():
        asyncio.run(bench_lines(profile, options.seconds))
    if options.frames:
        bench_frames(options.frames, options.seed)


if __name__ == "__main__":
    main()
