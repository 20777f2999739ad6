"""`toolpoint thermal campaign`: the published measurement programme on the simulated machine."""

from pathlib import Path

import click

from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import ProgressBar, json_option

STEPS = 1000


@click.command()
@click.argument("folder", metavar="OUT", type=FILE)
@option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, help="Which hall.")
@option(
    "--programme",
    "programme_path",
    type=FILE,
    help="Operations (YAML). Without: the published programme of twenty data sets.",
)
@json_option
def campaign(folder: Path, seed: int, programme_path: Path | None, json_path: str | None) -> None:
    """Carry out a thermal measurement campaign on the simulated machine and write its recordings to OUT."""
    from config.recordings.campaign_index import INDEX_FILE
    from config.recordings.thermal_campaign import PUBLISHED, load_thermal_campaign
    from daemon.simulation.simulated_model import published_sensors
    from daemon.simulation.thermal_campaign import run_thermal_campaign

    if folder.exists() and not folder.is_dir():
        refuse(f"{folder}: is a file; name a folder for the recordings")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / INDEX_FILE).is_file():
        refuse(f"{folder}: holds other files; name an empty folder, or one that holds a campaign already")
    try:
        programme = load_thermal_campaign(programme_path or PUBLISHED)
        with ProgressBar() as bar:
            index = run_thermal_campaign(
                folder,
                programme,
                published_sensors(),
                seed=seed,
                progress=lambda share: bar.show("measuring", round(share * STEPS), STEPS),
            )
    except OSError as error:
        refuse(f"{folder}: the recordings cannot be written ({error.strerror})")
    for entry in index["datasets"]:
        words = ", ".join(
            word for word in (entry["previous"] and f"after {entry['previous']}", entry["cooling"]) if word
        )
        speeds = "/".join(f"{speed:g}" for speed in entry["spindle_speeds_rpm"])
        say(f"{entry['file']}: {speeds} 1/min, {words} ({entry['usage']})")
    say(f"{folder / INDEX_FILE}: {len(index['datasets'])} data sets of the simulated machine")
    write_json(json_path, index)
