"""`toolpoint thermal evaluate`: how good a family of models is on what it has not seen."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import click

from daemon.cli.common import FILE, option, say, write_json
from daemon.cli.options import POSITIVE, ProgressBar, common_columns_option, hours_option, json_option
from daemon.cli.pages import html_option, write_page

if TYPE_CHECKING:
    from models.thermal.training.trial import Fault

MODELS = ("default", "lags", "gaussian", "increments", "increments-b0", "ridge", "pls", "lasso")
FaultKind = Literal["stuck", "step", "open", "drift"]
AMOUNT = {"step": "degC", "drift": "degC/h"}
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
FORMS = "stuck:S@36h, step:S:5degC@36h, open:S@36h or drift:S:1degC/h@36h"


def _faults(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> "tuple[Fault, ...]":
    return tuple(parse_fault(text) for text in value)


def parse_fault(text: str) -> "Fault":
    """Return the fault that a text such as `step:t3:5degC@36h` means; raises click.BadParameter."""
    from models.thermal.training.trial import Fault

    kind, _, rest = text.partition(":")
    what, _, when = rest.rpartition("@")
    hours = re.fullmatch(rf"({NUMBER})h", when)
    if kind not in get_args(FaultKind) or not what or hours is None:
        raise click.BadParameter(f"{text!r} is no fault; write {FORMS} (S may be each)")
    sensor, amount = what, 0.0
    if unit := AMOUNT.get(kind):
        sensor, _, number = what.rpartition(":")
        found = re.fullmatch(rf"({NUMBER}){unit}", number)
        if not sensor or found is None:
            raise click.BadParameter(f"{text!r}: a {kind} needs an amount such as 1{unit}; write {FORMS}")
        amount = float(found[1])
    return Fault(kind=kind, sensor=sensor, at_hours=float(hours[1]), amount=amount)  # type: ignore[arg-type]


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=FILE)
@option("--map", "map_path", type=FILE, help="What the columns mean (YAML).")
@option("--model", type=click.Choice(MODELS), default=MODELS[0], help="Family of models.")
@hours_option("--train-hours", help="Train on these hours of each recording.")
@hours_option("--test-hours", help="Test these hours of each recording, as one run with one reference at its start.")
@option(
    "--leave-out-cycles",
    is_flag=True,
    help="Test each spindle cycle, or each twelfth of many, on a model of the others.",
)
@option("--leave-out-runs", is_flag=True, help="Test each recording on a model of the others.")
@common_columns_option
@option("--probe-minutes", type=POSITIVE, help="A probe resets the offset so often [min].")
@option(
    "--fault",
    "faults",
    multiple=True,
    callback=_faults,
    metavar="KIND:S[:AMOUNT]@Hh",
    help=f"A sensor fails during the test: {FORMS}; S each: every sensor in turn.",
)
@html_option
@json_option
def evaluate(
    recordings: tuple[Path, ...],
    map_path: Path | None,
    model: str,
    train_hours: tuple[float, float] | None,
    test_hours: tuple[float, float] | None,
    leave_out_cycles: bool,
    leave_out_runs: bool,
    common_columns: bool,
    probe_minutes: float | None,
    faults: "tuple[Fault, ...]",
    html_path: Path | None,
    json_path: str | None,
) -> None:
    """Fit a family of models on part of RECORDINGS and test it on the rest.

    Every choice (penalties, limits, bands) is made on the training part by leaving whole cycles,
    runs or blocks out.
    """
    from config.recordings.recording_map import load_recording_map
    from daemon.workbench.thermal.evaluation import Protocol, read_recordings
    from daemon.workbench.thermal.evaluation import evaluate as evaluated
    from daemon.workbench.thermal.reading import columns_left_out, names_of
    from daemon.workbench.thermal.result_pages import Stretch, evaluation_page

    leave_out = _protocol(train_hours, test_hours, leave_out_cycles, leave_out_runs)
    recording_map = None if map_path is None else load_recording_map(map_path)
    protocol = Protocol(
        train_hours=train_hours, test_hours=test_hours, leave_out=leave_out, probe_min=probe_minutes, faults=faults
    )
    with ProgressBar() as bar:
        read, warnings = read_recordings(recordings, recording_map, bar.show, common=common_columns)
        sample_s = 60.0 if recording_map is None else recording_map.sample_s
        stretches: list[Stretch] = []
        found = evaluated(read, sample_s, model, protocol, bar.show, stretches)
    found["warnings"] = list(warnings)
    found["columns_left_out"] = columns_left_out(recordings, recording_map) if common_columns else []
    if html_path is not None:
        title = f"{model} on {', '.join(names_of(recordings)[:3])}{' ...' * (len(recordings) > 3)}"
        write_page(html_path, evaluation_page(title, found, stretches))
    _show(found)
    write_json(json_path, found)


def _protocol(
    train_hours: tuple[float, float] | None,
    test_hours: tuple[float, float] | None,
    leave_out_cycles: bool,
    leave_out_runs: bool,
) -> str | None:
    if leave_out_cycles and leave_out_runs:
        raise click.UsageError("choose --leave-out-cycles or --leave-out-runs, not both")
    if leave_out_cycles or leave_out_runs:
        if test_hours is not None:
            raise click.UsageError("--test-hours does not go with leaving out in turn; what is left out is the test")
        return "cycles" if leave_out_cycles else "runs"
    if train_hours is None or test_hours is None:
        raise click.UsageError("say --train-hours and --test-hours, or --leave-out-cycles, or --leave-out-runs")
    return None


def _show(found: dict[str, Any]) -> None:
    """Write the figures for people, on standard error."""
    from daemon.workbench.thermal.result_pages import called
    from daemon.workbench.thermal.shortfalls import (
        columns_sentences,
        false_alarm_sentences,
        fault_sentences,
        temperature_sentences,
    )

    for warning in found["warnings"][:10]:
        say(f"warning: {warning}")
    for sentence in (*columns_sentences(found["columns_left_out"]), *temperature_sentences(found["tests"])):
        say(sentence)
    several = len(found["tests"]) > 1
    settings = f"{len(found['tests'])} trainings; --json has the settings of each" if several else ""
    say(f"model {found['model']}: {settings or settings_text(found['hyper_parameters'])}")
    for family, why in {c["chosen"]["family"]: c["chosen"]["why"] for c in found["channels"].values()}.items():
        say(f"chosen: {family}; {why}")
    width = max(len(called(name, figures)) for name, figures in (("channel", {}), *found["channels"].items()))
    say(
        f"{'channel':{width}} {'rmse':>7} {'max':>7} [um] {'reduction':>10} {'of max':>7} {'on line':>8} "
        f"{'band':>7} [um] covers"
    )
    for name, figures in (*found["channels"].items(), ("mean", found["mean"])):
        online = (figures["online"] or {}).get("reduction_rmse")
        say(
            f"{called(name, figures):{width}} {_text(figures['rmse_um'], '7.2f')} "
            f"{_text(figures['max_um'], '7.2f')}      "
            f"{_text(figures['reduction_rmse'], '10.1%')} {_text(figures['reduction_max'], '7.1%')} "
            f"{_text(online, '8.1%')} "
            f"{_text(figures['band_width_um'], '7.2f')}      {_text(figures['band_coverage'], '.0%')}"
        )
    if (confidence := found["mean"]["online"]["mean_confidence"]) is not None:
        say(
            f"on line, weighed by confidence as the daemon does it: {_text(online, '.1%')} "
            f"at a mean confidence of {confidence:.2f}"
        )
    for sentence in found["advice"]:
        say(f"next: {sentence}")
    for sentence in (*fault_sentences(found["faults"]), *false_alarm_sentences(found["tests"])):
        say(sentence)
    if found["refused"] is not None:
        say(f"refused: {found['refused']}")


def _text(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def settings_text(hyper_parameters: dict[str, Any]) -> str:
    """Return what was chosen inside training on one line, for people; the rest stands in the JSON."""
    hidden = ("tried", "left_out_relative_rmse", "family", "gaussian")
    return _compact({key: value for key, value in hyper_parameters.items() if not key.startswith(hidden)})


def _compact(values: dict[str, Any]) -> str:
    def one(value: Any) -> str:
        if isinstance(value, list):
            return "[" + ", ".join(map(one, value)) + "]"
        if isinstance(value, dict):
            return "{" + _compact(value) + "}"
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    return ", ".join(f"{key} {one(value)}" for key, value in values.items())
