"""Stability: times, convergence, and 500 cases before the time-domain referee.

Run by hand: `python tests/benchmarks/bench_stability.py [--cases 500]`. Nothing here passes or fails.
"""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "support"))

from milling_cases import OFF_BOUNDARY, random_cases

from config.machine.published_bearings import published_model
from config.machine.spindle_chain import read_spindle
from models.spindle_speed.choice import SpeedDemand, choose_speed
from models.spindle_speed.planner import MillingOperation, SpeedPlanner
from models.spindle_speed.tracked_tool_point import TrackedToolPoint
from models.spindle_speed.verification import StabilityVerification
from models.stability.collocation import radius_bounds, spectral_radii
from models.stability.lobes_sdm import semi_discretised_lobes
from models.stability.lobes_zoa import lowest_over_feed_directions, zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, engagement_rad
from models.stability.response import ModalResponse, SampledResponse, mode_from_mass, mode_from_stiffness
from models.stability.semi_discretisation import default_steps, semi_discretisation, spectral_radius, swept_radii
from models.stability.state_space import state_space
from models.thermomechanics.tool_point import ToolPointTracker

BENCHMARK = ModalResponse(xx=(mode_from_mass(922.0, 0.011, 0.03993),))
STEPS = (20, 40, 80, 120, 200)
REFERENCE_STEPS = 800


def cut(mode: str, radial_mm: float, teeth: int = 2) -> Cut:
    start_rad, exit_rad = engagement_rad(MillingMode(mode), radial_mm, 10.0)
    return Cut(teeth=teeth, start_rad=start_rad, exit_rad=exit_rad, tangential_n_per_m2=6e8, radial_ratio=1.0 / 3.0)


def timed(what: str, work: Callable[[], object], repeats: int) -> None:
    """Print wall and processor times: their ratio says how busy the computer was."""
    walls, processors = [], []
    for _ in range(repeats):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        walls.append(1e3 * (time.perf_counter() - wall))
        processors.append(1e3 * (time.process_time() - processor))
    print(
        f"{what}: median {statistics.median(walls):.1f} ms, slowest {max(walls):.1f} ms of {repeats}; "
        f"processor {statistics.median(processors):.1f} ms"
    )


def lobes_from_an_frf() -> None:
    lines_hz = np.arange(384, 3201) * 12800 / 16384
    modes = ModalResponse(
        xx=(mode_from_stiffness(664.0, 0.03, 6e6), mode_from_stiffness(1500.0, 0.02, 2e7)),
        yy=(mode_from_stiffness(601.0, 0.025, 4e6),),
    )
    receptance = modes.receptance_m_per_n(lines_hz)
    noise = np.random.default_rng(1).normal(size=(2, *receptance.shape)) * 0.02
    for name, samples in (("clean", receptance), ("2 % noise", receptance * (1.0 + noise[0] + 1j * noise[1]))):
        response = SampledResponse(frequency_hz=lines_hz, receptance=samples)
        timed(
            f"lobes, 2000 to 14000 1/min, 400 speeds, FRF of 2817 lines in X and Y, {name}",
            lambda response=response: zeroth_order_lobes(
                response, cut("down", 1.0, 4), from_rpm=2000.0, to_rpm=14000.0, points=400
            ),
            40,
        )


def new_speed_from_temperatures() -> None:
    """The published regressions on the simulated machine's spindle, X and Y, 2817 lines, 401 speeds."""
    labels = {"IR": [0], "A": [1], "F": [2], "Room": [3]}
    assembly = read_spindle(Path("simulated_machine")).assembly()
    estimator = TrackedToolPoint(ToolPointTracker(published_model(), {"x": assembly, "y": assembly}, labels), labels)
    operation = MillingOperation(
        demand=SpeedDemand(programmed_rpm=9000.0, depth_mm=0.3),
        feed_mm_min=1800.0,
        teeth=4,
        range_rpm=(7200.0, 10800.0),
    )
    planner = SpeedPlanner(
        operation,
        lambda response: zeroth_order_lobes(response, cut("down", 5.0, 4), from_rpm=7100.0, to_rpm=10900.0, points=401),
    )
    cycle = iter(range(10_000))

    def work() -> None:
        number = next(cycle)
        degc = np.array([25.0, 22.0, 23.0, 20.0]) + 0.01 * number
        known = estimator.renew(10.0 * number, degc)
        assert known is not None
        planner.plan(known)

    timed("temperatures to speed, flagged ends looked at when the resonance has moved", work, 120)


def new_speed() -> None:
    """From a modelled FRF to a speed, over every feed direction and +-20 % of the programmed speed."""
    lines_hz = np.arange(384, 3201) * 12800 / 16384
    modes = ModalResponse(
        xx=(mode_from_stiffness(664.0, 0.03, 6e6), mode_from_stiffness(1500.0, 0.02, 2e7)),
        yy=(mode_from_stiffness(601.0, 0.025, 4e6),),
    )
    response = SampledResponse(frequency_hz=lines_hz, receptance=modes.receptance_m_per_n(lines_hz))
    demand = SpeedDemand(programmed_rpm=7000.0, depth_mm=0.5)

    def work() -> None:
        lobes = lowest_over_feed_directions(response, cut("down", 1.0, 4), from_rpm=5500.0, to_rpm=8500.0, points=400)
        choose_speed(lobes, demand, range_rpm=(5600.0, 8400.0))

    timed("new speed from an FRF of 2817 lines, eight feed directions", work, 40)


def verification(radial_mm: float, depth_mm: float, repeats: int = 60) -> None:
    """Modes from an FRF, then eight directions at three speeds, beside the semi-discretisation of the same."""
    lines_hz = np.arange(384, 3201) * 12800 / 16384
    modes = ModalResponse(
        xx=(mode_from_stiffness(664.0, 0.03, 6e6), mode_from_stiffness(1500.0, 0.02, 2e7)),
        yy=(mode_from_stiffness(601.0, 0.025, 4e6),),
    )
    mode = "slot" if radial_mm == 10.0 else "down"
    tool, feeds_deg = cut(mode, radial_mm, 4), tuple(22.5 * number for number in range(8))
    check = StabilityVerification(tool, feeds_deg)
    fits, verdicts, discretised, errors = [], [], [], []
    for number in range(repeats):
        warmer = 1.0 + 1e-4 * number
        xx, yy = (
            tuple(replace(mode, frequency_hz=warmer * mode.frequency_hz) for mode in entry)
            for entry in (modes.xx, modes.yy)
        )
        moved = ModalResponse(xx=xx, yy=yy)
        response = SampledResponse(frequency_hz=lines_hz, receptance=moved.receptance_m_per_n(lines_hz))
        fits.append(processor_ms(lambda response=response: check.modes(response)))
        verdicts.append(processor_ms(lambda response=response: check.denial(response, 7000.0, depth_mm, 0.02)))
        if number % 10 == 0:
            discretised.append(processor_ms(lambda moved=moved: eight_directions(moved, tool, feeds_deg, depth_mm)))
            _, upper = radius_bounds(moved, tool, feeds_deg=feeds_deg, speeds_rpm=[7000.0], depth_mm=depth_mm)
            errors += np.abs(upper[:, 0] - eight_directions(moved, tool, feeds_deg, depth_mm)[:, 1]).tolist()
    print(f"verification of a speed, {radial_mm:g} of 10 mm wide, processor time in ms, {repeats} times")
    print(f"  modes from an FRF of 2817 lines in X and Y: first {fits[0]:.1f}, then {percentiles(fits[1:])}")
    print(f"  eight directions at three speeds: {percentiles(verdicts)}")
    print(
        f"  by semi-discretisation: {percentiles(discretised)}; "
        f"ratio {statistics.median(discretised) / statistics.median(verdicts):.0f}"
    )
    print(f"  largest difference of the radius: {max(errors):.1e}")


def eight_directions(response: ModalResponse, tool: Cut, feeds_deg: tuple[float, ...], depth_mm: float) -> np.ndarray:
    """Return the spectral radii by semi-discretisation, shape (directions, 3)."""
    found = np.zeros((len(feeds_deg), 3))
    for row, feed_deg in enumerate(feeds_deg):
        structure = state_space(response, feed_deg)
        for column, speed_rpm in enumerate((6860.0, 7000.0, 7140.0)):
            method = semi_discretisation(structure, tool, default_steps(structure, tool, speed_rpm))
            found[row, column] = spectral_radius(method, speed_rpm, np.array([depth_mm]))[0]
    return found


def processor_ms(work: Callable[[], object]) -> float:
    begun = time.process_time()
    work()
    return 1e3 * (time.process_time() - begun)


def percentiles(times_ms: list[float]) -> str:
    p50, p90, p99 = np.percentile(times_ms, (50, 90, 99))
    return f"p50 {p50:.1f}, p90 {p90:.1f}, p99 {p99:.1f}"


def chart() -> None:
    """Spectral radii at 200 speeds and 100 depths, by collocation and, beside it, by the semi-discretisation."""
    speeds, depths = np.linspace(5000.0, 25000.0, 200), np.linspace(0.05, 5.0, 100)
    for name, of in (("slotting", cut("slot", 10.0)), ("down-milling 1 of 10", cut("down", 1.0))):
        method = semi_discretisation(state_space(BENCHMARK), of, 40)
        timed(
            f"chart, 200 x 100, one mode, {name}, one thread",
            lambda of=of: [
                spectral_radii(BENCHMARK, of, feed_deg=0.0, speed_rpm=speed, depths_mm=depths)
                for speed in speeds.tolist()
            ],
            3,
        )
        timed(
            "  by semi-discretisation with 40 steps, every fourth speed",
            lambda method=method: [spectral_radius(method, speed, depths) for speed in speeds[::4].tolist()],
            1,
        )
        for steps in (None, 40):
            timed(
                f"lobes at 100 speeds, {name}, steps {steps}",
                lambda of=of, steps=steps: semi_discretised_lobes(
                    BENCHMARK, of, from_rpm=5000.0, to_rpm=25000.0, points=100, steps=steps
                ),
                1,
            )


def convergence() -> None:
    rng = np.random.default_rng(3)
    errors = np.zeros((200, len(STEPS)))
    for row in errors:
        mode = str(rng.choice(["up", "down", "slot"]))
        case = cut(mode, 10.0 if mode == "slot" else float(rng.uniform(0.3, 9.5)))
        structure = state_space(BENCHMARK)
        speed, depth = float(rng.uniform(5000.0, 25000.0)), np.array([math.exp(rng.uniform(-2.0, 1.1))])
        exact = spectral_radius(semi_discretisation(structure, case, REFERENCE_STEPS), speed, depth)[0]
        for place, steps in enumerate(STEPS):
            row[place] = abs(spectral_radius(semi_discretisation(structure, case, steps), speed, depth)[0] - exact)
    print(f"error of the spectral radius against {REFERENCE_STEPS} steps, 200 random cuts of the benchmark")
    for place, steps in enumerate(STEPS):
        percentiles = np.percentile(errors[:, place], (50, 90, 100))
        print(
            f"  {steps:4} steps: median {percentiles[0]:.1e}, 90 % {percentiles[1]:.1e}, largest {percentiles[2]:.1e}"
        )


def referee(cases: int, *, beyond: bool) -> None:
    agreed = total = 0
    begun = time.process_time()
    numbers = (2, 3, 4) if beyond else (1, 2, 3, 4)
    for teeth in numbers:
        drawn = random_cases(teeth, cases // len(numbers), seed=1, beyond=beyond)
        same = drawn.agree(passings=200 if beyond else 400, steps_per_passing=200 if beyond else 400)
        agreed, total = agreed + int(same.sum()), total + len(same)
        for place in np.flatnonzero(~same):
            print(f"  differs: {drawn.described[place]}")
    print(
        f"time-domain referee{', helix, uneven pitch and process damping' if beyond else ''}: {agreed} of {total} "
        f"agree ({agreed / total:.1%}) where the radius is off 1 by more than {OFF_BOUNDARY}; "
        f"{time.process_time() - begun:.0f} s of processor time"
    )


def beyond_straight() -> None:
    """Time a verdict and lobes of a tool with helix, uneven pitch and process damping."""
    speeds_rpm = 12000.0 * np.array([0.99, 1.0, 1.01])
    structure = ModalResponse(xx=(mode_from_stiffness(664.0, 0.03, 6e6),), yy=(mode_from_stiffness(601.0, 0.025, 4e6),))
    plain = replace(cut("down", 1.0, 4), diameter_m=0.01)
    uneven = tuple(math.radians(angle) for angle in (80.0, 85.0, 95.0, 100.0))
    tools = {
        "helix 35 deg": replace(plain, helix_rad=math.radians(35.0)),
        "four pitches": replace(plain, pitch_rad=uneven),
        "process damping": replace(plain, process_damping_n_per_m=2e4),
        "all three": replace(plain, helix_rad=math.radians(35.0), pitch_rad=uneven, process_damping_n_per_m=2e4),
    }
    feeds_deg = [22.5 * number for number in range(8)]
    for name, tool in tools.items():
        timed(
            f"{name}: eight directions at three speeds",
            lambda tool=tool: swept_radii(structure, tool, feeds_deg, speeds_rpm, 0.5),
            3,
        )
        timed(
            f"{name}: lobes at 100 speeds",
            lambda tool=tool: semi_discretised_lobes(structure, tool, from_rpm=5000.0, to_rpm=25000.0, points=100),
            1,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--only-beyond", action="store_true", help="only tools with helix, uneven pitch, damping")
    arguments = parser.parse_args()
    if arguments.only_beyond:
        beyond_straight()
        referee(arguments.cases, beyond=True)
        return
    lobes_from_an_frf()
    new_speed()
    for radial_mm, depth_mm in ((1.0, 0.5), (5.0, 0.3), (10.0, 0.2)):
        verification(radial_mm, depth_mm)
    new_speed_from_temperatures()
    chart()
    convergence()
    referee(arguments.cases, beyond=False)


if __name__ == "__main__":
    main()
