"""Cost of the LATSIS driver; run by hand: `python tests/benchmarks/bench_latsis.py [--seconds 30]`.

Prints the time per frame of parser and assembler, then what three lines with 302 sensors cost when their
bytes trickle in one at a time, at 9600 baud, over pseudo-terminals: share of one core, and how long after
the last byte was written the cycle was at hand. Nothing here passes or fails.
"""

import argparse
import asyncio
import os
import statistics
import subprocess
import sys
import threading
import time
import tty

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.clock import SystemClock
from drivers.contract import LinkError
from drivers.latsis.cycle import CycleAssembler
from drivers.latsis.frames import FrameParser, sum8
from drivers.latsis.source import LatsisSerialSource
from models.records import Instant

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


def main() -> None:
    if sys.argv[1:2] == ["--writer"]:
        write_lines(sys.argv[2], [int(text) for text in sys.argv[4:]], float(sys.argv[3]))
        return
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=float, default=30.0, help="length of the measurement per profile")
    seconds = arguments.parse_args().seconds
    for profile in ("bare", "checked"):
        bench_parser(profile)
    for profile in ("bare", "checked"):
        asyncio.run(bench_lines(profile, seconds))


if __name__ == "__main__":
    main()
