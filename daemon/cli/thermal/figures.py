"""`toolpoint thermal figures`: every figure of the published study of thermal errors, from a campaign."""

from pathlib import Path

import click

from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import ProgressBar, json_option


@click.command()
@click.argument("folder", metavar="CAMPAIGN", type=FILE)
@option("-o", "--output", required=True, type=FILE, help="Folder for report and pictures.")
@option("--b0/--no-b0", "intercept", default=True, help="Fit a drift with time.")
@option("--repeats", type=click.IntRange(1, 100), default=5, help="Random orders in which sensors are removed.")
@json_option
def figures(folder: Path, output: Path, intercept: bool, repeats: int, json_path: str | None) -> None:
    """Draw every figure of the published study of thermal errors from the recordings of a CAMPAIGN.

    Writes report.html, which needs no other file, and one PNG for each figure.
    """
    from daemon.workbench.thermal.figures.report import write_figures

    if output.exists() and not output.is_dir():
        refuse(f"{output}: is a file; name a folder for the pictures")
    try:
        with ProgressBar() as bar:
            found = write_figures(folder, output, intercept=intercept, repeats=repeats, progress=bar.show)
    except OSError as error:
        refuse(f"{output}: the figures cannot be written ({error.strerror})")
    for group, test in found["tests"].items():
        for model, shown in test["models"].items():
            largest = shown["by_training_sets"]["max_um"]
            say(
                f"{group}: {model}: largest residual {largest[0]:.1f} um after one training set, "
                f"{largest[-1]:.1f} um after {len(largest)}"
            )
    say(f"{found['report']}: {len(found['figures'])} figures of {found['machine']} recordings")
    write_json(json_path, found)
