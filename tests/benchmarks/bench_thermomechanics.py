"""What a new set of temperatures costs: bearing properties, tool-point response at 2817 frequencies, the resonance.

    python tests/benchmarks/bench_thermomechanics.py [--repeat 300]

One thread; processor time beside the clock's, as other processes may run beside. The temperatures drift by 0.01 K from
cycle to cycle. `flagged`: a property stands at its bound, and both ends of its range are looked at whenever the
resonance has moved by half a hertz; `jump`: temperatures 4 K away in one cycle.
"""

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable

import numpy as np

from config.machine.published_bearings import published_model
from config.machine.spindle import spindle_folder
from config.machine.spindle_chain import read_spindle
from models.thermomechanics.tool_point import AxisTracker, source_frequencies

STILL = {4.0: np.zeros(4), 10.0: np.zeros(4)}


def timed(what: str, call: Callable[[int], object], repeat: int) -> None:
    """Print percentiles of the time by the clock and by the processor [ms]."""
    wall, busy = [], []
    for k in range(repeat):
        start, used = time.perf_counter(), time.thread_time()
        call(k)
        wall.append(time.perf_counter() - start)
        busy.append(time.thread_time() - used)
    clock, processor = (np.percentile(each, [10, 50, 90]) * 1e3 for each in (wall, busy))
    print(
        f"{what:36} clock p10 {clock[0]:7.2f} p50 {clock[1]:7.2f} p90 {clock[2]:7.2f}   "
        f"processor p10 {processor[0]:7.2f} p50 {processor[1]:7.2f} p90 {processor[2]:7.2f} ms",
        flush=True,
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=300)
    repeat = parser.parse_args().repeat
    model, spindle = published_model(), read_spindle(spindle_folder() / "tool_warm_y.yaml")
    frequency_hz = source_frequencies()
    print(f"{len(frequency_hz)} frequencies, published tables, axis x")

    def tracker() -> AxisTracker:
        return AxisTracker(model.axes["x"], spindle.assembly("tool"), frequency_hz)

    timed("prepare (condense, once)", lambda _: tracker(), 5)
    one = tracker()
    timed("properties alone", lambda k: one.regression.estimate(np.full(4, 20.0) + 0.001 * k, STILL), repeat)
    timed("renew, nothing flagged", lambda k: one.renew(np.full(4, 20.0) + 0.001 * (k % 100), STILL), repeat)
    hot = tracker()
    timed("renew, flagged", lambda k: hot.renew(np.full(4, 21.0) + 0.01 * (k % 100), STILL), repeat)
    far = tracker()
    timed("renew, jump", lambda k: far.renew(np.full(4, 16.5) + 4.0 * (k % 2), STILL), repeat // 10)


if __name__ == "__main__":
    main()
