"""`toolpoint model`: release thermal models and bearing models, list them, go back to an earlier one."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command_group import Group
from daemon.cli.common import FAILED, config_option, option, read_configuration, refuse, say, write_json
from daemon.cli.operate.history_view import duration
from daemon.cli.options import NOT_A_FOLDER, POSITIVE, json_option

if TYPE_CHECKING:
    from config.records.release_record import ReleaseRecord
    from daemon.model_release.releasing import Kind

note_option = option("--note", default="", help="Why, for the record.", show_default=False)
bearings_option = option(
    "--bearings", is_flag=True, help="The bearing model of the spindle speed, not the thermal model."
)


def _kind(bearings: bool) -> "Kind":
    from daemon.model_release.bearings import BEARINGS
    from daemon.model_release.releasing import THERMAL

    return BEARINGS if bearings else THERMAL


@click.group(cls=Group)
def model() -> None:
    """Released models: who released which, and the way back.

    Thermal models, or with --bearings the model of the bearings that the spindle speed follows. Run these as an
    account that may write the folder of compensation.model_file or spindle_speed.thermomechanical_model. The
    daemon's may not. The daemon takes a newly released thermal model up when it is started or reloaded, and a
    bearing model when it is started.
    """


@model.command("release")
@click.argument("proposal", required=False, type=NOT_A_FOLDER)
@option("--by-policy", is_flag=True, help="Release the newest proposal that the policy lets through.")
@option(
    "--trained-on",
    default="",
    metavar="NAME",
    help="Another machine, on which it was trained: you answer for it that it serves this one too.",
    show_default=False,
)
@bearings_option
@note_option
@config_option
@json_option
def release_command(
    proposal: Path | None,
    by_policy: bool,
    trained_on: str,
    bearings: bool,
    note: str,
    config_path: Path,
    json_path: str | None,
) -> None:
    """Check PROPOSAL (a model's file, or its name among the proposals) and make it the active model.

    Checked are checksum, test vectors, sensors and channels, the width of the prediction bands, and the machine that
    it was trained on where its recordings name one; of a bearing
    model checksum, signals, and whether the spindles and cases of the configured operations fit it.
    """
    from daemon.model_release.releasing import (
        person_now,
        proposal_named,
        release,
        release_by_policy,
        why_proposals_are_hidden,
    )
    from daemon.model_release.repository import ReleaseError

    if (proposal is None) != by_policy:
        raise click.UsageError("name one PROPOSAL, or let --by-policy choose one")
    if by_policy and bearings:
        raise click.UsageError("the policy knows thermal models alone; a person releases a bearing model")
    if trained_on and (by_policy or bearings):
        raise click.UsageError("--trained-on is a person's word on one thermal model: name its PROPOSAL")
    configuration = read_configuration(config_path)
    try:
        if proposal is None:
            record = release_by_policy(configuration, person=f"policy, run by {person_now()}")
        else:
            kind = _kind(bearings)
            kind.repository(configuration)  # without a place for models the file matters not
            path = proposal_named(configuration, proposal)
            if not os.path.lexists(path):
                hidden = why_proposals_are_hidden(configuration) or "`toolpoint model list` shows what waits"
                refuse(f"{path}: there is no such file; {hidden}")
            record = release(configuration, path, person=person_now(), note=note, kind=kind, trained_on=trained_on)
    except (ReleaseError, OSError) as error:
        refuse(str(error), FAILED)
    if record is None:
        say("no proposal that the policy lets through; `toolpoint model list` shows what waits")
        write_json(json_path, None)
        return
    for check in record.checks:
        say(f"checked: {check}")
    _done(record, bearings, json_path)


@model.command()
@option("--to", "number", type=click.IntRange(min=1), help="The release to go back to (else the one before).")
@bearings_option
@note_option
@config_option
@json_option
def rollback(number: int | None, bearings: bool, note: str, config_path: Path, json_path: str | None) -> None:
    """Make an earlier release the active model again, under a new number."""
    from daemon.model_release import releasing
    from daemon.model_release.repository import ReleaseError

    configuration = read_configuration(config_path)
    try:
        kind, person = _kind(bearings), releasing.person_now()
        record = releasing.rollback(configuration, person=person, to=number, note=note, kind=kind)
    except (ReleaseError, OSError) as error:
        refuse(str(error), FAILED)
    _done(record, bearings, json_path)


def _done(record: "ReleaseRecord", bearings: bool, json_path: str | None) -> None:
    taken_up = "at its next start" if bearings else "with `systemctl reload toolpoint`, or at its next start"
    say(
        f"release {record.number}: {record.model_id}, sha256 {record.sha256[:12]}, by {record.person}; the daemon "
        f"takes it up {taken_up}"
    )
    write_json(json_path, record.model_dump(mode="json"))


@model.command("list")
@bearings_option
@config_option
@json_option
def list_command(bearings: bool, config_path: Path, json_path: str | None) -> None:
    """Show every release, which one is active, and the proposals that wait (there are none of bearing models)."""
    from daemon.model_release.releasing import proposals, why_proposals_are_hidden
    from daemon.model_release.repository import ReleaseError

    configuration = read_configuration(config_path)
    active, problem = None, ""
    repository = _kind(bearings).repository(configuration)
    try:
        active = repository.active()
    except (ReleaseError, OSError) as error:
        problem = str(error)
    records, waiting = repository.records(), () if bearings else proposals(configuration)
    number = active.number if active is not None else None
    write_json(
        json_path,
        {
            "active": number,
            "problem": problem,
            "releases": [record.model_dump(mode="json") for record in records],
            "proposals": [
                {"path": str(p.path), "model_id": p.model_id, "sha256": p.sha256, "inhibit": p.inhibit}
                | {"obstacle": p.inhibit}  # its name in 0.1.0
                for p in waiting
            ],
        },
    )
    for record in records if json_path is None else ():
        mark = "*" if record.number == number else " "
        click.echo(
            f"{mark} {record.number:4d}  {record.released}  {record.action:8}  {record.model_id}  "
            f"{record.sha256[:12]}  {record.person}  {record.note}".rstrip()
            + ("" if repository.holds(record.number) else "  (its model was removed)")
        )
    if not records and json_path is None:
        click.echo("no model has been released")
    if json_path is None and not bearings and (hidden := why_proposals_are_hidden(configuration)):
        say(hidden)
    released = {record.sha256: f"is release {record.number}" for record in records}
    for proposal in waiting if json_path is None else ():
        fares = released.get(proposal.sha256, "waits")
        click.echo(
            f"  {fares}  {proposal.path}: {proposal.model_id}  {proposal.sha256[:12]}  {proposal.inhibit}".rstrip()
        )
    if problem:
        refuse(problem)


@model.command()
@config_option
@json_option
def propose(config_path: Path, json_path: str | None) -> None:
    """Train a model on the daemon's own history and put it among the proposals.

    Displacements count without what the NC applied. compensation.retraining says how far back, and
    which family; with that section the daemon does this by itself now and then.
    """
    from config.schema.compensation import RetrainingConfig
    from daemon.model_release.retraining import propose_from_history

    configuration = read_configuration(config_path)
    try:
        made = propose_from_history(configuration, configuration.compensation.retraining or RetrainingConfig())
    except OSError as error:
        refuse(f"{configuration.history.path.parent}: the proposal cannot be written ({error.strerror})")
    say(f"{made['path']}: {made['model_id']}, {made['hours']:g} h in {made['recordings']} stretches")
    if made["refused"]:
        say(f"its training refuses it: {made['refused']}")
    write_json(json_path, made)


@model.command()
@config_option
@option(
    "--last",
    "last_s",
    callback=duration,
    default="400d",
    help="How far back from the record written last; a model younger than this is judged by its first weeks too.",
)
@option("--bound", type=POSITIVE, help="Share of the error that may be left. Without: what loses a fifth of its worth.")
@json_option
def drift(config_path: Path, last_s: float, bound: float | None, json_path: str | None) -> None:
    """Say from what was measured how the error that models leave grows, and whether to train anew (then status 1)."""
    import time
    from collections import Counter

    from daemon.history.reader import HistoryReader
    from daemon.model_release.model_errors import drift_document, in_force, measured_errors
    from daemon.model_release.past_recordings import commissioned_um_per_unit
    from models.json_values import plain

    configuration = read_configuration(config_path)
    units = commissioned_um_per_unit(configuration)
    unjudged: Counter[tuple[str, str]] = Counter()
    with HistoryReader(configuration.history.path) as reader:
        last = map(reader.last_written_utc_s, ("temperatures", "cnc", "probes"))
        newest_s = max(filter(None, last), default=time.time())  # a replay's store is of another time
        until_s = newest_s + 1.0
        span_s = {"from_utc_s": until_s - last_s, "to_utc_s": until_s}
        errors = measured_errors(configuration, reader, units, **span_s, unjudged=unjudged)
    least_um = configuration.compensation.output.harm_above_um
    found = drift_document(errors, bound=bound, least_error_um=least_um)
    lost = [{"axis": axis, "values": count, "why": why} for (axis, why), count in unjudged.items()]
    write_json(json_path, {"models": plain(found), "not_judged": lost})
    for each in lost:
        what = f"{each['values']} probe values or minutes of displacements"
        say(f"axis {each['axis']}: {what} are not judged: {each['why']}")
    for each in found if json_path is None else ():
        click.echo(_drift_in_words(each))
    if not found:
        say(
            "of this time there are no probe values that were accepted under a reference and a model, and no two hours "
            "of displacements with a model, so there is nothing to judge by"
        )
    if any(each["retrain"] for each in in_force(found)):
        raise SystemExit(FAILED)


def _weeks(count: int) -> str:
    return {0: "no whole week is", 1: "1 week is"}.get(count, f"{count} weeks are")


def _drift_in_words(found: dict[str, Any]) -> str:
    """Return one axis and model in a line."""
    from models.thermal.drift import LEAST_WEEKS

    what = f"{found['values']} {'probe values' if found['source'] == 'probe' else 'minutes of displacements'}"
    head, told = f"axis {found['axis']}, model {found['model_id']}: {what}", found["drift"]
    if told is None:
        return f"{head}; {_weeks(len(found['weeks']))} too few; it takes {LEAST_WEEKS} to ask for training"
    low, high = (100.0 * each for each in told["share_interval"])
    until = told["until_bound_d"]
    ahead = "does not come nearer" if until is None else f"is reached in {until:.0f} d" if until else "is passed"
    asks = "; train it anew" if found["retrain"] else ""
    return (
        f"{head}; leaves {100 * told['share']:.0f} % ({low:.0f} to {high:.0f} %) of the error, at first "
        f"{100 * told['first_share']:.0f} %; the bound of {100 * told['bound']:.0f} % {ahead}{asks}"
    )
