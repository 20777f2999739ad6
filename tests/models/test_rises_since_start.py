"""A model of rises since the start is followed by a machine that reads temperatures, whatever its family."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from thermal_runs import run

from drivers.files.recording_csv import read_recording
from models.recordings.dataset import Recording
from models.thermal.training.inputs import build_inputs
from models.thermal.training.online import compensated_um, follow, following_share
from models.thermal.training.train_family import train_family


def rises(recording: Recording) -> Recording:
    degc = recording.temperatures_degc - recording.temperatures_degc[0]
    return replace(recording, temperatures_degc=np.round(degc, 1))


@pytest.mark.parametrize("family", ["ridge", "lags"])
def test_a_model_of_rises_is_followed_on_the_machine(tmp_path: Path, family: str) -> None:
    recordings = [read_recording(run(tmp_path, number)) for number in range(1, 6)]
    made = train_family([rises(one) for one in recordings[:-1]], family, sample_s=60.0, created="2026-01-01T00:00:00Z")
    assert "rises since the start" in made.warnings[0] and made.model.domain.of_increments  # type: ignore[attr-defined]
    machine = build_inputs(recordings[-1:], sample_s=60.0, lags_min=(), speed_lags_min=())
    assert machine.degc.min() > 15.0
    followed = follow(made.model, machine, np.arange(machine.rows))
    assert following_share([followed]) == 1.0
    error_um = machine.measured_um - machine.measured_um[0]
    left_um = error_um - compensated_um(followed, machine.time_min, error_um)
    assert np.sqrt(np.square(left_um).mean()) < 0.1 * np.sqrt(np.square(error_um).mean())
