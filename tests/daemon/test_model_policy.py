"""Releases without a person, and what the commands say."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from model_shelf import configured, open_folder, proposal
from small_model import model

from config.sample import sample_configuration
from config.schema.compensation import ReleaseConfig
from daemon.cli import main
from daemon.release.releasing import (
    proposals,
    release,
    release_by_policy,
)
from daemon.release.shelf import ReleaseError


@pytest.fixture
def folder() -> Iterator[Path]:
    with open_folder() as made:
        yield made


def test_the_policy_is_off_by_default(folder):
    configuration = configured(folder)
    proposal(folder, model())
    with pytest.raises(ReleaseError, match="only a person releases"):
        release_by_policy(configuration, person="policy")


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
    assert [p.obstacle != "" for p in proposals(configuration)] == [False, False, False, True]
    record = release_by_policy(configuration, person="policy")
    assert record is not None and record.model_id == "ridge-2" and record.note == "by policy"
    assert "its bands are not wider than the active model's" in record.checks
    assert release_by_policy(configuration, person="policy") is None, "what was released once is not proposed again"


# --- the commands ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["release"], 2, "name one PROPOSAL"),
        (["release", "p.json", "--by-policy"], 2, "name one PROPOSAL"),
        (["release", "p.json"], 1, "model_file is not set"),
        (["release", "--by-policy"], 1, "only a person releases"),
        (["rollback"], 1, "model_file is not set"),
        (["rollback", "--to", "0"], 2, "--to"),
        (["list"], 2, "model_file is not set"),
    ],
)
def test_what_the_commands_cannot_do_they_say(tmp_path, words, status, said):
    path = tmp_path / "toolpoint.yaml"
    path.write_text(sample_configuration(), encoding="utf-8")
    finished = CliRunner().invoke(main, ["model", *words, "--config", str(path)])
    assert finished.exit_code == status, finished.output
    assert said in finished.output
