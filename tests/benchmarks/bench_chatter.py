"""How often the verdict on chatter is wrong, on synthesised recordings of every kind.

    python tests/benchmarks/bench_chatter.py [--count 60] [--half judging|tuning]

The settings were chosen on the tuning half (even seeds); the judging half (odd seeds) is what counts.
"""

import argparse
import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "support"), str(Path(__file__).resolve().parents[2])]

from cut_recordings import IN_DEPTHS, ROWS, wrong, wrong_in_depths  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="recordings per row")
    parser.add_argument("--half", choices=("judging", "tuning"), default="judging")
    options = parser.parse_args()
    seeds = range(1 if options.half == "judging" else 0, 2 * options.count, 2)
    began_s = time.process_time()
    print(f"{options.half} half, {options.count} recordings a row")
    for row in ROWS:
        count = sum(wrong(row, seed) for seed in seeds)
        print(f"{row.name:50} {'missed' if row.chatter else 'false':6} {100.0 * count / len(seeds):5.1f} %", flush=True)
    for row in IN_DEPTHS:
        false, missed, stable, chattering = (
            sum(each) for each in zip(*(wrong_in_depths(row, s) for s in seeds), strict=True)
        )
        shares = [
            f"{word} {100.0 * n / max(of, 1):.1f} %"
            for word, n, of in (("false", false, stable), ("missed", missed, chattering))
        ]
        print(f"{row.name + ', three depths':50} {', '.join(shares)}", flush=True)
    print(f"{time.process_time() - began_s:.0f} s of processor time")


if __name__ == "__main__":
    main()
