"""Sign what stands on a machine already: releases and the commissioning record of before there were signatures."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from config.files import read_whole, write_whole
from config.records.commissioning import load_commissioning
from config.records.release_record import ReleaseRecordError, read_release_record
from config.schema import Configuration
from config.signing import Purpose, SigningError, TrustedKeys, signature_beside, signature_of
from config.signing_key import SigningKey
from daemon.model_release.active import RECORD_NAME
from daemon.model_release.bearings import bearing_repository
from daemon.model_release.releasing import repository_of
from daemon.model_release.repository import ReleaseError, ReleaseRepository


@dataclass(frozen=True, slots=True, kw_only=True)
class Signable:
    """One file that a person answers for."""

    path: Path
    purpose: Purpose
    content: bytes
    in_words: str
    signed_by: str
    """'' where it is not signed."""
    problem: str
    """Why its signature does not count, '' when it does or where no signature is asked for."""


def signables(configuration: Configuration) -> list[Signable]:
    """Return every release and the commissioning record with who has signed it; raises SigningError, OSError."""
    trusted = TrustedKeys.read(configuration.signatures.public_keys)
    return [_looked_at(trusted, *each) for each in (*_releases(configuration), *_commissioning(configuration))]


def sign(signable: Signable, key: SigningKey) -> None:
    """Put a signature beside a file; raises OSError."""
    write_whole(signature_beside(signable.path), key.signature(signable.purpose, signable.content), 0o644)


def _looked_at(trusted: TrustedKeys, path: Path, purpose: Purpose, content: bytes, in_words: str) -> Signable:
    signed_by = problem = ""
    try:
        signed_by = trusted.signer(purpose, content, signature_of(path), str(path))
    except SigningError as error:
        problem = str(error)
    return Signable(
        path=path, purpose=purpose, content=content, in_words=in_words, signed_by=signed_by, problem=problem
    )


def _releases(configuration: Configuration) -> Iterator[tuple[Path, Purpose, bytes, str]]:
    repositories: list[ReleaseRepository] = []
    if configuration.compensation.model_file is not None:
        repositories.append(repository_of(configuration))
    if configuration.spindle_speed is not None:
        repositories.append(bearing_repository(configuration))
    for repository in repositories:
        for folder in repository.folders():
            path = folder / RECORD_NAME
            try:
                record, content = read_release_record(path)
                repository.content(record.number)
            except (ReleaseRecordError, ReleaseError):
                continue  # what does not belong together cannot be signed
            yield path, "release record", content, f"release {record.number}: {record.model_id}, by {record.person}"


def _commissioning(configuration: Configuration) -> Iterator[tuple[Path, Purpose, bytes, str]]:
    path = configuration.compensation.commissioning_file
    if path is not None and path.exists():
        record = load_commissioning(path)
        in_words = f"commissioning of {record.cnc_identity} by {record.person} on {record.date}"
        yield path, "commissioning record", read_whole(path), in_words
