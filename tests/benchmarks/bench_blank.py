"""What noise in an impact test on a blank makes of the tool that is computed from it, with and without smoothing.

    python tests/benchmarks/bench_blank.py [--draws 25]

Per noise of the responses: root mean square and largest error of the peak's size over the draws, its error in
frequency, how often the printed interval holds the true peak, and the error without smoothing.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "support"), str(Path(__file__).resolve().parents[2])]

from blank_in_holder import BLANK, HZ, SECOND_M, TOOL, blank_test, holder_on_spindle, noisy, tip  # noqa: E402

from config.machine.blank import Blank, BlankResponses, BlankTest  # noqa: E402
from config.machine.spindle import SegmentDescription  # noqa: E402
from daemon.workbench.dynamics.blanks import blank_summary  # noqa: E402
from models.dynamics.inverse_coupling import held_stiffness, tool_point_receptance  # noqa: E402

NOISES = (0.002, 0.005, 0.01, 0.02)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=25, help="draws of the noise, per row")
    draws = parser.parse_args().draws
    holder = holder_on_spindle()
    measured, true = blank_test(holder), np.abs(tip(holder, TOOL))
    peak = int(true.argmax())
    nothing = BlankResponses(tip=[Path("tip")], cross=[Path("cross")], second=[Path("second")])
    section = SegmentDescription(length_mm=70.0, outer_mm=16.0, material="steel")
    test = BlankTest(blank=section, second_point_mm=SECOND_M * 1e3, responses=nothing)
    blank = Blank(test=test, beam=BLANK)
    print("noise    rms    largest  frequency [Hz]  interval holds  rms unsmoothed")
    for noise in NOISES:
        sizes, places, held, bare = [], [], 0, []
        for seed in range(draws):
            raw = noisy(measured, noise, seed)
            found = blank_summary(blank, {"tool": TOOL}, HZ, raw)["tools"]["tool"]
            sizes.append(found["peak_m_per_n"] / true[peak] - 1.0)
            places.append(abs(found["peak_hz"] - HZ[peak]))
            low, high = found["peak_m_per_n_interval"]
            held += low <= true[peak] <= high
            without = tool_point_receptance(TOOL, held_stiffness(BLANK, SECOND_M, HZ, raw), HZ)
            bare.append(np.abs(without).max() / true[peak] - 1.0)
        rms, unsmoothed = (np.sqrt(np.mean(np.square(each))) for each in (sizes, bare))
        print(
            f"{noise:5.1%} {rms:6.1%} {np.abs(sizes).max():10.1%} {max(places):14.0f} {held / draws:15.0%} "
            f"{unsmoothed:15.0%}"
        )


if __name__ == "__main__":
    main()
