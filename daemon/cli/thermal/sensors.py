"""`toolpoint thermal sensors`: which few temperature sensors are worth having."""

from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FILE, option, say, write_json
from daemon.cli.options import ProgressBar, hours_option, json_option

METHODS = ("forward", "lasso", "clusters")


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=FILE)
@option("--map", "map_path", type=FILE, help="What the columns mean (YAML).")
@hours_option("--hours", help="Look at these hours of each recording only.")
@option(
    "--method",
    type=click.Choice(METHODS),
    default="forward",
    help="Order of the sensors: forward selection, path of the LASSO, or one of each cluster.",
)
@option("--most", type=click.IntRange(min=1), default=8, help="At most so many sensors.")
@json_option
def sensors(
    recordings: tuple[Path, ...],
    map_path: Path | None,
    hours: tuple[float, float] | None,
    method: str,
    most: int,
    json_path: str | None,
) -> None:
    """Compare the temperature sensors of RECORDINGS on cycles, runs or blocks that are left out.

    Prints how good a model of the first few sensors is, and what each sensor removed alone would cost.
    """
    from config.recordings.recording_map import load_recording_map
    from daemon.workbench.thermal.evaluation import read_recordings
    from daemon.workbench.thermal.sensors import compare_sensors

    recording_map = None if map_path is None else load_recording_map(map_path)
    with ProgressBar() as bar:
        read, warnings = read_recordings(recordings, recording_map, bar.show)
        sample_s = 60.0 if recording_map is None else recording_map.sample_s
        found = compare_sensors(read, sample_s, hours, method, most)  # type: ignore[arg-type]
    found["warnings"] = list(warnings)
    _show(found)
    write_json(json_path, found)


def _show(found: dict[str, Any]) -> None:
    """Write the comparison for people, on standard error."""
    for warning in found["warnings"][:10]:
        say(f"warning: {warning}")
    for name, why in found["temperatures_left_out"].items():
        say(f"temperature {name} is left out: {why}")
    say(f"all sensors: {found['all_sensors']:.1%} of the error remains ({found['folds']}s left out)")
    for step in found["selected"]:
        say(f"{step['count']:3} of them: {step['relative_rmse']:.1%}")
    say(f"order ({found['method']}): {', '.join(found['order'])}")
    for price in found["prices"]:
        say(f"without {price['sensor']}: {price['relative_rmse']:.1%} ({price['rise']:+.1%})")
