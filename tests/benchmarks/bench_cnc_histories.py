"""Random histories of a control, its wire and its operator: how often the tool is moved wrongly without a word.

    python tests/benchmarks/bench_cnc_histories.py --histories 200 --first 1000 [--dialect focas]

What a history is, and who judges it: `tests/support/cnc_histories.py`. Ends with 1 where one was wrong.
"""

import argparse
import asyncio
import logging
import sys
import tempfile
import time
from pathlib import Path

import structlog

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from cnc_histories import played
from cnc_wire import DIALECTS
from standard_nodes import loaded_once


def main() -> int:
    """Play them and print one row for each dialect."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--histories", type=int, default=100, help="of each dialect")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first one")
    parser.add_argument("--dialect", choices=DIALECTS, action="append", help="this one, not all")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    loaded_once()
    wrong = 0
    print(f"{'dialect':<14}{'histories':>10}{'events':>8}{'motions':>9}{'wrong':>7}{'s each':>8}  ends")
    for dialect in arguments.dialect or DIALECTS:
        begun_s = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            seeds = range(arguments.first, arguments.first + arguments.histories)
            tally = asyncio.run(played(dialect, seeds, Path(folder)))
        each_s = (time.process_time() - begun_s) / max(tally.histories, 1)
        ends = ", ".join(f"{state} {count}" for state, count in tally.ends.most_common())
        counts = (
            f"{tally.histories:>10}{tally.happened.total():>8}{tally.motions:>9}{len(tally.wrong):>7}{each_s:>8.2f}"
        )
        print(f"{dialect:<14}{counts}  {ends}", *tally.wrong, sep="\n  ", flush=True)
        wrong += len(tally.wrong)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
