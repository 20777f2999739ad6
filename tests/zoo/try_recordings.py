"""Every family on folders of recordings, each with its `map.yaml`, as `zoo.py` tries its own machines.

.venv/bin/python tests/zoo/try_recordings.py FOLDER... [--families default,ridge,lags] [--first N]
"""

import argparse
from pathlib import Path

from zoo import DEFAULT, SAMPLE_S, Online, bands, figures, splits, trials, what_it_gets

from config.recordings.recording_map import load_recording_map
from daemon.workbench.thermal.evaluation import read_recordings
from models.recordings.findings import usable_recordings
from models.thermal.training.trial import Trial
from models.thermal.training.trust import Trust


def tried(folder: Path, family: str, first: int | None) -> str:
    """Return what a family gets on the recordings of a folder, for people.

    `first`: it is trained on so many of them, the first; None: each third is left out in turn.
    """
    recording_map = load_recording_map(folder / "map.yaml")
    read, _ = read_recordings(sorted(folder.glob("*.csv")), recording_map, lambda *_: None)
    used, _ = usable_recordings([recording.downsampled(SAMPLE_S) for recording in read])
    done: list[Trial] = []
    got: list[Online] = []
    trusted: list[tuple[Trial, Trust]] = []
    count = len(used)
    parts = splits(count, forward=False) if first is None else [(list(range(first)), list(range(first, count)))]
    for train, test in parts:
        part, trust, on_line = trials(used, train, test, family, None)
        done, got = done + part, got + on_line
        if trust is not None:
            trusted += [(trial, trust) for trial in part]
    nothing_um, reduction = figures(done, [trial.residual_um for trial in done])
    said = f"{folder.name:12} {family:10} {nothing_um:6.1f} um without, {reduction:6.1%}"
    if family == DEFAULT:
        gets, (coverage, width_um) = what_it_gets(done, got), bands(trusted)
        said += f", on line {gets['online']:6.1%}, band {coverage:.0%} of {width_um:.1f} um"
    return said


def main() -> None:
    """Print a line for each folder and family."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--families", default="default,ridge,lags", help="separated by commas (default: %(default)s)")
    parser.add_argument("--first", type=int, metavar="N", help="train on the first N, test the others")
    wanted = parser.parse_args()
    for folder in wanted.folders:
        for family in wanted.families.split(","):
            print(tried(folder, family, wanted.first), flush=True)


if __name__ == "__main__":
    main()
