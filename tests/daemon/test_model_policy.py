"""Releases without a person, and what the commands say."""

import os
from dataclasses import replace

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from model_folder import configured, proposal
from rewired import EXCHANGED, rewired
from small_model import model

from config.files import sha256_of
from config.records.release_record import ReleaseRecord
from config.schema.compensation import ReleaseConfig
from daemon.model_release.file_access import Account
from daemon.model_release.gate import reads_in_short
from daemon.model_release.loading import load_released
from daemon.model_release.releasing import proposals, release, release_by_policy, repository_of
from daemon.model_release.repository import ReleaseError
from daemon.model_release.retraining import propose
from models.recordings.dataset import Recording
from models.thermal.linear import LinearModel
from models.thermal.model import READS
from models.thermal.training.train_family import train_family

STRANGER = Account(user_id=54321)


@pytest.fixture(scope="module")
def refused_model() -> LinearModel:
    """A model that really was trained, and that its training refused: there is nothing to be learned here."""
    rng = np.random.default_rng(5)
    minutes = 600
    warmth = np.cumsum(rng.normal(0.0, 0.1, minutes))[:, None] * np.linspace(0.5, 1.5, len(SENSOR_IDS))
    recording = Recording(
        name="noise",
        time_s=60.0 * np.arange(float(minutes)),
        speed_rpm=np.resize(np.repeat([0.0, 6000.0], 40), minutes),
        temperature_names=tuple(f"t{i}" for i in SENSOR_IDS),
        temperatures_degc=22.0 + warmth,
        displacement_names=("Y1", "Z1"),
        displacements_um=rng.normal(0.0, 5.0, (minutes, 2)),
    )
    trained = train_family([recording], "ridge", sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    assert isinstance(trained, LinearModel) and trained.refused is not None
    return replace(trained, sensor_ids=SENSOR_IDS)


def test_a_model_that_its_training_refused_is_neither_released_nor_loaded(folder, refused_model):
    configuration = configured(folder, release=ReleaseConfig(automatic=True))
    release(configuration, proposal(folder, model(), "1.json"), person="anna")
    waiting = propose(configuration, refused_model)
    with pytest.raises(ReleaseError, match="its training refused it: "):
        release(configuration, waiting, person="anna")
    assert release_by_policy(configuration, person="policy") is None
    content = waiting.read_bytes()
    strict = configured(folder, allow_writable_model_directory=False)
    smuggled = ReleaseRecord(
        number=2,
        action="release",
        model_id=refused_model.model_id,
        sha256=sha256_of(content),
        person="somebody",
        released="2026-01-01T00:00:00+00:00",
        source="by hand",
        checks=[],
    )
    repository_of(strict).add(smuggled, content)
    found = load_released(strict, STRANGER)
    assert found.model is None and "its training refused it: " in found.inhibit
    bench = load_released(configured(folder, allow_writable_model_directory=True), STRANGER)
    assert bench.model is not None and "its training refused it: " in bench.warning


def test_the_policy_takes_the_newest_that_is_not_worse(folder):
    configuration = configured(folder, release=ReleaseConfig(automatic=True))
    proposal(folder, model("ridge-2", 1.5), "2.json")
    assert release_by_policy(configuration, person="policy") is None, "the first one is a person's"
    release(configuration, proposal(folder, model("ridge-1"), "1.json"), person="anna")
    for age_s, name in enumerate(("4.json", "3.json", "2.json", "1.json")):
        path = folder / "state/proposals" / name
        if name == "4.json":
            path.write_text("{}", encoding="utf-8")
        elif name == "3.json":
            proposal(folder, model("ridge-3", 2.5), name)
        os.utime(path, (1e9 - age_s, 1e9 - age_s))
    assert [p.inhibit != "" for p in proposals(configuration)] == [False, False, False, True]
    record = release_by_policy(configuration, person="policy")
    assert record is not None and record.model_id == "ridge-2" and record.note == "by policy"
    assert "its bands are not wider than the active model's" in record.checks
    assert release_by_policy(configuration, person="policy") is None, "what was released once is not proposed again"


def test_the_policy_releases_no_model_whose_sensors_read_something_else_since_its_training(folder):
    """What was proposed before two IDs were exchanged in the configuration is a person's to release."""
    before = configured(folder, release=ReleaseConfig(automatic=True))
    release(before, proposal(folder, model("ridge-1"), "1.json"), person="anna")
    proposal(folder, model("ridge-2", 1.5), "2.json")
    after = rewired(before, EXCHANGED)
    assert release_by_policy(after, person="policy") is None

    trained = model("ridge-3", 1.5)
    for name, read in (("3.json", before), ("4.json", after)):
        told = trained.hyper_parameters | {
            READS: reads_in_short(trained, {f"sensor {i}": each for i, each in read.reads.items()})
        }
        proposal(folder, replace(trained, model_id=f"ridge-{name[0]}", hyper_parameters=told), name)
    record = release_by_policy(after, person="policy")
    assert record is not None and record.model_id == "ridge-4"
    (folder / "state/proposals/2.json").unlink()  # nobody wrote down what it read, and the active model reads the same
    assert release_by_policy(after, person="policy") is None
    with pytest.raises(ReleaseError, match="than when it was trained"):
        release(after, folder / "state/proposals/3.json", person="policy", by_policy=True)
    by_a_person = release(after, folder / "state/proposals/3.json", person="anna")
    assert any("than when it was trained" in each and "answers for that" in each for each in by_a_person.checks)


def test_the_policy_is_off_by_default(folder):
    configuration = configured(folder)
    proposal(folder, model())
    with pytest.raises(ReleaseError, match="only a person releases"):
        release_by_policy(configuration, person="policy")
