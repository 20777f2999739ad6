"""The index of a measured campaign: which file is which data set (`campaign.json`)."""

import json
from pathlib import Path
from typing import Literal

from pydantic import ConfigDict, Field, ValidationError

from config.schema.base import Section, first_fault
from models.errors import RefusedInputError

INDEX_FILE = "campaign.json"
INDEX_VERSION = 1


class CampaignIndexError(RefusedInputError, ValueError):
    """A folder is no campaign; the text names the file and what is wrong in it."""


class DatasetEntry(Section):
    """One data set."""

    dataset: int = Field(ge=1)
    file: str = Field(min_length=1)
    spindle_speeds_rpm: list[float] = Field(min_length=1)
    switching: bool
    previous: str
    cooling: str
    usage: Literal["train", "test", ""]
    series: int = Field(ge=1)
    start_h: float = Field(ge=0.0)


class CampaignIndex(Section):
    """All data sets of a campaign; keys that are not known are let be."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True, allow_inf_nan=False)

    version: Literal[1]
    name: str
    machine: str
    overview: str | None = None
    labels: dict[str, list[str]]
    datasets: list[DatasetEntry] = Field(min_length=1)


def read_campaign_index(folder: Path) -> CampaignIndex:
    """Return the index of a campaign's folder; raises CampaignIndexError."""
    path = folder / INDEX_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CampaignIndexError(
            f"{path}: cannot be read ({error.strerror}); `toolpoint thermal campaign` writes such a folder"
        ) from error
    except ValueError as error:
        raise CampaignIndexError(f"{path}: is not JSON ({error})") from error
    try:
        return CampaignIndex.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise CampaignIndexError(f"{path}: {first_fault(error)}") from error
