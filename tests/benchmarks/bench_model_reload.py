"""How long the event loop is held up while a released model is loaded: in the loop, in a thread, in another process.

    python tests/benchmarks/bench_model_reload.py [--rounds 5]

Trains a model of the default family on 302 sensors of the simulated machine (a file of some 11 MB), loads it each
way beside a loop that looks at its clock every half millisecond, and prints the longest time between two looks and
how long the loading took. The row "nothing" is the same loop with nothing beside it.
"""

import argparse
import asyncio
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from config.loader import load_configuration
from config.machines import shipped_file
from config.schema import Configuration
from daemon.cli.operate.run import THREAD_TURN_S
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import load_released
from daemon.model_release.reload import load_beside
from daemon.simulation.simulated_model import published_sensors, simulated_recording, training_programmes
from models.thermal.training.train_family import train_family

LOOK_S = 0.0005


def configured(folder: Path) -> Configuration:
    """Return the published machine with a model of all its sensors."""
    programmes, sensors = training_programmes(), list(published_sensors())
    recordings = [simulated_recording(seed, programmes[seed - 1], sensors, hours=6.0) for seed in (1, 2, 3)]
    model = train_family(recordings, "default", sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    path = folder / "model.json"
    path.write_text(model.to_json(), encoding="utf-8")
    print(f"a model of {len(model.sensor_ids)} sensors, {path.stat().st_size / 1e6:.1f} MB")
    found = load_configuration(shipped_file("cfrpmt.yaml"))
    axes = {name: axis.model_copy(update={"estimate": None}) for name, axis in found.compensation.axes.items()}
    changes = {"model_file": path, "allow_writable_model_directory": True, "axes": axes}
    return found.model_copy(update={"compensation": found.compensation.model_copy(update=changes)})


async def held_up(work: Callable[[], Awaitable[Any]]) -> tuple[float, float]:
    """Return the longest hold-up of the loop while work is done, and how long that took [s]."""
    longest_s, done = 0.0, False

    async def look() -> None:
        nonlocal longest_s
        last_s = time.perf_counter()
        while not done:
            await asyncio.sleep(LOOK_S)
            now_s = time.perf_counter()
            longest_s, last_s = max(longest_s, now_s - last_s - LOOK_S), now_s

    looking = asyncio.create_task(look())
    await asyncio.sleep(10 * LOOK_S)
    began_s = time.perf_counter()
    found = await work()
    took_s = time.perf_counter() - began_s
    await asyncio.sleep(10 * LOOK_S)
    done = True
    await looking
    assert found is None or found.model is not None, found.inhibit
    return longest_s, took_s


async def measure(configuration: Configuration, rounds: int) -> None:
    account = own_account()

    async def in_the_loop() -> Any:
        return load_released(configuration, account)

    ways: dict[str, Callable[[], Awaitable[Any]]] = {
        "in the loop": in_the_loop,
        "in a thread": lambda: asyncio.to_thread(load_released, configuration, account),
        "in a process beside": lambda: load_beside(configuration),
        "nothing": lambda: asyncio.sleep(1.0),
    }
    print(f"{'':20} {'longest hold-up, median':>24} {'worst':>8} {'loading':>8}   of {rounds} rounds [ms]")
    for name, work in ways.items():
        results = [await held_up(work) for _ in range(rounds)]
        stalls_ms = sorted(1e3 * stall_s for stall_s, _ in results)
        took_ms = sorted(1e3 * took_s for _, took_s in results)
        print(f"{name:20} {stalls_ms[rounds // 2]:24.1f} {stalls_ms[-1]:8.1f} {took_ms[rounds // 2]:8.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    sys.setswitchinterval(THREAD_TURN_S)
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(measure(configured(Path(folder)), rounds))


if __name__ == "__main__":
    main()
