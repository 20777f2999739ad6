"""`toolpoint thermal report`: thermal distortion of a recording in the words of ISO 230-3."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from config.files import read_whole
from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import NOT_A_FOLDER, NOT_NEGATIVE, POSITIVE, json_option

if TYPE_CHECKING:
    from models.thermal.family import ThermalModel
    from models.thermal.training.energy import Process


@click.command()
@click.argument("recording_path", metavar="RECORDING", type=FILE)
@option("--map", "map_path", type=FILE, help="What the columns mean (YAML).")
@option("--model", "model_path", type=FILE, help="Model to report with compensation.")
@option("--ahead-min", type=POSITIVE, default=15.0, help="Drift counts over this time [min].")
@option("--tolerance-um", type=POSITIVE, default=2.0, help="Largest drift over it [um].")
@option(
    "--settled-hours",
    type=NOT_NEGATIVE,
    default=4.0,
    help="Standstill after a rotation that does not count for the environment [h].",
)
@option("--standing", is_flag=True, help="The spindle stood all the time; for recordings without speed.")
@option("--ambient", help="Temperatures of the air: names or patterns, separated by commas.")
@option("--chiller-kw", type=NOT_NEGATIVE, default=1.2, help="Power of the chiller [kW].")
@option("--cut-kwh", type=NOT_NEGATIVE, help="Energy that cutting one part takes [kWh], for the energy efficiency.")
@option("--motor-kwh", type=POSITIVE, help="Energy of the motors for one part [kWh].")
@option("--process-min", type=POSITIVE, help="Time of one part [min], for the productivity.")
@option("--html", "html_path", type=NOT_A_FOLDER, help="Write a page to this file.")
@json_option
def report(
    recording_path: Path,
    map_path: Path | None,
    model_path: Path | None,
    ahead_min: float,
    tolerance_um: float,
    settled_hours: float,
    standing: bool,
    ambient: str | None,
    chiller_kw: float,
    cut_kwh: float | None,
    motor_kwh: float | None,
    process_min: float | None,
    html_path: Path | None,
    json_path: str | None,
) -> None:
    """Report the thermal distortion of a RECORDING, with and without compensation.

    Distortion by the rotating spindle in the first 60 min and the whole period, environmental temperature
    variation error, time to stability, how long to warm up, and what the chiller takes.
    """
    from config.recordings.recording_map import load_recording_map
    from daemon.workbench.thermal.report import ReportChoices, thermal_report
    from daemon.workbench.thermal.report_page import write_report_page
    from drivers.files.recording_csv import read_recording
    from drivers.files.recording_origin import read_origin
    from models.recordings.findings import require_usable

    try:
        recording_map = None if map_path is None else load_recording_map(map_path)
        sample_s = 60.0 if recording_map is None else recording_map.sample_s
        raw = read_recording(recording_path, recording_map)
        warnings = [f"{raw.name}: {finding}" for finding in require_usable(raw, len(raw.temperature_names) + 1)]
        recording = raw.without_impossible().downsampled(sample_s)
        model = None if model_path is None else _model(model_path)
        choices = ReportChoices(
            ahead_min=ahead_min,
            tolerance_um=tolerance_um,
            settled_h=settled_hours,
            standing=standing,
            ambient=() if ambient is None else tuple(name.strip() for name in ambient.split(",") if name.strip()),
            chiller_kw=chiller_kw,
            process=_process(cut_kwh, motor_kwh, process_min),
        )
        found = thermal_report(recording, model, choices) | {"warnings": warnings}
        if html_path is not None:
            write_report_page(html_path, found, recording, model, read_origin(recording_path, recording_map))
    except OSError as error:
        refuse(f"{html_path}: the page cannot be written ({error.strerror})")
    _show(found)
    write_json(json_path, found)


def _model(path: Path) -> "ThermalModel":
    from models.thermal.family import model_from_json

    try:
        return model_from_json(read_whole(path), str(path))
    except OSError as error:
        refuse(f"{path}: the thermal model cannot be read ({error.strerror})")


def _process(cut_kwh: float | None, motor_kwh: float | None, process_min: float | None) -> "Process | None":
    from models.thermal.training.energy import Process

    if cut_kwh is None and motor_kwh is None and process_min is None:
        return None
    if cut_kwh is None or motor_kwh is None or process_min is None:
        raise click.UsageError("energy efficiency takes --cut-kwh, --motor-kwh and --process-min together")
    try:
        return Process(cut_kwh=cut_kwh, motor_kwh=motor_kwh, time_h=process_min / 60.0)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _show(found: dict[str, Any]) -> None:
    """Write the figures for people, on standard error."""
    for warning in found["warnings"][:10]:
        say(f"warning: {warning}")
    say(f"{found['recording']}: {found['hours']:g} h, {len(found['rotations'])} rotations")
    if found["seen_in_training"]:
        say("warning: the model was trained on a recording of this name; with compensation looks too good")
    say(f"{'channel':10} {'first 60 min':>13} {'whole':>8} {'environment':>12}   [um]")
    for name, channel in found["channels"].items():
        for kind in ("without", "with"):
            worst = channel[f"worst_{kind}"]
            if any(value is not None for value in worst.values()):
                first, whole, environment = (_text(value) for value in worst.values())
                say(f"{name:10} {first:>13} {whole:>8} {environment:>12}   {kind} compensation")
    if found["environment"]["why_not"] is not None:
        say(f"no environmental temperature variation error: {found['environment']['why_not']}")
    drift = found["drift"]
    for name, channel in found["channels"].items():
        waits = [turn["warm_up"]["wait_min"] for turn in channel["distortion_by_rotating_spindle"]]
        if known := [wait for wait in waits if wait is not None]:
            say(
                f"{name}: warm up {max(known):.0f} min until it drifts less than {drift['tolerance_um']:g} um "
                f"in {drift['ahead_min']:g} min"
            )


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
