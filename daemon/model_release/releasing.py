"""Releases a proposed model, goes back to an earlier one, or lets the policy decide."""

import os
import pwd
import stat
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

from config.files import sha256_of
from config.records.release_record import PreviousRelease, ReleaseRecord
from config.schema import Configuration
from config.signing import SigningError, TrustedKeys
from config.signing_key import SigningKey
from daemon.model_release.active import proposals_folder
from daemon.model_release.file_access import account_of_daemon, how_it_could_change
from daemon.model_release.gate import (
    channels_in_use,
    inputs_inhibit,
    inputs_now,
    inputs_of,
    machine_inhibit,
    read_otherwise,
)
from daemon.model_release.loading import Named, model_from_text
from daemon.model_release.release_checks import gate_inhibit, policy_inhibit
from daemon.model_release.repository import ReleaseError, ReleaseRepository
from models.errors import RefusedInputError
from models.thermal.family import ThermalModel
from models.thermal.model import READS

LARGEST_MODEL = 64 * 2**20
"""No model comes near this [byte]."""
NO_LOGIN = 2**32 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of model that is released: where, and what is checked before."""

    repository: Callable[[Configuration], ReleaseRepository]
    """Raises RefusedInputError without a configured place."""
    checked: Callable[[Configuration, bytes, str], tuple[Named, list[str]]]
    """Return the model that bytes hold, and what was found good; raises ReleaseError."""
    inputs: Callable[[Any], Iterable[str]]
    """Return what `inputs_now` calls what a model takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """A model that waits for its release."""

    path: Path
    model_id: str
    sha256: str
    inhibit: str
    """Why it would be refused now, '' when it would not."""
    model: ThermalModel | None
    """None where its file cannot be read as one."""


def person_now() -> str:
    """Return who runs this program; behind sudo, who logged in."""
    uid = os.getuid()
    if uid != 0:
        return _named(uid)
    for behind in (_login_uid(), os.environ.get("SUDO_UID", "")):
        if behind.isdigit() and int(behind) not in (0, NO_LOGIN):
            return f"{_named(int(behind))} as root"
    return _named(uid)


def _login_uid() -> str:
    try:
        return Path("/proc/self/loginuid").read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _named(uid: int) -> str:
    try:
        return f"{pwd.getpwuid(uid).pw_name} (uid {uid})"
    except KeyError:
        return f"unknown (uid {uid})"


def repository_of(configuration: Configuration) -> ReleaseRepository:
    """Return the machine's repository of releases; raises RefusedInputError without a configured place."""
    if configuration.compensation.model_file is None:
        raise RefusedInputError("compensation.model_file is not set, so there is no place for a released model")
    return ReleaseRepository(configuration.compensation.model_file)


def release(
    configuration: Configuration,
    proposal: Path,
    *,
    person: str,
    note: str = "",
    by_policy: bool = False,
    kind: Kind | None = None,
    trained_on: str = "",
) -> ReleaseRecord:
    """Check a proposal and make it the active model of its kind (None: thermal); raises ReleaseError.

    `trained_on`: another machine, of which a person says that a model that was trained on it serves this one too.
    """
    kind = kind or THERMAL
    repository, key = kind.repository(configuration), _key(configuration)
    content = _content(proposal)
    model, checks = kind.checked(configuration, content, str(proposal))
    _refuse_another_machine(kind, model, configuration, str(proposal), trained_on)
    with repository.locked():
        active = repository.active()
        _refuse_the_daemons_reach(configuration, repository)
        same = active is not None and active.sha256 == sha256_of(content) and trained_on in ("", active.trained_on)
        if active is not None and same and not inputs_inhibit(active, configuration):
            raise ReleaseError(f"{proposal}: this model is active already, as release {active.number}")
        if twin := [r for r in repository.records() if r.model_id == model.model_id and r.sha256 != sha256_of(content)]:
            raise ReleaseError(
                f"{proposal}: release {twin[0].number} is another model of the same name {model.model_id}; audit and "
                "history could not tell them apart: train it again, or give it another model_id"
            )
        if by_policy:
            proposed, _ = _checked(configuration, content, str(proposal))
            before = _checked_release(configuration, repository, active)
            inhibit = read_otherwise(proposed, configuration)
            if READS not in proposed.hyper_parameters:  # then it may be as old as the active model
                inhibit = inputs_inhibit(active, configuration)
            if inhibit := inhibit or policy_inhibit(proposed, before, configuration):
                raise ReleaseError(f"{proposal}: {inhibit}")
            checks.append("its bands are not wider than the active model's")
        record = _record(
            repository, "release", model, content, person=person, source=str(proposal), note=note, checks=checks
        )
        now, names = inputs_now(configuration), kind.inputs(model)
        reads = {name: now[name] for name in names if name in now}
        record = record.model_copy(update={"trained_on": trained_on, "reads": reads})
        return repository.add(record, content, key)


def _refuse_another_machine(
    kind: Kind, model: Named, configuration: Configuration, source: str, trained_on: str
) -> None:
    """Refuse a thermal model of a machine that is neither this nor the one that a person has named."""
    if kind is THERMAL and (inhibit := machine_inhibit(cast("ThermalModel", model), configuration, trained_on)):
        raise ReleaseError(f"{source}: {inhibit}")


def _key(configuration: Configuration) -> SigningKey | None:
    """Return the key of this account, before anything is checked; raises ReleaseError where it has none that counts."""
    try:
        return SigningKey.of_this_account(TrustedKeys.read(configuration.signatures.public_keys), "release record")
    except SigningError as error:
        raise ReleaseError(str(error)) from error


def release_by_policy(configuration: Configuration, *, person: str) -> ReleaseRecord | None:
    """Release the newest proposal that the policy lets through; None when there is none."""
    if not configuration.compensation.release.automatic:
        raise ReleaseError(
            "compensation.release.automatic is false: only a person releases a model, by `toolpoint model release FILE`"
        )
    _key(configuration)
    known = {record.sha256 for record in repository_of(configuration).records()}
    for proposal in reversed(proposals(configuration)):
        if proposal.inhibit or proposal.sha256 in known:
            continue
        try:
            return release(configuration, proposal.path, person=person, note="by policy", by_policy=True)
        except ReleaseError:
            continue  # the next older one may pass; `toolpoint model list` says why this one did not
    return None


def rollback(
    configuration: Configuration, *, person: str, to: int | None = None, note: str = "", kind: Kind | None = None
) -> ReleaseRecord:
    """Make an earlier release of a kind (None: thermal) active again, under a new number; raises ReleaseError."""
    kind = kind or THERMAL
    repository, key = kind.repository(configuration), _key(configuration)
    with repository.locked():
        active = repository.active()
        _refuse_the_daemons_reach(configuration, repository)
        number = to if to is not None else _before(active, repository.records())
        found, content = repository.content(number)
        if active is not None and found.sha256 == active.sha256:
            raise ReleaseError(f"release {number} holds the model that is active now")
        model, checks = kind.checked(configuration, content, f"release {number}")
        _refuse_another_machine(kind, model, configuration, f"release {number}", found.trained_on)
        if inhibit := inputs_inhibit(found, configuration):
            raise ReleaseError(f"release {number}: {inhibit} in {repository.releases}")
        record = _record(
            repository, "rollback", model, content, person=person, source=f"release {number}", note=note, checks=checks
        )
        record = record.model_copy(update={"trained_on": found.trained_on, "reads": found.reads})
        return repository.add(record, content, key)


def proposal_named(configuration: Configuration, given: Path) -> Path:
    """Return the file that a person means: a path, or a name among the proposals."""
    waiting = proposals_folder(configuration) / given
    try:
        return waiting if not given.exists() and waiting.exists() else given
    except OSError:
        return given


def why_proposals_are_hidden(configuration: Configuration) -> str:
    """Return why this account cannot see the proposals, '' when it can or there are none."""
    folder = proposals_folder(configuration)
    try:
        os.scandir(folder).close()
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f"{folder}: the proposals cannot be read ({error.strerror}); the state is for root alone: use sudo"
    return ""


def proposals(configuration: Configuration) -> Sequence[Proposal]:
    """Return the proposals that wait, the oldest first, each with what stands against it."""
    folder = proposals_folder(configuration)
    found: list[tuple[tuple[bool, float], Proposal]] = []
    try:
        paths = [path for path in folder.glob("*.json") if not path.is_symlink() and path.is_file()]
    except OSError:
        return []
    for path in paths:
        try:
            content = _content(path)
            changed_s = path.stat().st_mtime
        except (ReleaseError, OSError):
            continue  # gone, or not for us to read: nothing to propose
        model, inhibit = _read(configuration, content, str(path))
        if model is not None:
            inhibit = gate_inhibit(model, configuration) or machine_inhibit(model, configuration)
        name = model.model_id if model is not None else "unreadable"
        proposal = Proposal(path=path, model_id=name, sha256=sha256_of(content), inhibit=inhibit, model=model)
        found.append((age_order(changed_s), proposal))
    return [proposal for _, proposal in sorted(found, key=lambda item: (item[0], str(item[1].path)))]


def age_order(changed_s: float) -> tuple[bool, float]:
    """Return what sorts proposals, the oldest first; one from the future was made while the clock was ahead."""
    return changed_s <= time.time(), changed_s


def _read(configuration: Configuration, content: bytes, source: str) -> tuple[ThermalModel | None, str]:
    """Return the model, or why it cannot serve this machine."""
    sensor_ids, positions = configuration.temperatures.sensor_ids, configuration.cnc.axis_positions
    return model_from_text(content, source, sensor_ids, list(channels_in_use(configuration)), positions)


def _content(path: Path) -> bytes:
    """Return a proposal's bytes, read once: its folder belongs to the daemon, who might change it meanwhile."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise ReleaseError(f"{path}: cannot be read ({error.strerror}); name the proposal's own file") from error
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_size > LARGEST_MODEL:
            raise ReleaseError(f"{path}: is no file of a model")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read(LARGEST_MODEL)
    finally:
        os.close(descriptor)


def _checked(configuration: Configuration, content: bytes, source: str) -> tuple[ThermalModel, list[str]]:
    """Return the model and what was found good; raises ReleaseError."""
    model, inhibit = _read(configuration, content, source)
    if model is None:
        raise ReleaseError(inhibit)
    if inhibit := gate_inhibit(model, configuration):
        raise ReleaseError(f"{source}: {inhibit}")
    why = read_otherwise(model, configuration)
    bands = (f"{c} {model.band_um[model.channels.index(c)]:.3g} um" for c in channels_in_use(configuration))
    return model, [
        "the checksum fits the content",
        f"{len(model.test_vectors)} test vectors are met",
        f"sensors and channels are this machine's ({len(model.sensor_ids)} sensors)",
        *_sensors_by_name(configuration, model),
        *([f"{why}: the person who releases it answers for that"] if why else []),
        f"prediction bands are known and narrow enough: {', '.join(bands)}",
        *_watched(model),
    ]


def _watched(model: ThermalModel) -> list[str]:
    """Return what a model without a watch of its sensors leaves to the person who releases it."""
    if getattr(model, "watch", None) is not None:
        return []
    return ["it has no watch of its sensors: one that drifts slowly, or two that were exchanged, count without a word"]


def _sensors_by_name(configuration: Configuration, model: ThermalModel) -> list[str]:
    """Return what the recordings call each sensor of the machine, where that does not tell its ID."""
    places = {sensor.id: sensor.component for sensor in configuration.temperatures.every_sensor}
    named = [
        (number, name) for number, name in zip(model.sensor_ids, model.sensor_names, strict=True) if number in places
    ]
    if all(name.upper().removeprefix("T") == str(number) for number, name in named):
        return []
    said = ", ".join(f"{number} ({places[number]}) as {name!r}" for number, name in named)
    return [f"it was trained on sensor {said}: the person who releases it answers for that"]


def _checked_release(
    configuration: Configuration, repository: ReleaseRepository, record: ReleaseRecord | None
) -> ThermalModel | None:
    if record is None:
        return None
    _, content = repository.content(record.number)
    return _checked(configuration, content, f"release {record.number}")[0]


def _refuse_the_daemons_reach(configuration: Configuration, repository: ReleaseRepository) -> None:
    """Refuse a place that the daemon could write, and the daemon's own account."""
    if configuration.compensation.allow_writable_model_directory:
        return
    account = account_of_daemon(configuration.history.path)
    if account.is_this_process:
        raise ReleaseError(
            "this account runs the daemon, and the daemon may not release its own model; use another account"
        )
    if how := how_it_could_change(repository.releases / "model.json", account):
        raise ReleaseError(
            f"{repository.releases}: the daemon could change a model there ({how}); "
            "choose a folder that it cannot write"
        )


def _before(active: ReleaseRecord | None, records: list[ReleaseRecord]) -> int:
    """Return what was active before the model in force was released, so that going back again goes further back."""
    by_number = {each.number: each for each in records}
    while active is not None and active.action == "rollback":
        active = by_number.get(int(active.source.removeprefix("release ")))
    if active is None or active.previous is None:
        raise ReleaseError("no earlier release is known to go back to; `toolpoint model list` shows what there is")
    return active.previous.number


def _record(
    repository: ReleaseRepository,
    action: str,
    model: Named,
    content: bytes,
    *,
    person: str,
    source: str,
    note: str,
    checks: list[str],
) -> ReleaseRecord:
    active = repository.active()
    previous = None
    if active is not None:
        previous = PreviousRelease(number=active.number, model_id=active.model_id, sha256=active.sha256)
    return ReleaseRecord(
        number=repository.next_number(),
        action="rollback" if action == "rollback" else "release",
        model_id=model.model_id,
        sha256=sha256_of(content),
        person=person,
        released=datetime.now(UTC).isoformat(timespec="seconds"),
        source=source,
        note=note,
        checks=checks,
        previous=previous,
    )


THERMAL = Kind(repository=repository_of, checked=_checked, inputs=inputs_of)
"""The thermal model of the compensation."""
