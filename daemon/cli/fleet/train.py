"""`toolpoint fleet train`: a model of a machine type from the recordings of many machines."""

from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import ProgressBar, destination, json_option


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=FILE)
@option("--machines", "machine_map", required=True, type=FILE, help="Which recording is of which machine (YAML).")
@option("--type-id", default="type", help="What the type is called in the models that are made of it.")
@option("--channels", help="Displacement channels, separated by commas. Without: those that all machines have.")
@option("--workers", type=click.IntRange(1, 1024), default=1, help="Processes that read and fit machines.")
@option("--dask", metavar="ADDRESS", help="Let the workers of a Dask cluster do it; they must see the same files.")
@option("-o", "--output", type=FILE, callback=destination, help="The file of the type, for `thermal train --prior`.")
@json_option
def train(
    recordings: tuple[Path, ...],
    machine_map: Path,
    type_id: str,
    channels: str | None,
    workers: int,
    dask: str | None,
    output: Path | None,
    json_path: str | None,
) -> None:
    """Learn a type of machine from the RECORDINGS of many machines.

    Tells how good it is on machines that it does not know: each is left out in turn, and taken over with none, one,
    three and ten of its own recordings. Recordings of one machine are given in the order in which they were made.
    """
    from config.files import write_whole
    from config.recordings.machine_map import load_machine_map
    from daemon.telemetry.metrics import keep_one_heap
    from daemon.workbench.thermal.fleet import fleet_executor, train_fleet
    from daemon.workbench.thermal.fleet_report import summary

    if dask is not None and workers != 1:
        raise click.UsageError("--workers is for processes of this computer; leave it out with --dask")
    machines = load_machine_map(machine_map, recordings)
    wanted = None if channels is None else [name.strip() for name in channels.split(",") if name.strip()]
    keep_one_heap()
    with ProgressBar() as bar, fleet_executor(workers, dask) as executor:
        result = train_fleet(machines, type_id, wanted, executor, bar.show)
    found = summary(result, output)
    if output is not None:
        try:
            write_whole(output, result.machine_type.to_json())
        except OSError as error:
            refuse(f"{output}: the type cannot be written ({error.strerror})")
    _show(found)
    write_json(json_path, found)


def _show(found: dict[str, Any]) -> None:
    """Write the outcome for people, on standard error."""
    for machine in found["machines"]:
        for warning in machine["warnings"]:
            say(f"warning: {machine['machine']}: {warning}")
        if machine["stale_recordings"]:
            say(
                f"{machine['machine']}: changed after its first {machine['stale_recordings']} recordings, which count "
                "little"
            )
    made = found["type"]
    machines = len(found["machines"])
    say(f"{made['type_id']}: {machines} machines, {made['sensors']} sensors, {made['directions']} directions")
    if not found["left_out"]:
        return
    say("machines left out in turn; share of the error that is gone, mean (worst machine)")
    say(f"{'own recordings':>14}  {'machines':>8}  {'with the fleet':>15}  {'alone':>15}")
    for row in found["left_out"]:
        say(f"{row['recordings']:14}  {row['machines']:8}  {_share(row['with_prior'])}  {_share(row['alone'])}")


def _share(figures: dict[str, float] | None) -> str:
    if figures is None:
        return f"{'-':>15}"
    return f"{figures['mean']:8.1%} ({figures['worst']:4.0%})"
