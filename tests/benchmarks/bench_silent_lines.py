"""Lines that fall silent again and again, and nothing else: does the tool stand where its twin's does?

    python tests/benchmarks/bench_silent_lines.py --seed 7 --days 0.6

Prints the campaign's progress, every violation, and the share of the time in each state.
"""

import argparse
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

from daemon.cli.simulate.demo import demo_machine
from daemon.simulation.faults.run import run_campaign
from daemon.simulation.faults.script import DAY_S, FIRST_S, Happening
from drivers.sim.faults import FaultKind

SILENT_S = (150.0, 900.0)
"""Longer than a value is held, shorter than what ends a reference [s]."""
HEARD_S = (900.0, 2200.0)
LINES = ("spindle", "spindle", "saddle")
"""The tool's own temperature comes over the first."""


def silences(seed: int, days: float) -> Iterator[Happening]:
    """Return when which line falls silent."""
    drawn = random.Random(seed)
    at_s = FIRST_S + 600.0
    while at_s < days * DAY_S - 3000.0:
        duration_s, line = drawn.uniform(*SILENT_S), drawn.choice(LINES)
        yield Happening(kind=FaultKind.DEAD_LINE, at_s=at_s, duration_s=duration_s, target=line, amount=0.0)
        at_s += duration_s + drawn.uniform(*HEARD_S)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--days", type=float, default=0.6)
    options = parser.parse_args()
    script = list(silences(options.seed, options.days))
    with tempfile.TemporaryDirectory() as folder:
        result = run_campaign(
            demo_machine(), Path(folder), days=options.days, seed=options.seed, progress=print, script=script
        )
    all_s = sum(result.states_s.values())
    states = ", ".join(f"{state} {100.0 * spent_s / all_s:.0f} %" for state, spent_s in result.states_s.items())
    print(f"{len(script)} silences, farthest from the twin after a way back {result.twin_um:.2f} um; {states}")


if __name__ == "__main__":
    main()
