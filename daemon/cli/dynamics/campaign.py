"""`toolpoint dynamics campaign`, `simulate-campaign` and `track`: bearings and tool point over temperature."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.cli.common import FILE, option, refuse, say, show_warnings, write_json
from daemon.cli.dynamics.identify import vary_option
from daemon.cli.options import PLACE, POSITIVE, FiniteFloat, json_option, rotary_option, trust_option, writable

if TYPE_CHECKING:
    from config.machine.spindle import Rotary


@click.command()
@click.argument("folders", metavar="FRFS...", nargs=-1, required=True, type=FILE)
@option(
    "--temperatures",
    "recordings",
    metavar="RECORDING",
    multiple=True,
    required=True,
    type=FILE,
    help="Recording of the temperatures (CSV), one for each folder.",
)
@option(
    "--spindle",
    "spindle_path",
    metavar="SPINDLE.yaml",
    type=FILE,
    help="Spindle that was hit: a file or a shipped name. Without: spindle.yaml in the first folder.",
)
@rotary_option
@option(
    "--config",
    "-c",
    "config_path",
    type=FILE,
    help="Configuration whose labels name the sensors T1, T2 ...; without: the columns themselves are the signals.",
)
@option("--signals", metavar="A,B,...", help="Signals to regress on. Without: chosen by correlation.")
@option("--from-hz", type=POSITIVE, help="Lowest frequency used [Hz].")
@option("--to-hz", type=POSITIVE, help="Highest frequency used [Hz]; up to where the beam model holds.")
@trust_option
@option("--bounds", "bounds_path", metavar="FILE", type=FILE, help="Physical bounds (YAML).")
@option(
    "--least-squares", is_flag=True, help="Plain least squares on all thirteen variables, as published; no penalty."
)
@option(
    "--only-five",
    is_flag=True,
    help="Leave out the series of 7 and 12 parameters (with --vary: of all), which take longer.",
)
@vary_option
@option("--model", "model_path", metavar="FILE", type=FILE, callback=writable(), help="Write the model (JSON).")
@option("--report", "report_path", metavar="FILE", type=FILE, callback=writable(".html"), help="Write a report (HTML).")
@json_option
def campaign(
    folders: tuple[Path, ...],
    recordings: tuple[Path, ...],
    spindle_path: Path | None,
    rotary: "Rotary | None",
    config_path: Path | None,
    signals: str | None,
    from_hz: float | None,
    to_hz: float | None,
    trust_units: bool,
    bounds_path: Path | None,
    least_squares: bool,
    only_five: bool,
    vary: tuple[str, ...],
    model_path: Path | None,
    report_path: Path | None,
    json_path: str | None,
) -> None:
    """Fit bearing properties on temperatures from impact tests at the nose.

    Each folder FRFS holds responses (CSV or universal files) and impacts.csv with the header `file,axis,time`: times
    as in the recording. Every response is identified, the series are interpolated to one minute, sensors and
    intervals are chosen, and the regressions are fitted.
    """
    from config.files import write_whole
    from config.loader import load_configuration
    from config.machine.published_bearings import load_bounds
    from config.machine.spindle_chain import found_file, read_spindle
    from daemon.cli.options import ProgressBar
    from daemon.workbench.dynamics.campaign import campaign_summary, read_run, run_campaign
    from daemon.workbench.dynamics.identifying import Band
    from models.thermomechanics.artifact import model_to_json

    if len(folders) != len(recordings):
        refuse(f"{len(folders)} folders need as many recordings, there are {len(recordings)}: repeat --temperatures")
    told = spindle_path or folders[0] / "spindle.yaml"
    configuration = None if config_path is None else load_configuration(config_path)
    spindle = read_spindle(told, rotary)
    bounds = load_bounds(bounds_path, tuple(dict.fromkeys(support.group for support in spindle.shaft.supports)))
    band = Band(from_hz=from_hz, to_hz=to_hz, trust_units=trust_units)
    runs = [read_run(*pair, configuration, band) for pair in zip(folders, recordings, strict=True)]
    with ProgressBar() as progress:
        result = run_campaign(
            runs,
            spindle,
            found_file(told),
            bounds,
            signals=[each.strip() for each in signals.split(",")] if signals else None,
            parameter_sets=(5,) if only_five else (5, 12) if vary else (5, 7, 12),
            vary=vary,
            least_squares=least_squares,
            progress=progress.show,
            trust_units=trust_units,
        )
    found = campaign_summary(result)
    show_warnings(found)
    say(f"signals: {', '.join(result.model.signals)}")
    for axis, each in found["axes"].items():
        say(f"axis {axis}: {each['responses']} responses, {each['minutes']} minutes")
        for name, fit in each["properties"].items():
            say(
                f"  {name:6} interval {fit['interval_min']:4.0f} min   adjusted R^2 {fit['adjusted_r2']:.4f}   "
                f"error on left-out stretches {fit['left_out_error']:.3f}"
            )
    if model_path is not None:
        write_whole(model_path, model_to_json(result.model))
    if report_path is not None:
        from daemon.workbench.dynamics.campaign_report import write_report

        write_report(report_path, result, spindle)
    write_json(json_path, found)


@click.command("simulate-campaign")
@click.argument("folder", metavar="FOLDER", type=FILE)
@option("--day", type=click.IntRange(0, 2**32 - 1), default=3, help="Seed of the simulated day.")
@option("--df", "step_hz", type=FiniteFloat(min=0.1, max=50.0), default=3.125, help="Step between frequencies [Hz].")
def simulate_campaign(folder: Path, day: int, step_hz: float) -> None:
    """Write an impact campaign on the simulated machine into FOLDER: responses, recording, spindle file."""
    from daemon.simulation.impact_campaign import write_campaign

    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        refuse(f"{folder} exists and is not an empty folder; name a new one")
    count, minutes = write_campaign(folder, day, step_hz)
    say(f"{folder}: {count} responses within {minutes:.0f} simulated minutes")


@click.command()
@click.argument("recording", metavar="RECORDING", type=FILE)
@option("--model", "model_path", metavar="FILE", type=FILE, help="Model of a campaign. Without: the published.")
@option("--spindle", "spindle_path", metavar="SPINDLE.yaml", type=FILE, required=True, help="Spindle with tool.")
@option("--spindle-y", "spindle_y_path", metavar="SPINDLE.yaml", type=FILE, help="Spindle along Y where it differs.")
@rotary_option
@option("--axis", type=click.Choice(["x", "y", "both"]), default="both", help="Machine axes.")
@option("--at", type=PLACE, default="tool", help="Where to look.")
@option("--config", "-c", "config_path", type=FILE, help="Configuration whose labels name T1, T2 ...")
@option("--near-hz", type=POSITIVE, help="Follow the resonance nearest to this [Hz]. Without: the highest.")
@option("--every-min", type=POSITIVE, default=1.0, help="Results apart [min].")
@option(
    "--report",
    "report_path",
    metavar="FILE",
    type=FILE,
    callback=writable(".html"),
    help="Write the curves over time (HTML).",
)
@json_option
def track(
    recording: Path,
    model_path: Path | None,
    spindle_path: Path,
    spindle_y_path: Path | None,
    rotary: "Rotary | None",
    axis: str,
    at: str,
    config_path: Path | None,
    near_hz: float | None,
    every_min: float,
    report_path: Path | None,
    json_path: str | None,
) -> None:
    """Follow the resonance of the tool point through a RECORDING of temperatures, as the daemon would."""
    from config.loader import load_configuration
    from config.machine.published_bearings import published_model
    from config.machine.spindle_chain import read_spindle
    from daemon.cli.options import ProgressBar
    from daemon.workbench.dynamics.campaign import read_temperatures
    from daemon.workbench.dynamics.responses import ResponseError, parts_at
    from daemon.workbench.dynamics.tracking import track_recording, tracking_summary, write_tracking_page
    from models.thermomechanics.artifact import model_from_json

    files = {"x": spindle_path, "y": spindle_y_path or spindle_path}
    try:
        configuration = None if config_path is None else load_configuration(config_path)
        model = published_model()
        if model_path is not None:
            model = model_from_json(model_path.read_text(encoding="utf-8"), str(model_path))
        wanted = [each for each in files if axis in (each, "both") and (axis != "both" or each in model.axes)]
        spindles = {each: read_spindle(files[each], rotary) for each in wanted}
        for each, spindle in spindles.items():
            parts_at(spindle, at)
            if not spindle.shaft.supports:
                refuse(f"{files[each]}: describes no bearings")
        temperatures = read_temperatures(recording, configuration)
        with ProgressBar() as progress:
            day = track_recording(temperatures, model, spindles, at, near_hz, every_min, progress.show)
    except OSError as error:
        refuse(f"{error.filename}: cannot be opened ({error.strerror})")
    except UnicodeDecodeError:
        refuse(f"{model_path}: is not text; a model is JSON")
    except ResponseError as error:
        refuse(f"{spindle_path}: {error}")
    found = tracking_summary(day)
    show_warnings(found)
    for name, told in found["axes"].items():
        hz = told["resonance_hz"]
        say(
            f"axis {name}: {hz[0]:.1f} Hz at first, {min(hz):.1f} to {max(hz):.1f} Hz, {hz[-1]:.1f} Hz at last; "
            f"{sum(not each for each in told['continuous'])} of {len(hz)} lost"
        )
    if report_path is not None:
        write_tracking_page(report_path, day)
    write_json(json_path, found)
