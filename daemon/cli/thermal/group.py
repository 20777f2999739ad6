"""`toolpoint thermal`: thermal models from recordings."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from daemon.cli.command_group import Group
from daemon.cli.common import CONFIGURATION_VARIABLE, DEFAULT_CONFIGURATION, FILE, option, refuse, say, write_json
from daemon.cli.options import POSITIVE, ProgressBar, common_columns_option, hours_option, json_option, writable
from daemon.cli.thermal.campaign import campaign
from daemon.cli.thermal.evaluate import MODELS, evaluate, settings_text
from daemon.cli.thermal.report import report
from daemon.cli.thermal.sensors import sensors

if TYPE_CHECKING:
    from config.recordings.recording_map import RecordingMap

MOST_WARNINGS = 10
AUTO: Literal["auto"] = "auto"


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


def _ridge(ctx: click.Context, param: click.Parameter, value: str | None) -> float | Literal["auto"] | None:
    if value is None or value == AUTO:
        return None if value is None else AUTO
    try:
        penalty = float(value)
    except ValueError:
        raise click.BadParameter(f"{value!r} is neither a number nor {AUTO}") from None
    if not 0.0 < penalty < float("inf"):
        raise click.BadParameter(f"{value!r}: a penalty is positive; leave --ridge out for ordinary least squares")
    return penalty


@click.group(cls=Group)
def thermal() -> None:
    """Thermal models: train them from recordings, evaluate them, and compare sensors."""


thermal.add_command(campaign)
thermal.add_command(evaluate)
thermal.add_command(figures)
thermal.add_command(report)
thermal.add_command(sensors)


@thermal.command()
@click.argument("recordings", nargs=-1, type=FILE)
@option("--map", "map_path", type=FILE, help="What the columns mean (YAML).")
@option(
    "--model",
    "family",
    type=click.Choice(MODELS),
    help="Family of models. Without: default, which takes the one that the recordings support best; or the model of "
    "increments as --interval-min, --ridge, --b0 and --split-at-speed say, where one of them is given.",
)
@option("--prior", "prior_path", type=FILE, help="Take over what a type knows: the file of `toolpoint fleet train`.")
@option(
    "--config",
    "-c",
    "config_path",
    type=FILE,
    default=DEFAULT_CONFIGURATION,
    envvar=CONFIGURATION_VARIABLE,
    help="With --prior: the machine's configuration, which says where its sensors sit.",
)
@hours_option("--hours", help="Train on these hours of each recording only.")
@option("--interval-min", type=POSITIVE, help="Interval of the increments [min]. Without: 1.")
@option("--ridge", metavar="X|auto", callback=_ridge, help="Ridge penalty [K^2]; auto chooses it. Without: none.")
@option("--b0/--no-b0", "intercept", default=False, help="Fit a drift with time.")
@option("--channels", help="Displacement channels, separated by commas. Without: all.")
@common_columns_option
@option("--without", multiple=True, metavar="NAME", help="Leave the recording of this file name out; may be repeated.")
@option("--recent", type=click.IntRange(min=1), help="Train on the last so many of the recordings alone.")
@option("--split-at-speed", is_flag=True, help="Take no difference across a change of spindle speed.")
@option("--map-out", type=FILE, callback=writable(), help="Write the proposed map here, and train with it.")
@option("-o", "--output", required=True, type=FILE, help="The model's file.")
@json_option
def train(
    recordings: tuple[Path, ...],
    map_path: Path | None,
    family: str | None,
    prior_path: Path | None,
    config_path: Path,
    hours: tuple[float, float] | None,
    interval_min: float | None,
    ridge: float | Literal["auto"] | None,
    intercept: bool,
    channels: str | None,
    common_columns: bool,
    without: tuple[str, ...],
    recent: int | None,
    split_at_speed: bool,
    map_out: Path | None,
    output: Path,
    json_path: str | None,
) -> None:
    """Train a thermal model on RECORDINGS, each a run of its own.

    What must be chosen is chosen by leaving out whole recordings, or whole stretches of a single one. Without --map,
    columns must carry the usual names; where they do not, a map is proposed. With --prior there may be no recording.
    """
    from config.recordings.recording_map import load_recording_map
    from daemon.workbench.thermal.prior import read_machine_type, train_with_prior
    from daemon.workbench.thermal.reading import columns_left_out, names_of
    from daemon.workbench.thermal.training import (
        Selection,
        increments_summary,
        kept_paths,
        summary,
        train_from_files,
        write_model_file,
    )
    from models.thermal.training.increment_family import IncrementChoices
    from models.thermal.training.recipes import increment_recipe

    if not output.parent.is_dir():
        refuse(f"{output}: there is no folder {output.parent}")
    of_increments = interval_min is not None or ridge is not None or intercept or split_at_speed
    if family is not None and of_increments:
        raise click.UsageError("--model chooses by itself; leave out --interval-min, --ridge, --b0, --split-at-speed")
    if prior_path is not None and (family is not None or of_increments):
        raise click.UsageError("--prior says what is fitted; leave out --model and the options of the increments")
    if prior_path is None and not recordings:
        raise click.UsageError("Missing argument 'RECORDINGS...': only --prior can do without")
    if not recordings and (map_path or hours or channels or common_columns or without or recent or map_out):
        raise click.UsageError("without recordings the type says everything; leave out what chooses among recordings")
    if family is None and not of_increments:
        family = MODELS[0]
    choices = IncrementChoices(
        interval_min=interval_min or 1.0, intercept=intercept, ridge_k2=ridge, split_at_speed_changes=split_at_speed
    )
    try:
        recording_map = None
        if recordings:
            recording_map = load_recording_map(map_path) if map_path is not None else _proposed(recordings[0], map_out)
        selection = Selection(
            hours=hours, channels=_names(channels), common_columns=common_columns, without=without, recent=recent
        )
        with ProgressBar() as bar:
            if prior_path is not None:
                of_type = read_machine_type(prior_path)
                result = train_with_prior(recordings, recording_map, selection, of_type, config_path, bar.show)
            else:
                recipe = increment_recipe(choices) if family is None else family
                result = train_from_files(recordings, recording_map, selection, recipe, bar.show)
        write_model_file(result.model, output)
    except OSError as error:
        refuse(f"{output}: the model cannot be written ({error.strerror})")
    found = increments_summary(result, output) if family is None else summary(result, output)
    kept = kept_paths(recordings, selection) if recordings else recordings
    called = zip(recordings, names_of(recordings), strict=True)
    found["recordings_left_out"] = [name for path, name in called if path not in kept]
    found["columns_left_out"] = columns_left_out(kept, recording_map) if common_columns else []
    _show(found)
    if family is None:
        say("this is the model of increments; without its options the family is taken that the recordings support best")
    write_json(json_path, found)


def _proposed(recording: Path, map_out: Path | None) -> "RecordingMap | None":
    """Return the map that a recording's columns suggest; None where none is wished or lacking, else it ends with it."""
    from config.files import write_whole
    from daemon.workbench.thermal.reading import proposal

    found, unread = proposal(recording)
    if unread is not None and map_out is None:
        if unread:
            names = ", ".join(map(repr, unread))
            say(f"warning: not read, for want of a usual name: {names}; --map-out map.yaml writes a map that reads it")
        return None
    if map_out is None or found.lacking:
        click.echo(found.yaml(), nl=False)
        lacks = f"none seems to be its {', '.join(found.lacking)}; " if found.lacking else ""
        if len({"temperatures", "displacements"} & {*found.lacking}) == 1:
            lacks += "where another file holds these, join the two by time first; "
        as_it_is = "" if found.lacking else ", or take it as it is with --map-out map.yaml"
        refuse(
            f"{recording}: columns without usual names; {lacks}check this map, save it, give it with --map{as_it_is}"
        )
    if map_out.is_file() and map_out.read_text(encoding="utf-8", errors="replace") != found.yaml():
        refuse(f"{map_out}: is there already, and differs from what would be proposed; use it with --map, or delete it")
    write_whole(map_out, found.yaml())
    say(f"{map_out}: what the columns of {recording.name} seem to be; check it")
    for note in found.notes:
        say(f"warning: {note}")
    if found.left_out:
        names = found.named_left_out()
        say(f"not used, because the names do not say what they are: {names}; add what is a temperature to {map_out}")
    return found.recording_map


def _names(channels: str | None) -> tuple[str, ...] | None:
    if channels is None:
        return None
    return tuple(name.strip() for name in channels.split(",") if name.strip())


def _without_channels(found: dict[str, Any]) -> str:
    """Return what is known of a model where nothing of the machine could be left out."""
    held_out, refused = found["held_out"], found["refused"]
    if held_out["folds"] != "machine":
        return "nothing could be left out, so it is not known how good this model is: record longer"
    remains = held_out["relative_rmse"]
    told = "is not known" if remains is None else f"is {remains:.0%} on machines that were left out"
    what = f"of this machine nothing is known; what the mean of the others leaves of the error {told}"
    return what if refused is None else f"{what}; refused: {refused}; do not use it"


def _chosen_without(chosen: dict[str, Any] | None, remains: float) -> str:
    """Return what would remain had what was left out no say in members and shares, where that is another figure."""
    unseen = None if chosen is None else chosen["relative_rmse"]
    if unseen is None or f"{unseen:.1%}" == f"{remains:.1%}":
        return ""
    return f" with the model's members and shares, in which it had a say; had it none, {unseen:.1%} would"


def _show_sensors(ids: dict[str, int]) -> None:
    """Say which ID each sensor has, where its name does not tell it."""
    if any(name.upper().removeprefix("T") != str(number) for name, number in ids.items()):
        numbered = ", ".join(f"{number} is {name!r}" for name, number in ids.items())
        say(f"the machine's configuration must give these sensors the same IDs: {numbered}")


def _show_noticed_late(found: list[dict[str, Any]]) -> None:
    """Say which sensors the others tell too late to keep the band."""
    from models.recordings.findings import counted

    if found:
        worst = found[0]
        do = "does" if len(found) == 2 else "do"
        more = f"; so {do} {counted(len(found) - 1, 'other sensor')}" if len(found) > 1 else ""
        say(
            f"sensor {worst['sensor']} may drift by {worst['from_k']:.1f} K before the others tell, which makes "
            f"{worst['error_um']:.1f} um of {worst['channel']} where the band is {worst['band_um']:.1f} um{more}: "
            "another sensor beside it, or more recordings, would tell sooner"
        )


def _show(found: dict[str, Any]) -> None:
    """Write the outcome for people, on standard error."""
    from daemon.workbench.thermal.shortfalls import columns_sentences
    from models.recordings.findings import counted

    for warning in found["warnings"][:MOST_WARNINGS]:
        say(f"warning: {warning}")
    if len(found["warnings"]) > MOST_WARNINGS:
        say(f"warning: {len(found['warnings']) - MOST_WARNINGS} more of the kind")
    for name, why in found["temperatures_left_out"].items():
        say(f"temperature {name} is left out of the model: {why}")
    for sentence in columns_sentences(found["columns_left_out"]):
        say(sentence)
    model, held_out = found["model"], found["held_out"]
    used = f", {found['increments']['used']} increments" if "increments" in found else ""
    chosen = settings_text(found["hyper_parameters"])
    say(f"{model['file']}: {model['model_id']}, {counted(model['sensors'], 'sensor')}{used}, {chosen}")
    _show_sensors(model["sensor_ids"])
    if found["chosen"] is not None:
        say(f"chosen: {found['chosen']['family']}; {found['chosen']['why']}")
    if found["recordings_left_out"]:
        say(f"left out on request: {', '.join(found['recordings_left_out'])}")
    _show_noticed_late(found["noticed_late"])
    for sentence in found["advice"]:
        say(f"next: {sentence}")
    if not held_out["channels"]:
        say(_without_channels(found))
        return
    folds = held_out["folds"]
    say(f"left out in turn: {folds if isinstance(folds, str) else ', '.join(folds)}")
    if (remains := held_out["relative_rmse"]) is not None:
        say(f"{remains:.1%} of the error remains there{_chosen_without(found['chosen'], remains)}")
    width = max(len(name) for name in ("channel", *held_out["channels"]))
    say(f"{'channel':{width}} {'rmse without':>13} {'with':>8} {'max without':>12} {'with':>8}   [um]")
    for channel, reached in held_out["channels"].items():
        without, remaining = reached["without"], reached["with"]
        say(
            f"{channel:{width}} {without['rmse_um']:13.2f} {remaining['rmse_um']:8.2f} "
            f"{without['max_um']:12.2f} {remaining['max_um']:8.2f}"
        )
    if remains is not None and remains >= 1.0:
        say("warning: on what it had not seen this model is no better than none; do not use it")
    if found["refused"] is not None:
        say(f"refused: {found['refused']}; do not use it")
