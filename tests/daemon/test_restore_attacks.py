"""Archives that somebody has made to do harm: refused before anything is written, whoever restores them."""

import hashlib
import io
import json
import os
import shutil
import sqlite3
import tarfile
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from installation import Installation
from other_user import as_root

from config.loader import load_configuration
from daemon.backup.manifest import BackupError
from daemon.backup.restoring import read_manifest, restore
from daemon.cli import main

GIB = 2**30


@pytest.fixture
def installation(tmp_path: Path) -> Installation:
    made = Installation(tmp_path / "here")
    made.fill()
    made.release("ridge-1")
    return made


def files_of(archive: Path) -> dict[str, bytes]:
    with tarfile.open(archive) as opened:
        contents = {member.name: opened.extractfile(member) for member in opened.getmembers()}
        return {name: stream.read() for name, stream in contents.items() if stream is not None}


def packed(path: Path, files: Mapping[str, bytes]) -> Path:
    """Write an archive whose manifest fits what is in it."""
    manifest = json.loads(files["manifest.json"])
    came_from = {item["name"]: item["came_from"] for item in manifest["files"]}
    manifest["files"] = [
        {
            "name": name,
            "sha256": hashlib.sha256(content).hexdigest(),
            "size_bytes": len(content),
            "came_from": came_from.get(name, "x"),
        }
        for name, content in files.items()
        if name != "manifest.json"
    ]
    with tarfile.open(path, "w") as archive:
        for name, content in {**files, "manifest.json": json.dumps(manifest).encode()}.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return path


def photograph(folder: Path) -> dict[Path, bytes | None]:
    """Everything below a folder, apart from the lock that a restoration takes."""
    return {
        path: path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
        if not path.name.endswith(".lock")
    }


# --- places ----------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["history.path", "compensation.commissioning_file", "compensation.model_file"])
def test_an_archive_names_no_place_to_write_to(installation: Installation, tmp_path: Path, key: str) -> None:
    files = files_of(installation.backup())
    content = yaml.safe_load(files["configuration/toolpoint.yaml"])
    section, name = key.split(".")
    theirs = tmp_path / "somebody else's"
    theirs.mkdir()
    content[section][name] = str(theirs / "file")
    evil = packed(tmp_path / "evil.tar", {**files, "configuration/toolpoint.yaml": yaml.safe_dump(content).encode()})
    before = photograph(tmp_path)
    with pytest.raises(BackupError, match=rf"{key} is {theirs}/file in the back-up and {tmp_path}/here"):
        restore(evil, installation.config_path, person="anna", replace=True)
    assert photograph(tmp_path) == before


def test_without_an_installed_configuration_a_person_names_the_places(
    installation: Installation, tmp_path: Path
) -> None:
    archive, target = installation.backup(), tmp_path / "there/etc/toolpoint.yaml"
    options = ["restore", str(archive), "--config", str(target)]
    refused = CliRunner().invoke(main, options)
    assert refused.exit_code == 1 and not target.parent.exists()
    _, _, told = refused.output.partition("name them: ")
    named = told.partition(";")[0].split()
    assert named[::2] == ["--commissioning-file", "--model-file", "--store"]
    done = CliRunner().invoke(main, [*options, *named])
    assert done.exit_code == 0, done.output
    configuration = load_configuration(target)
    assert configuration.history.path.is_file() and configuration.compensation.model_file is not None
    assert configuration.compensation.model_file.is_file()


@as_root
def test_nothing_is_written_through_a_link(installation: Installation, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    archive = installation.backup()
    record = installation.folder / "etc/commissioning.json"
    for content in (b"not to be touched", None):
        record.unlink()
        victim.unlink(missing_ok=True)
        if content is not None:
            victim.write_bytes(content)
        record.symlink_to(victim)
        restore(archive, installation.config_path, person="anna", replace=True)
        assert (victim.read_bytes() if victim.exists() else None) == content
        assert not record.is_symlink() and record.is_file()


# --- structure -------------------------------------------------------------------------------


def header(name: str, size: int, kind: bytes = tarfile.REGTYPE, **changes: object) -> bytes:
    member = tarfile.TarInfo(name)
    member.size, member.type = size, kind
    for key, value in changes.items():
        setattr(member, key, value)
    return member.tobuf(tarfile.GNU_FORMAT)


def sparse_member(size: int) -> bytes:
    """One GNU sparse member that holds 256 KiB and says that it is this large."""
    data = bytes(256 * 1024)
    block = bytearray(header("store/history.sqlite", len(data), tarfile.GNUTYPE_SPARSE))
    block[386:398], block[398:410] = b"%011o\0" % 0, b"%011o\0" % len(data)
    block[483:495] = tarfile.itn(size, 12, tarfile.GNU_FORMAT)  # type: ignore[attr-defined]
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block) + data


def pax(name: str, size: int, **records: str) -> bytes:
    member = tarfile.TarInfo(name)
    member.size = size
    member.pax_headers = records
    return member.tobuf(tarfile.PAX_FORMAT)


def crafted(tmp_path: Path, *pieces: bytes) -> Path:
    """Write an archive that begins with a manifest, then holds these bytes."""
    path = tmp_path / "crafted.tar"
    path.write_bytes(header("manifest.json", 2) + b"{}".ljust(512, b"\0") + b"".join(pieces) + bytes(1024))
    return path


STRUCTURES: dict[str, tuple[Callable[[], bytes], str]] = {
    "sparse": (lambda: sparse_member(64 * GIB), "is no plain file"),
    "sparse in pax": (
        lambda: (
            pax("a", 512, **{"GNU.sparse.major": "1", "GNU.sparse.minor": "0", "GNU.sparse.realsize": "1" * 12})
            + bytes(512)
        ),
        "extended header",
    ),
    "long name of gigabytes": (lambda: header("././@LongLink", 8 * GIB, tarfile.GNUTYPE_LONGNAME), "no plain file"),
    "pax of gigabytes": (lambda: header("x", 8 * GIB, tarfile.XHDTYPE), "no plain file"),
    "global pax": (lambda: header("x", 20, tarfile.XGLTYPE), "no plain file"),
    "hard link": (lambda: header("store/history.sqlite", 0, tarfile.LNKTYPE, linkname="/etc/shadow"), "no plain file"),
    "link": (lambda: header("store/history.sqlite", 0, tarfile.SYMTYPE, linkname="/etc"), "no plain file"),
    "device": (lambda: header("store/history.sqlite", 0, tarfile.CHRTYPE, devmajor=1), "no plain file"),
    "pipe": (lambda: header("store/history.sqlite", 0, tarfile.FIFOTYPE), "no plain file"),
    "folder": (lambda: header("store", 0, tarfile.DIRTYPE), "no plain file"),
    "absolute": (lambda: header("/etc/cron.d/x", 0), "nothing that a back-up holds"),
    "climbing": (lambda: header("models/releases/../../../x", 0), "nothing that a back-up holds"),
    "newline": (lambda: header("store/history.sqlite\n", 0), "nothing that a back-up holds"),
    "escape": (lambda: header("\x1b[2Jstore", 0), r"\\x1b\[2Jstore is nothing"),
    "twice": (lambda: 2 * header("store/last-block", 0), "twice"),
    "more than there is": (lambda: header("store/history.sqlite", GIB), "cut off"),
    "large record": (lambda: header("commissioning/record.json", 2**21), "has at most"),
    "negative": (lambda: header("store/history.sqlite", -512), "no whole back-up|no plain file"),
}


@pytest.mark.parametrize("structure", STRUCTURES)
def test_a_crafted_structure_is_refused_by_its_first_block(tmp_path: Path, structure: str) -> None:
    make, words = STRUCTURES[structure]
    content = make()
    if structure == "large record":
        content += bytes(2**21)
    with pytest.raises(BackupError, match=words) as refused:
        read_manifest(crafted(tmp_path, content))
    assert "\x1b" not in str(refused.value)


def test_a_pipe_in_place_of_an_archive_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "pipe.tar"
    os.mkfifo(path)
    with pytest.raises(BackupError, match="no whole back-up"):
        read_manifest(path)


def test_a_sparse_archive_that_expands_to_gigabytes_is_refused_in_a_second(
    installation: Installation, tmp_path: Path
) -> None:
    files = files_of(installation.backup())
    path = crafted(tmp_path, sparse_member(64 * GIB))
    assert path.stat().st_size < 300 * 1024
    manifest = json.loads(files["manifest.json"])
    before, began_s = photograph(installation.folder), time.process_time()
    with pytest.raises(BackupError, match="no plain file"):
        restore(path, installation.config_path, person="anna", replace=True)
    assert time.process_time() - began_s < 1.0 and photograph(installation.folder) == before
    assert manifest["files"]


def test_more_than_the_disk_holds_is_refused_unread(installation: Installation, tmp_path: Path) -> None:
    """The archive itself has holes: it says a tebibyte and takes a few blocks of the disk."""
    files = files_of(installation.backup())
    size = 2**40
    manifest = json.loads(files["manifest.json"])
    manifest["files"] = [item for item in manifest["files"] if item["name"] != "store/history.sqlite"]
    manifest["files"].append({"name": "store/history.sqlite", "sha256": 64 * "0", "size_bytes": size, "came_from": "x"})
    path = packed(tmp_path / "holes.tar", {name: c for name, c in files.items() if name != "store/history.sqlite"})
    text = json.dumps(manifest).encode()
    rest = [(name, files[name]) for name in files if name not in ("manifest.json", "store/history.sqlite")]
    with path.open("wb") as file:
        for name, content in [("manifest.json", text), *rest]:
            member = tarfile.TarInfo(name)
            member.size = len(content)
            file.write(member.tobuf(tarfile.PAX_FORMAT) + content + bytes(-len(content) % 512))
        member = tarfile.TarInfo("store/history.sqlite")
        member.size = size
        file.write(member.tobuf(tarfile.PAX_FORMAT))
        file.truncate(file.tell() + size + 1024)
    if shutil.disk_usage(tmp_path).free > 2 * size:
        pytest.skip("this disk holds it")
    began_s = time.process_time()
    with pytest.raises(BackupError, match="MiB must be free"):
        restore(path, installation.config_path, person="anna", replace=True)
    assert time.process_time() - began_s < 1.0


# --- content ---------------------------------------------------------------------------------


def with_store(installation: Installation, tmp_path: Path, *statements: str) -> Path:
    """Return a back-up whose store somebody has changed."""
    files = files_of(installation.backup())
    store = tmp_path / "changed.sqlite"
    store.write_bytes(files["store/history.sqlite"])
    with closing(sqlite3.connect(store)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
    return packed(tmp_path / "changed.tar", {**files, "store/history.sqlite": store.read_bytes()})


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER t AFTER INSERT ON events BEGIN INSERT INTO state VALUES ('wanted', '{\"z\": true}', 0); END",
        "CREATE VIEW v AS SELECT * FROM state",
    ],
)
def test_a_store_that_would_arm_itself_again_is_refused(
    installation: Installation, tmp_path: Path, statement: str
) -> None:
    archive = with_store(installation, tmp_path, statement)
    before = photograph(installation.folder)
    with pytest.raises(BackupError, match=r"the store in the back-up holds a (trigger|view)"):
        restore(archive, installation.config_path, person="anna", replace=True)
    assert photograph(installation.folder) == before


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("commissioning/record.json", b"{}", "commissioning record in the back-up cannot be read"),
        ("configuration/toolpoint.yaml", b"machine: [", "is refused by this version"),
        ("configuration/toolpoint.yaml", b"\xff", "not UTF-8"),
        ("models/releases/0001/release.json", b"{}", "a release in the back-up cannot be read"),
        ("models/releases/0001/model.json", b"{}", "is not the one that"),
        ("store/history.sqlite", b"x" * 5000, "cannot be used"),
    ],
)
def test_content_that_is_not_what_it_should_be_changes_nothing(
    installation: Installation, tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    evil = packed(tmp_path / "evil.tar", {**files_of(installation.backup()), name: content})
    before = photograph(installation.folder)
    with pytest.raises(BackupError, match=words):
        restore(evil, installation.config_path, person="anna", replace=True)
    assert photograph(installation.folder) == before


def test_an_archive_that_changes_after_it_was_proved_is_refused(
    installation: Installation, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = installation.backup()
    position = archive.read_bytes().index(b"SQLite format 3") + 5000

    def proved_then_changed(_self: object) -> None:
        with archive.open("r+b") as file:
            file.seek(position)
            file.write(b"changed")

    monkeypatch.setattr("daemon.backup.archive.Archive.prove", proved_then_changed)
    before = photograph(installation.folder / "state")
    with pytest.raises(BackupError, match=r"store/history.sqlite was damaged"):
        restore(archive, installation.config_path, person="anna", replace=True)
    assert photograph(installation.folder / "state") == before


def test_the_folder_that_it_is_unpacked_into_cannot_be_exchanged(
    installation: Installation, monkeypatch: pytest.MonkeyPatch
) -> None:
    from daemon.backup import restoring

    archive, state = installation.backup(), installation.configuration.history.path.parent
    checked = restoring._check_releases

    def exchange(folder: Path, manifest: object) -> None:
        (work,) = state.glob(".toolpoint-restore-*")
        work.rename(state / "moved")
        shutil.copytree(state / "moved", work)
        (work / "store/history.sqlite").write_bytes(b"theirs")
        checked(folder, manifest)  # type: ignore[arg-type]

    monkeypatch.setattr(restoring, "_check_releases", exchange)
    restore(archive, installation.config_path, person="anna", replace=True)
    assert not installation.configuration.history.path.read_bytes().startswith(b"theirs")
    assert os.listdir(state)  # noqa: PTH208
