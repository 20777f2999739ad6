"""What the monitor says of the models on the disk: scores, and what stands against each candidate."""

from dataclasses import replace
from pathlib import Path

import pytest
from model_folder import configured, open_folder, proposal
from monitor_bench import monitor
from small_model import model

from config.schema import Configuration
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import load_released
from daemon.model_release.releasing import proposals, release
from daemon.monitor.web import schemas
from daemon.monitoring import ModelsOnDisk
from models.thermal.model import TrainingData

SCORED = {"held_out_relative_rmse": 0.23}
DAY = TrainingData(name="day 1", sha256="0" * 64, from_hours=1.0, to_hours=9.0, rows=480)


@pytest.fixture
def configuration():
    with open_folder() as folder:
        yield configured(folder, allow_writable_model_directory=True)


def folder_of(configuration: Configuration) -> Path:
    return configuration.history.path.parent.parent


async def test_candidates_come_with_their_scores_and_what_stands_against_each(configuration, tmp_path):
    folder = folder_of(configuration)
    good = replace(model("ridge-1"), hyper_parameters=SCORED, training=(DAY,))
    release(configuration, proposal(folder, good, "good.json"), person="anna")
    proposal(folder, model("ridge-2", band_um=31.0), "wide.json")
    proposal(folder, replace(model("ridge-3"), refused="leaves 103% of the error on what was left out"), "harm.json")
    (folder / "state/proposals/half.json").write_text('{"format_version"', encoding="utf-8")
    async with monitor(tmp_path) as bench:
        bench.rig.snapshots.model = load_released(configuration, own_account()).snapshot()
        found = await ModelsOnDisk(configuration, bench.rig.snapshots).document()
    schemas.Models.model_validate(found)
    by_file = {each["file"]: each for each in found["candidates"]}
    assert set(by_file) == {"good.json", "wide.json", "harm.json", "half.json"}
    assert by_file["good.json"]["released_as"] == 1 and by_file["good.json"]["against"] == ""
    assert by_file["good.json"]["scores"]["error_left"] == 0.23
    assert by_file["good.json"]["scores"]["hours"] == 8.0
    assert "wider than 30 um" in by_file["wide.json"]["against"]
    assert "103% of the error" in by_file["harm.json"]["against"]
    assert by_file["half.json"]["scores"] is None and by_file["half.json"]["against"]
    said = {each.path.name: each.inhibit for each in proposals(configuration)}
    assert {name: each["against"] for name, each in by_file.items()} == said, "as `toolpoint model list` says"
    assert found["scores"] == by_file["good.json"]["scores"]
    assert [each["released_by"] for each in found["releases"]] == ["anna"]
    z1 = next(band for band in found["scores"]["bands"] if band["channel"] == "Z1")
    assert z1 == {"channel": "Z1", "band_um": 2.0, "widest_um": 30.0}
