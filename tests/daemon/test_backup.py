"""Back-ups are whole or not there; what is restored starts nothing by itself."""

import io
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tarfile
import time
import tracemalloc
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO

import pytest
import yaml
from click.testing import CliRunner
from control_rig import record_for
from installation import Installation
from speed_machine import bearing_model, speed_machine

from config.files import LARGEST_FILE
from config.loader import load_configuration
from config.machine.spindle import spindle_folder
from config.records.commissioning import CommissionedAxis, load_commissioning
from config.schema import Configuration
from daemon.backup.archive import LARGEST, MOST_MEMBERS
from daemon.backup.making import make_backup, remove_old
from daemon.backup.manifest import BackupError, last_block_beside
from daemon.backup.names import backup_name, existing_backups
from daemon.backup.places import Places
from daemon.backup.restoring import read_manifest, restore
from daemon.cli import main
from daemon.history.database import HistoryError
from daemon.history.reader import HistoryReader
from daemon.model_release.bearings import BEARINGS, open_planning
from daemon.model_release.file_access import Account
from daemon.model_release.releasing import release, rollback
from models.thermomechanics.artifact import model_to_json

EVER = (0.0, 1e11)


def state_of(store: Path) -> dict[str, object]:
    with closing(sqlite3.connect(store)) as connection:
        return {key: json.loads(text) for key, text in connection.execute("SELECT key, json FROM state")}


def elsewhere(installation: Installation) -> Path:
    """Return the configuration of another computer, on which nothing else is installed yet."""
    path = installation.folder.parent / "there/etc/toolpoint.yaml"
    path.parent.mkdir(parents=True)
    shutil.copyfile(installation.config_path, path)
    return path


# --- making ----------------------------------------------------------------------------------


def test_the_manifest_names_the_secrets_and_files_that_are_not_in_it(installation, tmp_path):
    content = yaml.safe_load(installation.config_path.read_text(encoding="utf-8"))
    content["cnc"]["opcua"]["security"] = {
        "user_name": "toolpoint",
        "password_file": "/run/credentials/password",
        "certificate": "/etc/own.der",
        "private_key": "/run/credentials/own.pem",
        "server_certificate": "/etc/cnc.der",
    }
    database = {"host": "db", "password_file": "/run/credentials/database"}
    content["sinks"] = [{"name": "plant", "driver": "postgresql", "postgresql": database}]
    tuned = speed_machine(tmp_path)
    content["spindle_speed"] = json.loads(tuned.spindle_speed.model_dump_json())
    content["spindle_speed"]["operations"][0]["spindles"]["x"] = "/etc/toolpoint/spindle.yaml"
    content["cnc"]["macros"]["writable"] = list(tuned.cnc.macros.writable)
    installation.config_path.write_text(yaml.safe_dump(content), encoding="utf-8")
    path = installation.folder / "secured.tar"
    make_backup(load_configuration(installation.config_path), installation.config_path, path)
    left_out = read_manifest(path).left_out
    assert "cnc.opcua.security.password_file: /run/credentials/password" in left_out
    assert "cnc.opcua.security.private_key: /run/credentials/own.pem" in left_out
    assert "sinks[0].postgresql.password_file: /run/credentials/database" in left_out
    assert left_out[-1] == "/etc/toolpoint/spindle.yaml: there is no such file, and a spindle speed is planned with it"


def test_a_backup_beside_a_writing_daemon_holds_all_and_is_proved(installation):
    installation.release("ridge-1", "ridge-2")
    writer = installation.writer()
    writer.start()
    try:
        writer.event("note", "while it runs", "anna").result(30)
        path = installation.backup()
        writer.event("note", "afterwards", "anna").result(30)
    finally:
        writer.close()
    manifest = read_manifest(path)
    assert [file.name for file in manifest.files] == [
        "store/history.sqlite",
        "configuration/toolpoint.yaml",
        "store/last-block",
        "commissioning/record.json",
        "models/model.json",
        "models/releases/0001/model.json",
        "models/releases/0001/release.json",
        "models/releases/0002/model.json",
        "models/releases/0002/release.json",
    ]
    assert manifest.machine == "Mill 7 (hall)" and manifest.active_release == 2
    assert any("password" in words for words in manifest.left_out)
    assert path.stat().st_mode & 0o007 == 0
    with tarfile.open(path) as archive:
        store = archive.extractfile("store/history.sqlite")
        assert store is not None
        (installation.folder / "copy.sqlite").write_bytes(store.read())
        configuration = archive.extractfile("configuration/toolpoint.yaml")
        assert configuration is not None and configuration.read() == installation.config_path.read_bytes()
    with HistoryReader(installation.folder / "copy.sqlite") as reader:
        assert [event.text for event in reader.events(*EVER)] == ["before the back-up", "while it runs"]
    assert sorted(p.name for p in installation.folder.iterdir() if p.name.startswith(".")) == []


def test_years_of_releases_go_into_a_backup_and_come_out_again(installation):
    """With proposals every eight hours there are a thousand a year, of up to 10 MiB; the service has 512 MiB."""
    installation.release("ridge-1")
    releases = installation.configuration.compensation.model_file.parent / "releases"
    record = json.loads((releases / "0001/release.json").read_text(encoding="utf-8"))
    content = bytes(8 << 20)
    for number in range(2, 8):
        (folder := releases / f"{number:04d}").mkdir()
        (folder / "model.json").write_bytes(content)
        told = record | {"number": number, "sha256": sha256(content).hexdigest()}
        (folder / "release.json").write_text(json.dumps(told), encoding="utf-8")
    (releases / "0003/model.json").unlink()  # of old releases the record alone is kept
    tracemalloc.start()
    path = installation.backup()
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most_bytes < LARGEST_FILE + 2 * len(content), "a reader of one file takes room for the largest"
    restore(path, installation.config_path, person="anna", replace=True)
    manifest = read_manifest(path)
    entry = next(each for each in manifest.files if each.name.endswith("0007/release.json"))
    five_years = manifest.model_copy(update={"files": [entry] * 3 * 5 * 1100})
    assert len(five_years.model_dump_json(indent=2)) < LARGEST[0][1] and MOST_MEMBERS > 3 * 5 * 1100


def test_a_backup_overwrites_nothing_and_leaves_nothing_half_done(installation):
    path = installation.backup()
    with pytest.raises(BackupError, match="exists already"):
        installation.backup()
    installation.configuration.history.path.unlink()
    with pytest.raises(BackupError, match="there is no history store"):
        installation.backup("second.tar")
    assert sorted(p.name for p in installation.folder.iterdir()) == ["backup.tar", "etc", "models", "state"]
    assert read_manifest(path).store_schema >= 1


def test_what_a_backup_leaves_that_was_killed_does_not_fill_the_disk(installation, tmp_path):
    """A machine's main switch, or the end of the daemon, comes in the middle of a back-up again and again."""
    folder = installation.folder / "backups"
    folder.mkdir()
    path = folder / backup_name("Mill 7 (hall)", datetime.now(UTC))
    script = """
import os, signal, sys
from pathlib import Path
from config.loader import load_configuration
from config.machine.spindle import spindle_folder
from daemon.backup import making
making.write_archive = lambda partial, *_: (partial.write_bytes(b"half"), os.kill(os.getpid(), signal.SIGKILL))
making.make_backup(load_configuration(Path(sys.argv[1])), Path(sys.argv[1]), Path(sys.argv[2]))
"""
    command = [sys.executable, "-P", "-c", script, installation.config_path, path]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    partial, work = sorted(folder.iterdir(), key=Path.is_dir)
    assert partial.name == f".{path.name}.partial" and (work / "history.sqlite").is_file()
    beside = installation.backup("backups/beside.tar")
    assert partial.exists() and work.exists(), "another back-up may be being made"
    for left, days in ((partial, 2), (work, -2)):
        os.utime(left, (then_s := time.time() + 86_400.0 * days, then_s))
    beside.unlink()
    installation.backup("backups/beside.tar")
    assert list(folder.iterdir()) == [beside]


def test_a_link_in_the_place_of_the_half_done_backup_is_not_followed(installation, tmp_path):
    """The folder may be the daemon's own, and root makes a back-up there too."""
    (tmp_path / "of_root").write_text("left as it is", encoding="utf-8")
    (tmp_path / ".b.tar.partial").symlink_to(tmp_path / "of_root")
    path = tmp_path / "b.tar"
    make_backup(load_configuration(installation.config_path), installation.config_path, path)
    assert (tmp_path / "of_root").read_text(encoding="utf-8") == "left as it is"
    assert read_manifest(path).files and not path.is_symlink()


def test_backups_of_a_clock_that_was_ahead_make_room_for_those_of_the_right_one(installation):
    folder = installation.folder / "backups"
    folder.mkdir()
    ahead = [f"toolpoint-mill-7-hall-2099010{day}T000000Z.tar" for day in range(1, 4)]
    right = [f"toolpoint-mill-7-hall-2026010{day}T000000Z.tar" for day in range(1, 4)]
    for name in ahead:
        (folder / name).touch()
    for name in right:
        (folder / name).touch()
        remove_old(folder, "Mill 7 (hall)", 3, spare=folder / name)
    assert sorted(path.name for path in folder.iterdir()) == right


@pytest.mark.parametrize("other", ["mill 7 hall", "Mill 7 (hall)+", 'Mill 7 "hall"'])
def test_machines_whose_names_differ_in_signs_keep_backups_of_their_own_in_one_folder(installation, other):
    folder, config = installation.folder, installation.configuration
    now = datetime.now(UTC)
    of_other = config.model_copy(update={"machine": other})
    own, others = folder / backup_name(config.machine, now), folder / backup_name(other, now - timedelta(seconds=60))
    assert own.stem[:-16] == others.stem[:-16]
    make_backup(config, installation.config_path, own)
    make_backup(of_other, installation.config_path, others)
    assert existing_backups(folder, config.machine) == [own] and existing_backups(folder, other) == [others]
    assert remove_old(folder, config.machine, 1) == [] and others.exists()


def test_machines_whose_names_have_no_latin_letter_keep_backups_of_their_own_in_one_folder(tmp_path):
    """Both were `machine`: the one that backs up more often pushed out every back-up of the other."""
    lathe, mill = (
        backup_name("旋盤", datetime(2026, 1, 2, tzinfo=UTC)),
        backup_name("研削盤", datetime(2026, 1, 1, tzinfo=UTC)),
    )
    for name in (lathe, mill):
        (tmp_path / name).touch()
    remove_old(tmp_path, "旋盤", 1)
    assert [path.name for path in existing_backups(tmp_path, "研削盤")] == [mill]
    assert [path.name for path in existing_backups(tmp_path, "旋盤")] == [lathe]


# --- proving ---------------------------------------------------------------------------------


def rewritten(path: Path, change: str) -> Path:
    """Return a copy of a back-up in which one thing is wrong."""
    copy = path.with_name(f"{change}.tar")
    with tarfile.open(path) as archive, tarfile.open(copy, "w") as out:
        for member in archive.getmembers():
            stream = archive.extractfile(member)
            assert stream is not None
            content = stream.read()
            if change == "flipped" and member.name == "store/history.sqlite":
                content = content[:-1] + bytes([content[-1] ^ 1])
            if change == "shortened" and member.name == "store/last-block":
                content = content[:-3]
            if change == "missing" and member.name == "commissioning/record.json":
                continue
            if change == "link" and member.name == "commissioning/record.json":
                member.type, member.linkname, content = tarfile.SYMTYPE, "/etc/passwd", b""
            if change == "version" and member.name == "manifest.json":
                content = content.replace(b'"format_version": 1', b'"format_version": 2')
            if change == "climbing" and member.name == "manifest.json":
                content = content.replace(b"commissioning/record.json", b"commissioning/../../../x")
            member.name = (
                "commissioning/../../../x"
                if change == "climbing" and member.name == "commissioning/record.json"
                else member.name
            )
            member.size = len(content)
            out.addfile(member, io.BytesIO(content))
        if change == "extra":
            out.addfile(tarfile.TarInfo("store/more"), io.BytesIO())
    return copy


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("flipped", "store/history.sqlite was damaged"),
        ("shortened", "store/last-block was damaged"),
        ("missing", "other files than its manifest names"),
        ("extra", "store/more is nothing that a back-up holds"),
        ("link", "commissioning/record.json is no plain file"),
        ("climbing", "is nothing that a back-up holds"),
        ("version", "format_version"),
    ],
)
def test_a_backup_that_is_not_whole_is_refused(installation, change, words):
    path = rewritten(installation.backup(), change)
    target = elsewhere(installation)
    with pytest.raises(BackupError, match=words):
        restore(path, target, person="anna", replace=False)
    assert [path for path in target.parents[1].rglob("*") if path.is_file()] == [target]


# --- restoring -------------------------------------------------------------------------------


def test_an_empty_installation_gets_everything_but_the_will_to_move(installation):
    installation.release("ridge-1", "ridge-2")
    rollback(installation.configuration, person="ben")
    path, target = installation.backup(), elsewhere(installation)
    done = restore(path, target, person="anna (uid 1)", replace=False)
    assert done.kept == ()
    assert target.read_text(encoding="utf-8").startswith("# written by hand\n")
    there = load_configuration(target)
    store, model_file = there.history.path, there.compensation.model_file
    assert store.resolve() == (target.parents[1] / "state/history.sqlite").resolve() and model_file is not None
    assert str(model_file.readlink()) == "releases/0003/model.json"
    assert "ridge-1" in model_file.read_text(encoding="utf-8")
    state = state_of(store)
    assert sorted(state) == ["fault", "spindle_speed_off"] and "compare the macro variables" in str(state["fault"])
    assert "restoration" in str(state["spindle_speed_off"]), "nor is a speed tuned that was switched off since"
    assert not last_block_beside(store).exists(), "what was being written then says nothing about now"
    with HistoryReader(store) as reader:
        events = reader.events(*EVER)
    assert [event.kind for event in events] == ["note", "restored"] and events[1].person == "anna (uid 1)"
    assert there.compensation.commissioning_file is not None and there.compensation.commissioning_file.is_file()


def tuned(installation: Installation, **operation: object) -> Configuration:
    """Let the spindle speed follow a released bearing model, by a spindle and a case beside the configuration."""
    content = yaml.safe_load(installation.config_path.read_text(encoding="utf-8"))
    tuned = speed_machine(installation.folder)
    content["spindle_speed"] = json.loads(tuned.spindle_speed.model_dump_json())
    content["spindle_speed"]["thermomechanical_model"] = "../models/bearings.json"
    content["spindle_speed"]["operations"][0] |= {"spindles": {"x": "own.yaml", "y": "simulated_machine"}}
    content["spindle_speed"]["operations"][0] |= {"case": "case.yaml"} | operation
    content["cnc"]["macros"]["writable"] = list(tuned.cnc.macros.writable)
    etc = installation.config_path.parent
    shutil.move(installation.folder / "case.yaml", etc / "case.yaml")
    shutil.copyfile(spindle_folder() / "simulated_machine.yaml", etc / "own.yaml")
    installation.config_path.write_text(yaml.safe_dump(content), encoding="utf-8")
    installation.configuration = load_configuration(installation.config_path)
    for name in ("a", "b"):
        path = installation.folder / f"{name}.json"
        path.write_text(model_to_json(replace(bearing_model(), model_id=name)), encoding="utf-8")
        release(installation.configuration, path, person="anna", kind=BEARINGS)
    return installation.configuration


def test_what_spindle_speeds_are_planned_with_is_restored_under_the_rules_of_models(installation):
    before = tuned(installation)
    path, target = installation.backup(), elsewhere(installation)
    done = restore(path, target, person="anna", replace=False)
    there = load_configuration(target)
    model_file = there.spindle_speed.thermomechanical_model
    assert str(model_file.readlink()) == "bearings-releases/0002/model.json" and done.unplaced == ()
    for file in ("case.yaml", "own.yaml"):
        assert (target.parent / file).read_bytes() == (before.history.path.parents[1] / "etc" / file).read_bytes()
    opened = open_planning(there, Account(user_id=None))
    assert opened.inhibit == "" and opened.model.record.number == 2
    with pytest.raises(BackupError, match=r"thermomechanical_model is .* and none here.*--bearings-file"):
        given = replace(Places.of(there), bearings_file=None)
        restore(path, installation.folder / "new/etc/toolpoint.yaml", person="anna", replace=True, given=given)


@pytest.mark.parametrize("case", ["../other/case.yaml", "commissioning.json", "toolpoint.yaml"])
def test_a_case_goes_to_no_place_that_an_archive_alone_names_and_nothing_else_goes_for_one(installation, case):
    configuration = tuned(installation)
    operation = configuration.spindle_speed.operations[0]
    (named := installation.config_path.parent / case).parent.mkdir(exist_ok=True)
    if not named.exists():
        shutil.copyfile(operation.case, named)
    text = installation.config_path.read_text(encoding="utf-8").replace("case: case.yaml", f"case: {case}")
    installation.config_path.write_text(text, encoding="utf-8")
    installation.configuration = load_configuration(installation.config_path)
    path, target = installation.backup(), elsewhere(installation)
    given = Places.of(load_configuration(target))
    target.unlink()
    options = {"--store": given.store, "--commissioning-file": given.commissioning_file}
    options |= {"--model-file": given.model_file, "--bearings-file": given.bearings_file, "--config": target}
    named_places = [str(word) for option in options.items() if option[1] is not None for word in option]
    done = CliRunner().invoke(main, ["restore", str(path), "--json", "-", *named_places])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert f"{named}: in the back-up as planning/0/case.yaml; put it there by hand" in told["not_here"]
    assert told["left"] == [] and str(given.store) in told["placed"]
    assert not (target.parent / "../other/case.yaml").exists() and target.read_text(encoding="utf-8") == text
    assert load_commissioning(target.with_name("commissioning.json")).person


def test_nothing_is_overwritten_and_with_replace_everything_is_kept(installation):
    installation.release("ridge-1")
    path = installation.backup()
    before = installation.config_path.read_bytes()
    with pytest.raises(BackupError, match="--replace moves what is there aside") as refused:
        restore(path, installation.config_path, person="anna", replace=False)
    for name in ("history.sqlite", "releases", "model.json"):
        assert name in str(refused.value)
    assert "commissioning.json" not in str(refused.value), "what is the same is left alone"
    writer = installation.writer()
    writer.start()
    writer.event("note", "after the back-up")
    writer.close()
    installation.config_path.write_text("changed: true\n", encoding="utf-8")
    with pytest.raises(BackupError, match=r"cannot be read, so it names no places.*--store"):
        restore(path, installation.config_path, person="anna", replace=True)
    places = Places.of(installation.configuration)
    done = restore(path, installation.config_path, person="anna", replace=True, given=places)
    assert not [path for path in (*done.kept, *done.placed) if "commissioning.json" in path.name]
    kept = {item.name.split(".before-restore-")[0]: item for item in done.kept}
    assert {"toolpoint.yaml", "history.sqlite", "history.sqlite.last-block", "releases", "model.json"} <= set(kept)
    assert installation.config_path.read_bytes() == before
    assert kept["toolpoint.yaml"].read_text(encoding="utf-8") == "changed: true\n"
    with HistoryReader(kept["history.sqlite"]) as reader:
        assert reader.events(*EVER)[-1].text == "after the back-up"
        assert reader.get_state("wanted")["axes"] == {"y": True, "z": True}


def test_the_accounts_that_released_models_may_do_so_after_a_restoration(installation):
    installation.release("ridge-1")
    models = installation.configuration.compensation.model_file.parent
    models.chmod(0o2775)
    path = installation.backup()
    restore(path, installation.config_path, person="anna", replace=True)
    assert (models / "releases").stat().st_mode & 0o7777 == 0o2775, "as the first release makes it"
    assert (models / "releases/0001").stat().st_mode & 0o7777 == 0o755, "what is released is not changed"


@pytest.mark.parametrize(("date", "stays"), [("2026-01-01", True), ("2026-03-01", True), ("2025-12-31", False)])
def test_a_machine_that_was_commissioned_since_the_backup_keeps_its_record(installation, date, stays):
    record, path = installation.folder / "etc/commissioning.json", installation.backup()
    before = record.read_text(encoding="utf-8")
    axes = dict.fromkeys("yz", CommissionedAxis(sign=-1, scale=1.0, written_um=10.0, measured_um=-10.0))
    since = record_for(installation.configuration, axes=axes, date=date).model_dump_json()
    record.write_text(since, encoding="utf-8")
    record.with_name("commissioning.json.sig").write_bytes(b"of the new one")
    done = restore(path, installation.config_path, person="anna", replace=True)
    assert record.read_text(encoding="utf-8") == (since if stays else before)
    assert done.left == ((record,) if stays else ())
    assert any(kept.name.startswith("commissioning.json.before") for kept in done.kept) is not stays
    if stays:
        assert record.with_name("commissioning.json.sig").read_bytes() == b"of the new one"


@pytest.mark.parametrize("keep_configuration", [False, True])
def test_a_backup_of_another_machine_is_refused(installation, keep_configuration):
    """A plant's machines have the same places: one would command another's control, or take its sensors' levels."""
    path, config = installation.backup(), installation.config_path
    config.write_text(config.read_text(encoding="utf-8").replace("Mill 7 (hall)", "Mill 8"), encoding="utf-8")
    words = r"is of machine 'Mill 7 \(hall\)', and the installed configuration is that of 'Mill 8'"
    with pytest.raises(BackupError, match=words):
        restore(path, config, person="anna", replace=True, keep_configuration=keep_configuration)
    assert state_of(installation.configuration.history.path)["wanted"]["axes"] == {"y": True, "z": True}


def test_a_running_daemon_is_not_restored_over(installation):
    path = installation.backup()
    writer = installation.writer()
    writer.start()
    try:
        with pytest.raises(BackupError, match=r"writes this store.*systemctl stop"):
            restore(path, installation.config_path, person="anna", replace=True)
    finally:
        writer.close()
    assert state_of(installation.configuration.history.path)["wanted"]["axes"] == {"y": True, "z": True}


def test_a_terminal_that_goes_or_a_stop_leaves_neither_half_a_restoration_nor_half_a_backup(installation):
    """A session over the network that is lost: without its store the daemon would begin an empty one."""
    path, config, folder = installation.backup(), installation.config_path, installation.folder / "state"
    known = {each.name for each in folder.iterdir()} | {f"history.sqlite{end}" for end in (".lock", "-wal", "-shm")}
    for by, broken_off, words in (
        ("SIGHUP", "restoring._place", ["restore", str(path), "--replace"]),
        ("SIGTERM", "making.write_archive", ["backup", str(folder / "b.tar")]),
    ):
        script = f"""
import os, signal, sys, time
from daemon.backup import making, restoring
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # where the tests are started by `nohup`
signal.pthread_sigmask(signal.SIG_UNBLOCK, {{signal.SIGHUP}})  # after a test of `run` in the same process
{broken_off} = lambda *_: (os.kill(os.getpid(), signal.{by}), time.sleep(60))
from daemon.cli import main
main(sys.argv[1:])
"""
        done = subprocess.run([sys.executable, "-P", "-c", script, *words, "--config", config], check=False)
        assert done.returncode == 1
        assert state_of(installation.configuration.history.path)["wanted"]["axes"] == {"y": True, "z": True}
        assert {each.name for each in folder.iterdir()} <= known


@pytest.mark.parametrize("placed", [0, 1, 2])
def test_a_restoration_that_a_power_cut_ended_is_undone_by_the_next_and_no_daemon_starts_before(installation, placed):
    """Without its store the daemon began an empty one; what was unpacked stayed for good."""
    installation.release("ridge-1")
    path, config, folder = installation.backup(), installation.config_path, installation.folder
    config.write_text(config.read_text(encoding="utf-8") + "# later\n", encoding="utf-8")
    before = {item: item.read_bytes() for item in folder.rglob("*") if item.is_file()}
    script = f"""
import os, signal, sys
from daemon.backup import restoring
place, done = restoring._place, []
def cut(source, path, *more):
    if not str(source).count("/releases/"):
        done.append(path)
    if len(done) > {placed}:
        os.kill(os.getpid(), signal.SIGKILL)
    place(source, path, *more)
restoring._place = cut
from daemon.cli import main
main(sys.argv[1:])
"""
    words = ["restore", str(path), "--replace", "--config", config]
    assert subprocess.run([sys.executable, "-P", "-c", script, *words], check=False).returncode == -9
    for _ in range(2):
        with pytest.raises(HistoryError, match=r"`toolpoint restore` was broken off; run it again"):
            installation.writer().start()
    places = Places.of(installation.configuration)
    with pytest.raises(BackupError, match="--replace moves what is there aside"):
        restore(path, config, person="anna", replace=False, given=places)
    after = {item: item.read_bytes() for item in folder.rglob("*") if item.is_file()}
    lock = Path(f"{places.store}.lock")
    assert {k: v for k, v in after.items() if k != lock} == {k: v for k, v in before.items() if k != lock}
    assert not list(folder.rglob(".toolpoint-restore-*"))
    restore(path, config, person="anna", replace=True)
    assert not list(folder.rglob(".toolpoint-restore-*"))


def test_a_disk_too_full_for_the_plan_of_a_restoration_keeps_no_daemon_away(installation, monkeypatch):
    path = installation.backup()

    def full(file: Path, _content: str) -> None:
        file.with_name("plan.partial").write_text("{", encoding="utf-8")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("daemon.backup.restoring.write_whole", full)
    with pytest.raises(BackupError, match="No space left on device"):
        restore(path, installation.config_path, person="anna", replace=True)
    assert not list(installation.folder.rglob(".toolpoint-restore-*"))
    writer = installation.writer()
    writer.start()
    writer.close()


@pytest.mark.parametrize("broken_off", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_half_a_restoration_is_undone(installation, monkeypatch, broken_off):
    path = installation.backup()
    installation.config_path.write_text("changed: true\n", encoding="utf-8")
    before = {item: item.read_bytes() for item in installation.folder.rglob("*") if item.is_file()}
    copy, copied = shutil.copyfileobj, []

    def until_it_is_broken_off(source: BinaryIO, destination: BinaryIO) -> None:
        if copied:
            raise broken_off
        copied.append(copy(source, destination))

    monkeypatch.setattr("daemon.backup.restoring.shutil.copyfileobj", until_it_is_broken_off)
    with pytest.raises(BackupError if isinstance(broken_off, OSError) else KeyboardInterrupt):
        restore(
            path, installation.config_path, person="anna", replace=True, given=Places.of(installation.configuration)
        )
    after = {item: item.read_bytes() for item in installation.folder.rglob("*") if item.is_file()}
    lock = Path(f"{installation.configuration.history.path}.lock")
    assert {k: v for k, v in after.items() if k != lock} == {k: v for k, v in before.items() if k != lock}
