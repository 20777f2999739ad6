"""How long one run of the guard's text takes in the simulator's interpreter on this computer.

python tests/benchmarks/bench_guard.py [--runs 5000]
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "support"))

from guard_bench import GuardBench


def _measure(runs: int, prepare: Callable[[GuardBench, int], None]) -> str:
    bench = GuardBench()
    durations_us = np.empty(runs)
    for run in range(runs):
        prepare(bench, run)
        started_s = time.perf_counter()
        bench.call()
        durations_us[run] = (time.perf_counter() - started_s) * 1e6
    quantiles = np.quantile(durations_us, [0.5, 0.99])
    return "p50 {:6.1f}  p99 {:6.1f}  max {:7.1f} us".format(*quantiles, durations_us.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5000)
    runs = parser.parse_args().runs
    sign = (1.0, -1.0)
    print("three axes, all bits 0   ", _measure(runs, lambda bench, _: bench.write(enable=0.0)))
    print("three axes, nothing to do", _measure(runs, lambda bench, _: bench.write(x=1.0, y=1.0, z=1.0)))
    print(
        "three axes, each moved   ",
        _measure(runs, lambda bench, run: bench.write(**dict.fromkeys("xyz", 2.0 * sign[run % 2]))),
    )


if __name__ == "__main__":
    main()
