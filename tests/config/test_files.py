"""Files are written whole or not at all."""

import os
from pathlib import Path

import pytest

from config.files import sha256_of, stamp_of, write_whole

EMPTY = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_a_file_is_put_in_the_place_of_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_whole(path, "old")
    write_whole(path, b"\x00new", 0o640)
    assert path.read_bytes() == b"\x00new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [path], "nothing is left beside it"


def test_a_pipe_or_a_device_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reading = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    write_whole(path, "to whoever reads")
    assert os.read(reading, 100) == b"to whoever reads" and path.is_fifo()
    os.close(reading)


def test_the_old_file_stands_where_the_new_one_cannot_be_written(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_whole(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(path, "\ud800")
    assert path.read_text() == "old"
    folder = tmp_path / "folder"
    (folder / "inside").mkdir(parents=True)
    with pytest.raises(OSError, match="directory"):
        write_whole(folder, "a folder is in the way")
    assert sorted(tmp_path.iterdir()) == [path, folder], "nothing is left beside it"
    with pytest.raises(OSError, match="No such file"):
        write_whole(tmp_path / "nowhere" / "file", "x")


def test_a_link_in_the_place_of_the_temporary_file_is_not_followed(tmp_path: Path) -> None:
    """Whoever owns the folder knows its name, and root writes there too."""
    (tmp_path / "of_root").write_text("left as it is")
    (tmp_path / f".file.{os.getpid()}.tmp").symlink_to(tmp_path / "of_root")
    write_whole(tmp_path / "file", "new")
    assert (tmp_path / "of_root").read_text() == "left as it is"
    assert (tmp_path / "file").read_text() == "new" and not (tmp_path / "file").is_symlink()


def test_nobody_else_can_open_a_private_file_before_it_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    fchmod = os.fchmod

    def looked_at(descriptor: int, mode: int) -> None:
        seen.append(os.fstat(descriptor).st_mode & 0o777)
        fchmod(descriptor, mode)

    monkeypatch.setattr(os, "fchmod", looked_at)
    mask = os.umask(0)
    try:
        write_whole(tmp_path / "key", "secret", 0o600)
    finally:
        os.umask(mask)
    assert seen == [0o600]


def test_the_digest_of_nothing_is_the_published_one() -> None:
    assert sha256_of(b"") == EMPTY


def test_a_stamp_tells_that_a_file_was_replaced_by_one_of_the_same_size_and_time(tmp_path: Path) -> None:
    key, certificate, new = tmp_path / "key", tmp_path / "certificate", tmp_path / "new"
    for each in (key, certificate, new):
        each.write_text("12345")
        os.utime(each, (1e9, 1e9))
    before = stamp_of(certificate, key)
    assert before == stamp_of(certificate, key)
    new.replace(certificate)
    assert stamp_of(certificate, key) not in ((), before)
    key.unlink()
    assert stamp_of(certificate, key) == ()
