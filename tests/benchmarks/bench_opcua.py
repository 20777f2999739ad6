"""How long it takes to write a block of macros and read it back over OPC UA on this computer.

    python tests/benchmarks/bench_opcua.py [--writes 5000] [--busy]

Server and client are two processes, as in the field. --busy loads every core besides.
"""

import argparse
import asyncio
import gc
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np

SUPPORT = Path(__file__).resolve().parent.parent / "support"
sys.path.insert(0, str(SUPPORT))

from scripted_machine import GROUPS, Keys, cnc_config  # noqa: E402

from drivers.clock import SystemClock  # noqa: E402
from drivers.opcua.cnc import OpcUaCnc  # noqa: E402

BUSY = "while True: sum(range(1000))"


async def _measure(call: Callable[[], Awaitable[object]], count: int) -> str:
    for _ in range(100):
        await call()
    durations_ms = np.empty(count)
    for index in range(count):
        started_s = time.perf_counter()
        await call()
        durations_ms[index] = (time.perf_counter() - started_s) * 1e3
    quantiles = np.quantile(durations_ms, [0.5, 0.99, 0.999])
    return "p50 {:6.2f}  p99 {:6.2f}  p99.9 {:6.2f}  max {:6.2f} ms".format(*quantiles, durations_ms.max())


async def _bench(endpoint: str, keys: Keys | None, count: int) -> None:
    config = cnc_config(endpoint, security=keys.client_config() if keys else None)
    cnc = OpcUaCnc(config, SystemClock())
    started_s = time.perf_counter()
    await cnc.connect()
    print(f"  connect                    {(time.perf_counter() - started_s) * 1e3:6.1f} ms")
    gc.freeze()
    block = config.macros.block
    ours = tuple(number for group in GROUPS for number, _ in group)

    async def write_and_read_back() -> None:
        await cnc.write_macros(GROUPS)
        await cnc.read_macros(block)

    async def compare_write_and_read_back() -> None:
        await cnc.read_macros(ours)
        await write_and_read_back()

    print("  write 3 groups, read back ", await _measure(write_and_read_back, count))
    print("  the same, compared before ", await _measure(compare_write_and_read_back, count))
    print("  poll (state and block)    ", await _measure(lambda: cnc.read(block), count))
    await cnc.close()


def main() -> None:
    """Measure plain and with Basic256Sha256."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--writes", type=int, default=5000)
    parser.add_argument("--busy", action="store_true")
    arguments = parser.parse_args()
    loads = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(os.cpu_count() or 1) if arguments.busy]
    try:
        with tempfile.TemporaryDirectory() as directory:
            keys = Keys(Path(directory))
            for name, used in (("without security", None), ("Basic256Sha256, sign and encrypt, user name", keys)):
                command = [sys.executable, str(SUPPORT / "serve_cnc.py"), *([directory] if used else [])]
                with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
                    assert server.stdin is not None and server.stdout is not None
                    endpoint, start_s = server.stdout.readline().split()
                    print(f"{name} (server started in {start_s} s)")
                    asyncio.run(_bench(endpoint, used, arguments.writes))
                    server.stdin.close()
    finally:
        for load in loads:
            load.kill()
            load.wait()


if __name__ == "__main__":
    main()
