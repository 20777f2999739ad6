"""Lists what a back-up holds, and checks each file in it."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from config.schema.base import Section
from config.signing import SIGNATURE_SUFFIX

MANIFEST_NAME = "manifest.json"
SIGNATURE_NAME = "manifest.json.sig"
STORE_NAME = "store/history.sqlite"
LAST_BLOCK_NAME = "store/last-block"
CONFIGURATION_NAME = "configuration/toolpoint.yaml"
COMMISSIONING_NAME = "commissioning/record.json"
MODEL_NAME = "models/model.json"
RELEASES_NAME = "models/releases"
BEARINGS_NAME = "bearings/model.json"
BEARING_RELEASES_NAME = "bearings/releases"
PLANNED_WITH = "planning"
"""Folder of the spindle and case files that spindle speeds are planned with."""
LEFT_OUT = (
    "passwords, accounts, keys, certificates and changes of the units: keep those apart, or make new ones",
    "the program itself: install the version named here",
)


class BackupError(Exception):
    """A back-up or a restoration is refused or failed; the text says why and what to do."""


class BackedUpFile(Section):
    """One file of the back-up."""

    name: str = Field(pattern=r"^[a-z]+/[A-Za-z0-9_./-]+$")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    size_bytes: int = Field(ge=0)
    came_from: str


class Manifest(Section):
    """The first file of a back-up."""

    format_version: Literal[1] = 1
    toolpoint: str = Field(description="version that made the back-up")
    machine: str
    created: str = Field(description="date and time in UTC, ISO 8601")
    store_schema: int = Field(ge=1)
    active_release: int | None = Field(None, ge=1, description="which released model was active")
    active_bearing_release: int | None = Field(None, ge=1, description="the same of the bearing model")
    files: list[BackedUpFile]
    left_out: list[str]

    @property
    def active_releases(self) -> dict[str, int]:
        """Number of the release that was active, by where its releases are in the back-up."""
        numbers = {RELEASES_NAME: self.active_release, BEARING_RELEASES_NAME: self.active_bearing_release}
        return {folder: number for folder, number in numbers.items() if number is not None}

    def files_in(self, *folders: str) -> list[str]:
        """Return the names of the files below folders of the back-up."""
        return [file.name for file in self.files if file.name.startswith(tuple(f"{folder}/" for folder in folders))]

    def to_json(self) -> str:
        """Return its text; what a version before does not know is left out where there is none."""
        unsaid = {"active_bearing_release"} if self.active_bearing_release is None else None
        return self.model_dump_json(indent=2, exclude=unsaid)


def signature_name(name: str) -> str:
    return f"{name}{SIGNATURE_SUFFIX}"


def last_block_beside(store: Path) -> Path:
    """Return the small file that says what was being written, which belongs to a store."""
    return store.with_name(f"{store.name}.last-block")
