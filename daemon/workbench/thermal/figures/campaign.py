"""A campaign's folder, read and prepared."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from config.recordings.campaign_index import CampaignIndex, DatasetEntry, read_campaign_index
from drivers.files.recording_csv import read_recording
from models.recordings.dataset import DatasetError
from models.records import FloatArray
from models.thermal.training.published import PublishedSet, prepare

Progress = Callable[[str, int, int], None]

LENGTH_LABELS = ("Room", "IR")
"""Labels of the temperatures that the model of the test bar's length takes."""
COLD_START, IDLE_REDUCTION = "cold start", "idle reduction"
"""Names of the groups of test sets."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Overview:
    """The whole campaign in time."""

    time_h: FloatArray
    speed_rpm: FloatArray
    room_degc: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """Data sets by number, and what the index says about each."""

    index: CampaignIndex
    entries: dict[int, DatasetEntry]
    sets: dict[int, PublishedSet]
    overview: Overview | None

    @property
    def training(self) -> list[PublishedSet]:
        return [self.sets[number] for number, entry in self.entries.items() if entry.usage == "train"]

    @property
    def tests(self) -> dict[str, list[PublishedSet]]:
        """Test sets by group: idle reduction, else cold start; groups without sets are not there."""
        found: dict[str, list[PublishedSet]] = {}
        for number, entry in self.entries.items():
            if entry.usage == "test":
                group = IDLE_REDUCTION if IDLE_REDUCTION in entry.cooling else COLD_START
                found.setdefault(group, []).append(self.sets[number])
        return found

    @property
    def temperature_names(self) -> tuple[str, ...]:
        return next(iter(self.sets.values())).recording.temperature_names

    def labelled_degc(self, prepared: PublishedSet, label: str) -> FloatArray | None:
        """Return the mean of the temperatures with a label [degC], None where there is none."""
        names = self.index.labels.get(label, [])
        places = [self.temperature_names.index(name) for name in names if name in self.temperature_names]
        if not places:
            return None
        mean: FloatArray = prepared.recording.temperatures_degc[:, places].mean(axis=1)
        return mean


def read_campaign(folder: Path, progress: Progress) -> Campaign:
    """Read a campaign; raises CampaignIndexError, RecordingFileError, DatasetError."""
    index = read_campaign_index(folder)
    names = [name for label in LENGTH_LABELS for name in index.labels.get(label, [])]
    if not names:
        raise DatasetError(f"{folder}: no temperature has the label Room or IR, which the length of the test bar takes")
    entries = {entry.dataset: entry for entry in sorted(index.datasets, key=lambda each: each.dataset)}
    sets: dict[int, PublishedSet] = {}
    for done, (number, entry) in enumerate(entries.items(), start=1):
        sets[number] = prepare(number, read_recording(folder / entry.file), names)
        first = next(iter(sets.values())).recording
        if sets[number].recording.temperature_names != first.temperature_names:
            raise DatasetError(
                f"{entry.file}: has other temperatures than {first.name}; a campaign has one set of sensors"
            )
        if abs(sets[number].recording.sample_s - 60.0) > 0.5:
            raise DatasetError(
                f"{entry.file}: has a row every {sets[number].recording.sample_s:g} s; one per minute is needed"
            )
        progress("reading", done, len(entries))
    campaign = Campaign(index=index, entries=entries, sets=sets, overview=_overview(folder, index))
    if not campaign.training or not campaign.tests:
        raise DatasetError(f"{folder}: needs data sets with usage train and with usage test")
    return campaign


def _overview(folder: Path, index: CampaignIndex) -> Overview | None:
    if index.overview is None:
        return None
    path = folder / index.overview
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
        header = lines[0].split(",")
        table = np.array([[float(field or "nan") for field in line.split(",")] for line in lines[1:]])
        time_h, speed, room = (table[:, header.index(name)].copy() for name in ("time_h", "rpm", "Room"))
    except (OSError, ValueError, IndexError) as error:
        raise DatasetError(f"{path}: is no overview with the columns time_h, rpm and Room ({error})") from error
    breaks = np.flatnonzero(np.diff(time_h) > 0.5) + 1
    time_h, speed, room = (np.insert(values, breaks, np.nan) for values in (time_h, speed, room))
    return Overview(time_h=time_h, speed_rpm=speed, room_degc=room)
