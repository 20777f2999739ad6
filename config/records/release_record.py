"""The record beside a released thermal model: which file, who released it, and what it replaced."""

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from config.files import read_whole
from config.schema.base import Section, first_fault


class PreviousRelease(Section):
    """The release that was active before."""

    number: int = Field(ge=1)
    model_id: str
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class ReleaseRecord(Section):
    """Proof that a person released exactly this file."""

    format_version: int = Field(1, ge=1, le=1)
    number: int = Field(ge=1, description="releases of one machine count from 1")
    action: Literal["release", "rollback"]
    model_id: str
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="of the file's bytes")
    person: str = Field(min_length=1)
    released: str = Field(description="date and time in UTC, ISO 8601")
    source: str = Field(description="the file that was released, or the release that was gone back to")
    note: str = ""
    checks: list[str] = Field(description="what was checked and found good, in words")
    previous: PreviousRelease | None = None
    trained_on: str = Field("", description="another machine of which a person said that its models serve this one")
    reads: dict[str, str] = Field(default_factory=dict[str, str], description="what each input of the model read")

    @property
    def leads_back_to(self) -> set[int]:
        """Numbers of the releases that it names: what was active before, and what a rollback went back to."""
        gone_back_to = self.source.removeprefix("release ") if self.action == "rollback" else ""
        before = set() if self.previous is None else {self.previous.number}
        return before | ({int(gone_back_to)} if gone_back_to.isdecimal() else set())


class ReleaseRecordError(Exception):
    """The record cannot be read; the text says why."""


def load_release_record(path: Path) -> ReleaseRecord:
    """Read a record; raises ReleaseRecordError naming file and key."""
    return read_release_record(path)[0]


def read_release_record(path: Path) -> tuple[ReleaseRecord, bytes]:
    """Read a record, and the bytes that its signature is of; raises ReleaseRecordError naming file and key."""
    try:
        content = read_whole(path)
        return ReleaseRecord.model_validate_json(content.decode("utf-8")), content
    except OSError as error:
        raise ReleaseRecordError(f"{path}: the release record cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ReleaseRecordError(f"{path}: this is no release record: byte {error.start} is not UTF-8 text") from error
    except ValidationError as error:
        raise ReleaseRecordError(f"{path}: {first_fault(error)}") from error
