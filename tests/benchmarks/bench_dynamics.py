"""What spindle dynamics cost: condensing, a nose response, identification, the tool point; beside 4-35.

    python tests/benchmarks/bench_dynamics.py [--repeat 200]

One thread. All are computed for the same spindle: the published shaft with rotor and sleeve on five bearings of
twelve parameters, at 2817 frequencies. `literal` is 4-35 as printed: the receptance matrix of shaft and bearings,
inverted twice.
"""

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "support"))

from receptance_coupling import ground_stiffness

from config.machine.spindle import SpindleDescription, load_spindle, spindle_folder
from config.machine.spindle_chain import build_spindle
from daemon.workbench.dynamics.responses import frequencies, properties
from models.dynamics.assembly import CondensedAssembly
from models.dynamics.bearings import CondensedShaft, properties_from_parameters
from models.dynamics.chain import Chain
from models.dynamics.identification import FIXED, identify_bearings
from models.dynamics.modes import dense_stiffness, natural_frequencies
from models.records import FloatArray

TRUE = {"ct_12": 2.5e3, "kr_12": 4e6, "kt_34": 1.2e8, "kt_5": 5e7, "ct_5": 3e3}


def told(name: str) -> SpindleDescription:
    return load_spindle(spindle_folder() / f"{name}.yaml")


def timed(what: str, call: Callable[[], object], repeat: int, target: str = "") -> float:
    """Print percentiles of the time by the clock, and the median of the processor's; return the latter [ms]."""
    call()
    wall, busy = [], []
    for _ in range(repeat):
        start, used = time.perf_counter(), time.thread_time()
        call()
        wall.append(time.perf_counter() - start)
        busy.append(time.thread_time() - used)
    p10, p50, p90 = np.percentile(wall, [10, 50, 90]) * 1e3
    processor = float(np.median(busy)) * 1e3
    print(
        f"{what:44} p10 {p10:9.3f} p50 {p50:9.3f} p90 {p90:9.3f} processor {processor:9.3f} ms   {target}", flush=True
    )
    return processor


def literal(chain: Chain, frequency_hz: FloatArray) -> Callable[[], np.ndarray]:
    """Return 4-35 with both inverses over all points of the shaft, the receptance made beforehand."""
    free = Chain(parts=chain.parts)
    at_bearings = Chain(parts=chain.parts, supports=chain.supports)
    stiffness, places = dense_stiffness(at_bearings, 500.0, 0.0, damped=True)
    springs = [None] * len(places)
    for support in chain.supports:
        springs[int(np.argmin(np.abs(places - support.position_m)))] = support.properties
    ground = ground_stiffness(springs, frequency_hz)
    receptance = np.empty((len(frequency_hz), *stiffness.shape), dtype=complex)
    for index, at in enumerate(frequency_hz):
        dense, _ = dense_stiffness(Chain(parts=free.parts, supports=chain.supports), float(at), 0.0, damped=True)
        receptance[index] = np.linalg.inv(dense - ground[index])

    def double_inverse() -> np.ndarray:
        return np.linalg.inv(np.linalg.inv(receptance) + ground)[:, 0, 0]

    return double_inverse


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--repeat", type=int, default=200)
    repeat = arguments.parse_args().repeat
    band = frequencies(300.0, 2500.0, None, None)
    spindle = build_spindle(told("unit_model_5_y"), spindle_folder() / "unit_model_5_y.yaml", "correct")
    stated = properties(spindle)
    shaft = CondensedShaft(spindle.shaft, band)
    true = {**FIXED[5], **TRUE}
    measured = shaft.nose_receptance(properties_from_parameters(true))
    print(f"{len(band)} frequencies, one thread")
    timed(
        "condense the shaft to nose and bearings", lambda: CondensedShaft(spindle.shaft, band), repeat // 10, "100 ms"
    )
    condensed = timed("nose response, 12 parameters", lambda: shaft.nose_receptance(stated), repeat, "1 ms")
    timed("the same with all derivatives", lambda: shaft.nose_receptance_and_derivatives(stated), repeat)
    tool = build_spindle(told("tool_cold_y"), spindle_folder() / "tool_cold_y.yaml")
    assembly = CondensedAssembly(tool.assembly(), band)
    timed("tool point from new bearing properties", lambda: assembly.receptance(stated), repeat, "5 ms")
    timed("six natural frequencies", lambda: natural_frequencies(spindle.shaft, 6), repeat // 10)
    for method, target in (("lm", "200 ms"), ("nelder-mead", "2000 ms")):
        found = identify_bearings(shaft, measured, method=method)  # type: ignore[arg-type]
        worst = max(abs(found.values[name] / true[name] - 1.0) for name in found.free)
        timed(
            f"five parameters by {method}",
            lambda method=method: identify_bearings(shaft, measured, method=method),
            max(repeat // 40, 2),
            f"{target}; {found.evaluations} evaluations, worst error {worst:.1e}",
        )
    slow = timed("4-35 as printed, receptance given", literal(spindle.shaft, band), 2)
    print(f"4-35 as printed costs {slow / condensed:.0f} times the condensed response")


if __name__ == "__main__":
    main()
