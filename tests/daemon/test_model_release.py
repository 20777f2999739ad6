"""Releasing models: what is refused, what is kept, and what the daemon believes."""

import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_folder import configured, proposal
from other_user import OTHER, as_root, as_user
from small_model import model

from config.schema.compensation import ReleaseConfig
from daemon.model_release import repository
from daemon.model_release.file_access import Account, account_of_daemon, how_it_could_change, own_account
from daemon.model_release.loading import load_released
from daemon.model_release.releasing import person_now, proposals, release, repository_of, rollback
from daemon.model_release.repository import ReleaseError
from daemon.model_release.retraining import MOST_PROPOSALS, propose
from models.errors import RefusedInputError
from models.thermal.linear import LinearModel

STRANGER = Account(user_id=OTHER)


# --- who could change a file ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "mode", "words"),
    [
        ("a/b/model.json", 0o666, "model.json is writable by everybody"),
        ("a/b", 0o777, "a/b is writable by everybody"),
        ("a/b", 0o1777, "a/b is writable by everybody"),
        ("a", 0o777, "a is writable by everybody"),
        ("a/b", 0o775, "a/b is writable by its group"),
    ],
)
def test_every_place_on_the_way_counts(folder, place, mode, words):
    path = folder / "a/b/model.json"
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    (folder / place).chmod(mode)
    account = Account(user_id=OTHER, group_ids=frozenset({os.getegid()}) if mode == 0o775 else frozenset())
    assert words in how_it_could_change(path, account)


def test_a_link_is_judged_on_both_sides(folder):
    for name in ("safe", "open"):
        (folder / name).mkdir()
    (folder / "safe/model.json").write_text("{}")
    (folder / "open/model.json").symlink_to("../safe/model.json")
    (folder / "open/other.json").write_text("{}")
    (folder / "safe/other.json").symlink_to("../open/other.json")
    assert how_it_could_change(folder / "open/model.json", STRANGER) == ""
    (folder / "open").chmod(0o777)
    assert "open is writable" in how_it_could_change(folder / "open/model.json", STRANGER)
    assert "open is writable" in how_it_could_change(folder / "safe/other.json", STRANGER)


@as_root
def test_the_kernel_is_asked_about_the_process_itself(folder):
    path = folder / "model.json"
    path.write_text("{}")

    def look() -> str:
        return how_it_could_change(path, own_account()) or "out of reach"

    assert as_user(OTHER, look) == "out of reach"
    os.chown(path, OTHER, -1)
    assert "belongs to it" in as_user(OTHER, look)
    os.chown(path, 0, -1)
    folder.chmod(0o757)
    assert "is writable by it" in as_user(OTHER, look)


@as_root
def test_the_daemons_account_is_known_by_its_store(folder):
    configuration = configured(folder)
    assert account_of_daemon(configuration.history.path).user_id is None
    os.chown(folder / "state", OTHER, OTHER)
    account = account_of_daemon(configuration.history.path)
    assert (account.user_id, account.group_ids) == (OTHER, frozenset({OTHER}))


# --- releasing -------------------------------------------------------------------------------


@as_root
def test_a_released_model_is_what_another_user_loads(folder):
    configuration = configured(folder)
    record = release(configuration, proposal(folder, model()), person="anna (uid 1000)", note="first")
    assert record.number == 1 and record.previous is None and record.person == "anna (uid 1000)"

    def look() -> str:
        return load_released(configuration, own_account()).in_words()

    words = as_user(OTHER, look)
    assert words.startswith(f"ridge-1, sha256 {record.sha256}, release 1 by anna (uid 1000) on 20"), words
    assert "WARNING" not in words
    assert load_released(configuration, own_account()).inhibit.count("runs as root") == 1


@as_root
def test_a_released_file_that_was_changed_is_refused(folder):
    configuration = configured(folder)
    release(configuration, proposal(folder, model()), person="anna")
    path = folder / "models/releases/0001/model.json"
    path.write_text(model("another").to_json(), encoding="utf-8")
    inhibit = as_user(OTHER, lambda: load_released(configuration, own_account()).inhibit)
    assert "not the file that anna released" in inhibit and "rollback" in inhibit
    path.with_name("release.json").write_text("{}", encoding="utf-8")
    assert "release.json" in as_user(OTHER, lambda: load_released(configuration, own_account()).inhibit)


@as_root
def test_a_model_that_nobody_released_is_refused(folder):
    configuration = configured(folder)
    (folder / "models/model.json").write_text(model().to_json(), encoding="utf-8")
    assert "nobody has released" in as_user(OTHER, lambda: load_released(configuration, own_account()).inhibit)
    with pytest.raises(
        ReleaseError, match="which nobody released and nobody can go back to; move it to another folder"
    ):
        release(configuration, proposal(folder, model()), person="anna")


def test_the_key_for_test_benches_lets_it_pass_and_says_so(folder):
    configuration = configured(folder, allow_writable_model_directory=True)
    (folder / "models/model.json").write_text(model().to_json(), encoding="utf-8")
    (folder / "models").chmod(0o777)
    found = load_released(configuration, own_account())
    assert found.model is not None and found.record is None
    assert "WARNING: thermal model for a simulation only" in found.in_words() and found.snapshot().warning


def test_the_key_does_not_excuse_a_file_that_differs_from_its_record(folder):
    configuration = configured(folder, allow_writable_model_directory=True)
    release(configuration, proposal(folder, model()), person="anna")
    (folder / "models/releases/0001/model.json").write_text(model("another").to_json(), encoding="utf-8")
    assert "not the file that anna released" in load_released(configuration, own_account()).inhibit


def test_releases_follow_each_other_and_lead_back(folder):
    configuration = configured(folder)
    for name in ("ridge-1", "ridge-2", "ridge-3"):
        release(configuration, proposal(folder, model(name)), person="anna")
    back = rollback(configuration, person="ben", note="scrap")
    assert (back.number, back.action, back.model_id) == (4, "rollback", "ridge-2")
    assert back.previous is not None and back.previous.model_id == "ridge-3"
    first = rollback(configuration, person="ben", to=1)
    assert (first.number, first.model_id) == (5, "ridge-1")
    shelf = repository_of(configuration)
    assert [record.number for record in shelf.records()] == [1, 2, 3, 4, 5]
    active = shelf.active()
    assert active is not None and active.number == 5
    assert (folder / "models/model.json").read_text(encoding="utf-8") == model("ridge-1").to_json()
    with pytest.raises(ReleaseError, match="active now"):
        rollback(configuration, person="ben", to=1)
    with pytest.raises(ReleaseError, match=r"no release 77 in .*; there are: 1, 2, 3, 4, 5$"):
        rollback(configuration, person="ben", to=77)


def test_a_copy_of_a_release_that_a_person_has_put_beside_it_is_none(folder):
    configuration = configured(folder)
    first = release(configuration, proposal(folder, model("ridge-1")), person="anna")
    shelf = repository_of(configuration)
    shutil.copytree(shelf.releases / f"{first.number:04d}", shelf.releases / "0001.bak")
    assert release(configuration, proposal(folder, model("ridge-2")), person="anna").number == 2
    assert [record.number for record in shelf.records()] == [1, 2]


def test_the_ten_thousandth_release_is_the_newest(folder):
    """A policy comes to it in nine years."""
    configuration = configured(folder)
    first = release(configuration, proposal(folder, model("ridge-1")), person="anna")
    shelf = repository_of(configuration)
    (late := shelf.releases / "9999").mkdir()
    (late / "release.json").write_text(first.model_copy(update={"number": 9999}).model_dump_json())
    assert release(configuration, proposal(folder, model("ridge-2")), person="anna").number == 10_000
    assert [record.number for record in shelf.records()] == [1, 9999, 10_000]


def test_going_back_again_goes_further_back_and_never_to_what_was_gone_back_from(folder):
    configuration = configured(folder)
    for name in ("ridge-1", "ridge-2", "ridge-3"):
        release(configuration, proposal(folder, model(name)), person="anna")
    assert [rollback(configuration, person="ben").model_id for _ in range(2)] == ["ridge-2", "ridge-1"]
    with pytest.raises(ReleaseError, match="no earlier release"):
        rollback(configuration, person="ben")
    release(configuration, proposal(folder, model("ridge-4")), person="anna")
    assert rollback(configuration, person="ben").model_id == "ridge-1"


def test_going_back_ends_with_the_first_release_though_its_model_was_released_twice(folder):
    configuration = configured(folder)
    for name in ("ridge-1", "ridge-2", "ridge-1"):
        release(configuration, proposal(folder, model(name)), person="anna")
    assert [rollback(configuration, person="ben").model_id for _ in range(2)] == ["ridge-2", "ridge-1"]
    with pytest.raises(ReleaseError, match="no earlier release"):
        rollback(configuration, person="ben")


def test_models_of_releases_that_nothing_leads_back_to_are_removed_and_said_in_the_record(folder, monkeypatch):
    """Every eight hours a proposal of up to 10 MiB: without an end 10 GiB a year."""
    monkeypatch.setattr(repository, "MODELS_KEPT", 3)
    configuration = configured(folder)
    for number in range(1, 6):
        release(configuration, proposal(folder, model(f"ridge-{number}")), person="anna")
    assert rollback(configuration, person="anna", to=2).number == 6
    shelf = repository_of(configuration)
    there = [number for number in range(1, 7) if (shelf.releases / f"000{number}/model.json").exists()]
    assert there == [1, 2, 3, 4, 5, 6], "going back again leads to 1, and the oldest that is kept, 4, replaced 3"
    for number in range(7, 10):
        last = release(configuration, proposal(folder, model(f"ridge-{number}")), person="anna")
    there = [number for number in range(1, 10) if (shelf.releases / f"000{number}/model.json").exists()]
    assert there == [2, 5, 6, 7, 8, 9] and last.checks[-1].endswith("their records stay: 1, 4"), last.checks
    assert load_released(configuration, own_account()).record == last == shelf.records()[-1]
    assert [each.number for each in shelf.records()] == [*range(1, 10)]
    assert [shelf.holds(number) for number in (1, 2, 3)] == [False, True, False]
    with pytest.raises(ReleaseError, match=r"only the record of release 3 is there; the models of the newest 3"):
        rollback(configuration, person="anna", to=3)
    assert rollback(configuration, person="anna").model_id == "ridge-8"


def refusal(folder: Path, path: Path, **changes: object) -> str:
    configuration = configured(folder, **changes)
    with pytest.raises(ReleaseError) as refused:
        release(configuration, path, person="anna")
    assert not (folder / "models/model.json").exists()
    return str(refused.value)


def test_what_is_refused_says_why(folder):
    configured(folder)
    good = proposal(folder, model())
    assert "does not fit the content" in refusal(folder, damaged(good, "model_id", "other"))
    has_none = refusal(folder, proposal(folder, one_channel()))
    assert "no channel 'Z1'; it has 'Y1': let compensation.axes.AXIS.estimate name one of these" in has_none
    assert "nothing was held out" in refusal(folder, proposal(folder, model(band_um=np.nan)))
    assert "wider than 30 um" in refusal(folder, proposal(folder, model(band_um=31.0)))
    shares = [1.3 if channel == "Z1" else 0.4 for channel in model().channels]
    harmful = replace(model(), hyper_parameters={"held_out_relative_rmse_by_channel": shares})
    assert "channel Z1: 130% of its error remains on what was left out" in refusal(folder, proposal(folder, harmful))
    narrow = ReleaseConfig(largest_band_um=1.5)
    assert "wider than 1.5 um" in refusal(folder, proposal(folder, model()), release=narrow)
    assert "cannot be read" in refusal(folder, folder / "nowhere.json")
    assert "no file of a model" in refusal(folder, folder)
    (folder / "link.json").symlink_to(good)
    assert "name the proposal's own file" in refusal(folder, folder / "link.json")
    with pytest.raises(RefusedInputError, match="model_file is not set"):
        release(configured(folder, model_file=None), good, person="anna")


def damaged(path: Path, key: str, value: object) -> Path:
    content = json.loads(path.read_text(encoding="utf-8"))
    content["model"] |= {key: value}
    copy = path.with_name("damaged.json")
    copy.write_text(json.dumps(content), encoding="utf-8")
    return copy


def one_channel() -> LinearModel:
    full = model()
    vectors = tuple(replace(v, thermal_error_um=v.thermal_error_um[:1]) for v in full.test_vectors)
    one = replace(full.solutions[0], weights=full.solutions[0].weights[:, :1].copy())
    return replace(
        full, channels=("Y1",), solutions=(one,), drift_um_per_min=np.zeros(1), band_um=np.ones(1), test_vectors=vectors
    )


@as_root
def test_a_place_that_the_daemon_could_write_is_refused(folder):
    configuration = configured(folder)
    os.chown(folder / "state", OTHER, OTHER)
    (folder / "models").chmod(0o777)
    with pytest.raises(ReleaseError, match="the daemon could change a model there"):
        release(configuration, proposal(folder, model()), person="anna")


@as_root
def test_the_person_is_who_logged_in_not_root(monkeypatch):
    assert f"(uid {OTHER})" in as_user(OTHER, person_now)
    monkeypatch.setenv("SUDO_UID", str(OTHER))
    assert f"(uid {OTHER + 1})" in as_user(OTHER + 1, person_now), "only root's word counts for somebody else"
    monkeypatch.setattr("daemon.model_release.releasing._login_uid", lambda: str(2**32 - 1))
    assert person_now() == f"unknown (uid {OTHER}) as root"
    monkeypatch.delenv("SUDO_UID")
    assert person_now() == "root (uid 0)"


@as_root
def test_the_daemons_own_account_releases_nothing(folder):
    configuration = configured(folder)
    path = proposal(folder, model())
    for place in (folder / "state", folder / "models"):
        os.chown(place, OTHER, OTHER)
    answer = as_user(OTHER, lambda: str(release(configuration, path, person="daemon")))
    assert "the daemon may not release its own model" in answer


def test_a_proposal_of_a_clock_that_is_right_again_is_the_newest_of_all_and_stays(folder):
    configuration = configured(folder)
    for number in range(MOST_PROPOSALS):
        path = proposal(folder, model(f"ahead-{number}"), f"ahead-{number}.json")
        os.utime(path, (time.time() + 1e8 + number,) * 2)
    path = propose(configuration, model("ridge-1"))
    assert path.exists() and len(waiting := proposals(configuration)) == MOST_PROPOSALS
    assert waiting[-1].path == path and waiting[0].path.name == "ahead-1.json"


@as_root
def test_a_proposal_of_the_daemons_user_is_read_by_the_account_that_releases(folder):
    configuration = configured(folder)
    os.chown(folder / "state", OTHER, OTHER)
    (folder / "state/proposals").rmdir()

    def by_daemon() -> str:
        os.umask(0o077)
        return propose(configuration, model("../ridge 1")).name

    assert as_user(OTHER, by_daemon) == "-ridge-1.json"
    os.chown(folder / "models", OTHER + 1, OTHER + 1)

    def by_releaser() -> str:
        (waiting,) = proposals(configuration)
        return release(configuration, waiting.path, person="anna").model_id

    assert as_user(OTHER + 1, by_releaser) == "../ridge 1"
    assert "release 1 by anna" in as_user(OTHER, lambda: load_released(configuration, own_account()).in_words())
