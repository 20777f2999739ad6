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
from models.dynamics.rotation import rotating_receptance, whirl_frequencies
from models.records import FloatArray

TRUE = {"ct_12": 2.5e3, "kr_12": 4e6, "kt_34": 1.2e8, "kt_5": 5e7, "ct_5": 3e3}

ALL = {"kt_12": 4e7, "ct_12": 2.5e3, "kr_12": 3e6, "cr_12": 2.0, "kt_34": 1.4e8, "ct_34": 900.0, "kr_34": 2e5,
       "cr_34": 3.0, "kt_5": 6e7, "ct_5": 2e3, "kr_5": 4e5, "cr_5": 5.0}  # fmt: skip


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


def wrong_ends(shaft: CondensedShaft, noise: float, starts: int) -> None:
    """Print how often seven parameters, from far starts, are called identifiable and are not what they are."""
    random, missed, farthest, used = np.random.default_rng(99), 0, 0.0, []
    for _ in range(starts):
        true = {name: value * np.exp(random.uniform(-0.7, 0.7)) for name, value in ALL.items()} | FIXED[7]
        scatter = random.standard_normal((2, len(shaft.frequency_hz)))
        clean = shaft.nose_receptance(properties_from_parameters(true))
        measured = clean * (1.0 + noise * (scatter[0] + 1j * scatter[1]) / np.sqrt(2.0))
        begin = {name: value * np.exp(random.uniform(-3.5, 3.5)) for name, value in true.items()}
        started = time.thread_time()
        found = identify_bearings(shaft, measured, parameters=7, start=begin)
        used.append(1e3 * (time.thread_time() - started))
        seen = [name for name in found.free if found.identifiable[name]]
        missed += any(not found.interval[name][0] <= true[name] <= found.interval[name][1] for name in seen)
        farthest = max(farthest, *(abs(found.values[name] / true[name] - 1.0) for name in seen), 0.0)
    print(
        f"seven parameters, {noise:.0%} noise, {starts} starts up to a factor of 33 off: {missed} with an identifiable "
        f"parameter outside its interval, the farthest {farthest:.1%} off; processor {np.median(used):.0f} ms"
    )


def turning(repeat: int) -> None:
    spindle = build_spindle(told("simulated_machine"), spindle_folder() / "simulated_machine.yaml")
    assembly, lines_hz = spindle.assembly(), np.arange(20.0, 4000.0, 2.0)
    timed(
        "tool point of a spindle that turns, 1990 lines",
        lambda: rotating_receptance(assembly, assembly, 12_000.0, lines_hz),
        max(repeat // 20, 2),
    )
    timed("four whirls in each sense", lambda: whirl_frequencies(assembly.whole(), 12_000.0, 4), max(repeat // 20, 2))


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
    random = np.random.default_rng(5)
    scatter = random.standard_normal((2, len(band))) * (0.03 * np.sqrt(np.mean(np.abs(measured) ** 2)))
    noisy = measured + scatter[0] + 1j * scatter[1]
    timed("five parameters, additive noise of 3 %", lambda: identify_bearings(shaft, noisy), repeat // 40, "100 ms")
    for noise, starts in ((0.0, 28), (0.05, 12)):
        wrong_ends(CondensedShaft(spindle.shaft, band[::6]), noise, starts)
    turning(repeat)
    slow = timed("4-35 as printed, receptance given", literal(spindle.shaft, band), 2)
    print(f"4-35 as printed costs {slow / condensed:.0f} times the condensed response")


if __name__ == "__main__":
    main()
