"""`toolpoint latency`: the published delay experiment, repeated on the simulated machine."""

import sys
import time
from pathlib import Path
from typing import Any, cast

import click

from daemon.cli.common import option, refuse, say, write_json
from daemon.cli.options import NOT_A_FOLDER, FiniteFloat, directory_option, json_option, writable
from daemon.cli.simulate.demo import simulation_folder

PLOTS = (".html", ".png", ".svg")


@click.command()
@option(
    "--switches",
    type=click.IntRange(min=1, max=200),
    default=10,
    help="How often the sensor is moved between the hot and the ice pack.",
)
@option(
    "--speed",
    type=FiniteFloat(min=0, min_open=True, max=600),
    default=60.0,
    help="Simulated seconds per second; it does not change the delays.",
)
@option(
    "--mode",
    type=click.Choice(["temperature", "compensation"]),
    default="temperature",
    help="temperature: the value itself goes to a macro, as published; compensation: the whole chain.",
)
@option(
    "--cleansing",
    type=click.Choice(["on", "off"]),
    default="off",
    help="Whether the cleansing rule, which holds such a step back, stands before the macro.",
)
@option("--seed", type=click.IntRange(min=0), default=1, help="Of the random phases.")
@option(
    "--plot",
    type=NOT_A_FOLDER,
    callback=writable(*PLOTS),
    help="Draw both distributions and the moves into FILE (.html, .png or .svg).",
)
@directory_option
@json_option
def latency(
    switches: int,
    speed: float,
    mode: str,
    cleansing: str,
    seed: int,
    plot: Path | None,
    directory: Path | None,
    json_path: str | None,
) -> None:
    """Move a simulated sensor between a hot and an ice pack and measure until the CNC's macro has changed.

    Exit status 0 when every move was seen in the macro, 1 when one was not or the run broke off, 2 for bad usage.
    """
    from daemon.history.reader import HistoryReader
    from daemon.simulation.latency.experiment import Experiment, Mode
    from daemon.simulation.latency.result import Account, moves_of, result

    experiment = Experiment(
        mode=cast(Mode, mode), cleansing=cleansing == "on", switches=switches, speed=speed, seed=seed
    )
    epoch_utc_s = time.time()
    with simulation_folder(directory) as folder:
        setting, reports = _perform(experiment, folder, epoch_utc_s)
        with HistoryReader(folder / "history.sqlite") as reader:
            audit = reader.writes(0.0, epoch_utc_s + 2.0 * setting.until_s + 3600.0)
    account = Account.of(reports)
    moves, problems = moves_of(setting, account, audit, epoch_utc_s)
    numbers = result(setting, moves)
    write_json(json_path, numbers)
    if json_path is None:
        _show(numbers)
    if plot is not None:
        from daemon.simulation.latency.plot import draw

        try:
            draw(plot, setting, account, moves, numbers)
        except OSError as error:
            refuse(f"{plot} cannot be written: {error.strerror}")
    for problem in problems:
        say(problem)
    sys.exit(1 if problems else 0)


def _perform(experiment: Any, folder: Path, epoch_utc_s: float) -> tuple[Any, list[dict[str, Any]]]:
    """Run simulated machine and daemon through the experiment; return its setting and what the machine told."""
    from daemon.cli.simulate.demo import demo_machine
    from daemon.simulation.latency.experiment import latency_machine, perform, setting_of, write_script
    from daemon.simulation.processes import start_simulation, write_simulation_configuration

    base = latency_machine(demo_machine(), experiment, folder)
    path, configuration = write_simulation_configuration(base, folder, speed=experiment.speed)
    setting = setting_of(experiment, configuration)
    script = folder / "packs.yaml"
    write_script(setting.script, script)
    arguments = ["--packs", str(script), "--until-s", repr(setting.until_s)]
    with start_simulation(
        arguments, path, speed=experiment.speed, epoch_utc_s=epoch_utc_s, directory=folder
    ) as running:
        perform(running, setting)
    return setting, running.reports


def _show(numbers: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    published = numbers["published"]
    title = f"{numbers['switches']} moves, mode {numbers['mode']}, cleansing {'on' if numbers['cleansing'] else 'off'}"
    table = Table(title=f"{title} [s]")
    for column in ("", "mean", "p50", "p99", "max", "published*"):
        table.add_column(column, justify="left" if column == "" else "right")
    rows = [
        ("measurement", numbers["measurement_s"], f"> {published['measurement_s']:g}"),
        ("feedback", numbers["feedback_s"], f"{published['feedback_s']:g}"),
        ("total", numbers["total_s"], f"{published['total_s']:g}"),
        *((f"  {name.replace('_', ' ')}", part, "") for name, part in numbers["parts_s"].items()),
        ("  held back", numbers["held_back_s"], ""),
    ]
    for name, part, beside in rows:
        figures = ["-" if part[key] is None else f"{part[key]:.4f}" for key in ("mean", "p50", "p99", "max")]
        table.add_row(name, *figures, beside)
    console = Console()
    console.print(table)
    console.print(f"* {published['note']}.")
    console.print("Product: wall seconds, never scaled. All other parts: the machine's seconds.")
