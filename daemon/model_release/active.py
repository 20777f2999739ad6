"""Which model is released: its record, and who signed it, as the daemon reads them."""

import os
from pathlib import Path

from config.files import read_whole, sha256_of
from config.records.release_record import ReleaseRecord, ReleaseRecordError, load_release_record, read_release_record
from config.schema import Configuration
from config.signing import SigningError, TrustedKeys, signature_of

RECORD_NAME = "release.json"


def released(model_file: Path) -> tuple[ReleaseRecord | None, str]:
    """Return the record of the active release (None where there is none), and why it must not be used."""
    real = Path(os.path.realpath(model_file))
    beside = real.with_name(RECORD_NAME)
    if not beside.exists():
        return None, ""
    try:
        record = load_release_record(beside)
        digest = sha256_of(read_whole(real))
    except ReleaseRecordError as error:
        return None, str(error)
    except OSError as error:
        return None, f"{real}: the model cannot be read ({error.strerror})"
    if digest != record.sha256:
        return record, (
            f"{real}: this is not the file that {record.person} released on {record.released} (sha256 {digest[:12]}, "
            f"released was {record.sha256[:12]}); release it again, or go back with `toolpoint model rollback`"
        )
    return record, ""


def release_signer(model_file: Path, record: ReleaseRecord, trusted: Path) -> str:
    """Return who has signed the record of the active release, '' where no key counts; raises SigningError."""
    beside = Path(os.path.realpath(model_file)).with_name(RECORD_NAME)
    try:
        found, content = read_release_record(beside)
        signature = signature_of(beside)
    except (ReleaseRecordError, OSError) as error:
        raise SigningError(f"{beside}: its signature cannot be read ({error})") from error
    if found != record:
        raise SigningError(f"{beside}: the release record changed while it was read; try again")
    return TrustedKeys.read(trusted).signer("release record", content, signature, str(beside))


def proposals_folder(configuration: Configuration) -> Path:
    """Return where the daemon and its jobs put models that a person may release."""
    return configuration.history.path.parent / "proposals"
