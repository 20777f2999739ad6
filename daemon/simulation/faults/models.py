"""The models of a fault campaign: the one that ships, and two that are trained for it on other simulated days."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from config.files import write_whole
from daemon.simulation.faults.script import WATCHED_SENSORS, Happening, Incident
from daemon.simulation.simulated_model import published_sensors, simulated_recording, training_programmes
from models.recordings.dataset import Recording
from models.thermal.family import ThermalModel, model_from_json
from models.thermal.training.increment_family import IncrementChoices
from models.thermal.training.recipes import increment_recipe
from models.thermal.training.train_family import train_family

CREATED = "2026-01-01T00:00:00+00:00"
TRAINING_DAYS = 6
HOURS = 10.0
SAMPLE_S = 60.0
INTERVAL_MIN = 10.0
SHIPPED, SMALL, WATCHING, RENAMED = "shipped", "small", "watching", "renamed"
IN_TURN = (SHIPPED, WATCHING, SHIPPED, SMALL, SHIPPED, RENAMED)
"""The watching model needs two thirds of a day of history before it may be followed."""
OF_MODELS = (Incident.MODEL_RELOAD, Incident.DAMAGED_MODEL)


class CampaignModels:
    """The model's file, and what stands in it."""

    def __init__(self, path: Path, script: Sequence[Happening]) -> None:
        """Train the other models when the script needs them."""
        self.path = path
        self._turn = 0
        self.current = SHIPPED
        self.damaged = False
        shipped = path.read_text("utf-8")
        self._texts = {SHIPPED: shipped}
        self._ids: dict[str, str] = {SHIPPED: model_from_json(shipped, path.name).model_id}
        self._limits_k: dict[int, float] = {}
        if any(happening.kind in OF_MODELS for happening in script):
            self._train()

    @classmethod
    def beside(cls, source: Path, directory: Path, script: Sequence[Happening]) -> "CampaignModels":
        """Make a copy of the shipped model in the campaign's folder."""
        path = directory / "model.json"
        shutil.copyfile(source, path)
        return cls(path, script)

    @property
    def model_id(self) -> str:
        return self._ids[self.current]

    def loaded(self) -> dict[str, ThermalModel]:
        return {self._ids[name]: model_from_json(text, self.path.name) for name, text in self._texts.items()}

    def is_watching(self, model_id: str | None) -> bool:
        return model_id is not None and model_id == self._ids.get(WATCHING)

    def limit_k(self, sensor_id: int) -> float:
        """Return from how much on the model that watches its sensors takes a departure of one for a fault [K]."""
        return self._limits_k[sensor_id]

    def exchange(self) -> None:
        self._turn = (self._turn + 1) % len(IN_TURN)
        self.current, self.damaged = IN_TURN[self._turn], False
        write_whole(self.path, self._texts[self.current])

    def damage(self) -> None:
        """Leave half of the file."""
        text = self._texts[self.current]
        self.damaged = True
        write_whole(self.path, text[: len(text) // 2])

    def ended(self, happening: Happening) -> None:
        """Make a damaged file whole when that is over."""
        if happening.kind is Incident.DAMAGED_MODEL:
            self.repair()

    def repair(self) -> None:
        if self.damaged:
            self.damaged = False
            write_whole(self.path, self._texts[self.current])

    def _train(self) -> None:
        recordings = _recordings()
        telescoped = increment_recipe(
            IncrementChoices(interval_min=INTERVAL_MIN, ridge_k2="auto", split_at_speed_changes=False)
        )
        small = train_family(recordings, telescoped, sample_s=SAMPLE_S, created=CREATED).model
        watching: Any = train_family(recordings, "default", sample_s=SAMPLE_S, created=CREATED).model
        self._limits_k = dict(zip(watching.sensor_ids, watching.watch.threshold_k.tolist(), strict=True))
        shipped: Any = model_from_json(self._texts[SHIPPED], self.path.name)
        renamed = replace(shipped, model_id=f"{shipped.model_id}-again")
        for name, model in ((SMALL, small), (WATCHING, watching), (RENAMED, renamed)):
            self._texts[name], self._ids[name] = model.to_json(), model.model_id


def _recordings() -> list[Recording]:
    sensors = [sensor for sensor in published_sensors() if sensor.id in WATCHED_SENSORS]
    programmes = training_programmes()
    return [
        simulated_recording(seed, programmes[(seed - 1) % len(programmes)], sensors, hours=HOURS)
        for seed in range(1, TRAINING_DAYS + 1)
    ]


def change_policy(path: Path, *, zero_first: bool) -> None:
    """Write the configuration anew with this policy; the daemon reads it when it is started."""
    content = yaml.safe_load(path.read_text("utf-8"))
    content["compensation"]["reference"]["policy"] = "zero_first" if zero_first else "bumpless"
    path.write_text(yaml.safe_dump(content, sort_keys=False, width=120), encoding="utf-8")
