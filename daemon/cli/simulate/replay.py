"""`toolpoint replay`: play a recording over real wires while the whole daemon runs."""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np

from config.files import read_whole
from daemon.cli.common import option, refuse, say, write_json
from daemon.cli.options import EXISTING_FILE, FOLDER, NOT_NEGATIVE, POSITIVE, ProgressBar, json_option
from daemon.cli.pages import html_option, write_page
from daemon.cli.simulate.demo import simulation_folder
from daemon.history.reader import HistoryReader
from daemon.simulation import SimulationError
from daemon.simulation.demonstration import settle, switch_on, watch
from daemon.simulation.processes import RunningSimulation, start_simulation, write_simulation_configuration
from daemon.simulation.replaying import (
    LEAST_SHARE,
    Following,
    allowed_change_k,
    axis_names,
    findings_said,
    following,
    map_of,
    modelled,
    not_enabled,
    pauses,
    played_otherwise,
    played_positions,
    played_utc_s,
    playing_time_s,
    replay_machine,
    sensor_names,
)
from drivers.contract import DriverError
from drivers.files.recording_csv import read_recording
from models.thermal.family import model_from_json

FASTEST = 600.0
"""Faster than this the wires cannot keep the machine's time [simulated s per s]."""


@click.command()
@click.argument("recording", type=EXISTING_FILE)
@option("--map", "map_path", type=EXISTING_FILE, help="Which columns are what (YAML; default: the usual names).")
@option(
    "--model",
    "model_path",
    type=EXISTING_FILE,
    required=True,
    help="Thermal model (JSON) from `toolpoint thermal train`.",
)
@option("--speed", type=POSITIVE, default=FASTEST, help="Simulated seconds per second; more than 600 is taken as 600.")
@option("--from-hours", type=NOT_NEGATIVE, help="Begin here [h].")
@option("--to-hours", type=NOT_NEGATIVE, help="End here [h].")
@option("--directory", type=FOLDER, help="Where wires, logs and store go, and stay.")
@html_option
@json_option
def replay(
    recording: Path,
    map_path: Path | None,
    model_path: Path,
    speed: float,
    from_hours: float | None,
    to_hours: float | None,
    directory: Path | None,
    html_path: Path | None,
    json_path: str | None,
) -> None:
    """Play RECORDING: temperatures as LATSIS frames, displacements as a growing CSV, speed from the CNC.

    The reference is the mean of the first block played. Reports the error per channel without and with compensation,
    and for how much of the time the output followed; ends with 1 where that is less than half.
    """
    if speed > FASTEST:
        say(f"--speed {speed:g} is taken as {FASTEST:g}: the simulated wires are no faster")
        speed = FASTEST
    try:
        recording_map = map_of(recording, map_path)
        table = read_recording(recording, recording_map)
        last_h = float(table.time_s[-1] - table.time_s[0]) / 3600.0
        hours = from_hours or 0.0, min(to_hours if to_hours is not None else last_h, last_h)
        part = table.between_hours(*hours)
        whole, part = part.displacement_names, modelled(model_path, part)
        said = [*findings_said(table), *played_otherwise(table, part)]
        if unplayed := [name for name in whole if name not in part.displacement_names]:
            names = ", ".join(unplayed)
            said.append(f"not played, because the model does not estimate it, or it is a slope [um/m]: {names}")
        for sentence in positions_played(played_positions(part)):
            say(sentence)
    except (DriverError, ValueError) as error:
        refuse(str(error))
    with simulation_folder(directory) as folder:
        try:
            machine = replay_machine(part, model_path, folder / "commissioning.json")
            cycle_s = machine["temperatures"]["lines"][0]["cycle_period_s"]
            if note := allowed_change_k(part, cycle_s)[1]:
                said.append(note)
            path, _ = write_simulation_configuration(machine, folder, speed=speed)
        except ValueError as error:
            refuse(str(error))
        until_s = playing_time_s(part)
        arguments = ["--recording", str(recording.resolve()), "--hours", f"{hours[0]!r}-{hours[1]!r}"]
        arguments += ["--until-s", repr(until_s), "--report-s", "60"]
        arguments += [] if map_path is None else ["--map", str(map_path.resolve())]
        began_s = time.time()
        with start_simulation(arguments, path, speed=speed, epoch_utc_s=began_s, directory=folder) as running:
            _enable(running, cycle_s)
            _follow(running, until_s)
            final, status = settle(running)
        with HistoryReader(running.configuration.history.path) as reader:
            span_s = played_utc_s(part, began_s)
            followed = following(reader.events(0.0, span_s[1]), *span_s, names=sensor_names(part, model_path))
            late = pauses(reader.estimates(*span_s).time_s.tolist(), cycle_s, speed)
    channels = axis_names(part.displacement_names)
    final["channels"] = {channels[axis]: figures for axis, figures in final["channels"].items()}
    found = _found(final, status, followed, [*said, late] if late else said, speed)
    if part.axis_positions:
        found["positions"] = played_positions(part)
    report(recording, found, json_path)
    if html_path is not None:
        write_page(html_path, page(recording, model_path, channels, final["series"], found))
    if followed.active_share < LEAST_SHARE:
        raise SystemExit(1)


def _found(
    final: dict[str, Any], status: dict[str, Any], followed: Following, said: list[str], speed: float
) -> dict[str, Any]:
    """Return the result for JSON, the table and the page; `said`: what was warned of before."""
    return {
        "cycles": {"expected": sum(final["cycles_sent"].values()), **status["cycles"]},
        "writes": status["writes"],
        "following": {"active_share": followed.active_share, "states": followed.states, "why": followed.why},
        "channels": final["channels"],
        "warnings": [*said, *([followed.warning] if followed.warning else [])],
        "advice": [advice] if (advice := followed.advice(speed)) else [],
    }


def page(
    recording: Path, model_path: Path, channels: dict[str, str], series: dict[str, Any], found: dict[str, Any]
) -> str:
    """Return the page of a replay: what was measured, what the NC applied turned round, and what that left."""
    from daemon.workbench.thermal.result_pages import Stretch, replay_page

    model = model_from_json(read_whole(model_path), str(model_path))
    measured, left = (
        np.array([series["channels"][axis][case] for axis in channels], dtype=np.float64).T
        for case in ("without", "with")
    )
    played = Stretch(
        name=recording.name,
        time_h=np.arange(len(measured)) * series["block_s"] / 3600.0,
        measured_um=measured,
        estimated_um=measured - left,
    )
    facts = {
        "file": model_path,
        "model": model.model_id,
        "kind": model.kind,
        "sensors": len(model.sensor_ids),
        "refused by its training": model.refused or "no",
        "trained on": ", ".join(data.name for data in model.training),
        **{f"position {n}": sentence for n, sentence in enumerate(positions_played(found.get("positions", {})), 1)},
        "output followed": f"{found['following']['active_share']:.0%} of the time",
    }
    return replay_page(f"Replay of {recording.name}", found, facts, list(channels.values()), played)


def report(recording: Path, found: dict[str, Any], json_path: str | None) -> None:
    """Print the table or write the JSON; whatever it shows is reported as it is."""
    following = found["following"]
    say(f"ACTIVE for {following['active_share']:.0%} of the time played")
    for sentence in found["warnings"]:
        say(f"warning: {sentence}")
    for sentence in found["advice"]:
        say(f"next: {sentence}")
    write_json(json_path, found)
    if json_path is not None:
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(f"{recording.name}: error since the first block [um]"))
    for column in ("channel", "RMSE without", "RMSE with", "max without", "max with"):
        table.add_column(column, justify="right")
    for name, channel in found["channels"].items():
        numbers = [channel[case][key] for key in ("rmse_um", "max_um") for case in ("without", "with")]
        table.add_row(Text(name), *(f"{number:.2f}" for number in numbers))
    Console().print(table)


def positions_played(positions: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield which axis of the simulated control shows each recorded position, and what becomes of missing ones."""
    for name, one in positions.items():
        lost = f"missing in {1.0 - one['known']:.1%} of the rows, where the output holds"
        yield (
            f"axis position {name}: played as axis {one['axis']} of the simulated control, straight from row to row; "
            f"{lost if one['known'] < 1.0 else 'missing nowhere'}"
        )


def _enable(running: RunningSimulation, cycle_period_s: float) -> None:
    try:
        switch_on(running)
    except SimulationError as error:
        arrived, played = running.client.ask("status")["cycles"]["received"], running.time_s / cycle_period_s
        refuse(not_enabled(str(error), arrived, played))


def _follow(running: RunningSimulation, until_s: float) -> None:
    with ProgressBar() as bar:
        watch(running, until_s, lambda _: bar.show("playing", max(running.time_s, 0.0), until_s), 0.5)
