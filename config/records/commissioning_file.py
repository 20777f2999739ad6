"""Writes the record of a commissioning, signed where there is a key."""

import json
from pathlib import Path

from config.files import write_whole
from config.records.commissioning import CommissioningError, CommissioningRecord
from config.signing import signature_beside
from config.signing_key import SigningKey


def commissioning_text(record: CommissioningRecord) -> str:
    content = record.model_dump(mode="json")
    for axis in content["axes"].values():
        if axis["slope"] is None:
            del axis["slope"]  # versions before know nothing of it
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def save_commissioning(record: CommissioningRecord, path: Path, key: SigningKey | None = None) -> None:
    """Write a record whole or not at all; raises CommissioningError, and the old file then stands."""
    text = commissioning_text(record)
    try:
        if key is None:
            signature_beside(path).unlink(missing_ok=True)
        write_whole(path, text, 0o644)
        if key is not None:
            write_whole(signature_beside(path), key.signature("commissioning record", text.encode()), 0o644)
    except OSError as error:
        raise CommissioningError(f"{path}: the record cannot be written ({error.strerror})") from error
