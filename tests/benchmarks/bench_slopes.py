"""What a slope leaves of a simulated 500 mm axis whose scale expands, beside the offset alone, with every family.

    python tests/benchmarks/bench_slopes.py [--families default,gaussian,pls]

Trains on six simulated days and judges on three others (seeds in `tests/support/expanding_axis.py`). Nothing here
passes or fails; `tests/models/test_slopes.py` holds the number.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "support"), str(Path(__file__).resolve().parents[2])]

from expanding_axis import JUDGED, left_um, recorded  # noqa: E402

from models.thermal.training.recipes import RECIPES  # noqa: E402


def main() -> None:
    """Print one line per family."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--families", default="default,gaussian,lags,ridge,pls,lasso")
    families = parser.parse_args().families.split(",")
    with tempfile.TemporaryDirectory() as folder:
        recordings = recorded(Path(folder))
    for family in families:
        assert family in RECIPES, f"there is no family {family}"
        begun = time.process_time()
        alone, whole = left_um(recordings, family, JUDGED)
        print(
            f"{family:14} offset alone leaves {alone:6.2f} um, with slope {whole:6.2f} um, {whole / alone:6.1%}; "
            f"{time.process_time() - begun:.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
