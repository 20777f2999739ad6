"""A pipe, a device or a huge file in place of what the configuration names: refused at once, and nothing hangs."""

import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from config.files import LARGEST_FILE, read_whole
from config.records.commissioning import load_commissioning
from config.records.release_record import load_release_record
from config.secret_files import read_secret
from config.signing import TrustedKeys, signature_of
from config.signing_key import SigningKey
from daemon.model_release.loading import read_model
from daemon.monitor.accounts import read_accounts
from daemon.monitor.web.server import Certificate
from daemon.sinks.vouching import tls_context
from drivers.displacement.tail import FileTail
from drivers.opcua.certificates import load_certificate

READERS: dict[str, Callable[[Path], object]] = {
    "commissioning record": load_commissioning,
    "release record": load_release_record,
    "model": lambda path: read_model(path, [1], ["Z1"])[1],
    "secret": lambda path: read_secret("password_file", path),
    "accounts": read_accounts,
    "keys that count": lambda path: TrustedKeys.read(path.parent),
    "signature": lambda path: signature_of(path.with_suffix("")),
    "private key": SigningKey.load,
    "certificate of the monitor": lambda path: Certificate(path, path),
    "certificate of a broker": tls_context,
    "certificate of the CNC": load_certificate,
    "file of a logger": lambda path: FileTail(path, 1000).look(),
}
ENDS = {"keys that count": "anna.pub", "signature": "record.sig"}


def ending(read: Callable[[Path], object], path: Path) -> str:
    """Return how a reader refuses a file; fails when it does not end."""
    told: list[str] = []

    def work() -> None:
        try:
            told.append(str(read(path)))
        except Exception as error:
            told.append(str(error))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(20.0)
    assert told, "it waits for what will never come"
    return told[0]


@pytest.mark.parametrize("what", READERS)
def test_a_pipe_in_place_of_a_file_is_refused_at_once(tmp_path: Path, what: str) -> None:
    path = tmp_path / ENDS.get(what, "pipe")
    os.mkfifo(path, 0o600)
    assert ending(READERS[what], path)


@pytest.mark.parametrize("what", ["commissioning record", "release record", "model", "secret", "accounts"])
def test_a_file_of_gigabytes_is_refused_by_its_length(tmp_path: Path, what: str) -> None:
    path = tmp_path / "huge"
    with path.open("wb") as file:
        file.truncate(LARGEST_FILE + 1)
    path.chmod(0o600)
    assert "longer than" in ending(READERS[what], path)


@pytest.mark.parametrize("what", ["secret", "accounts", "private key", "certificate of the monitor"])
def test_a_secret_that_every_user_may_read_is_refused_with_the_command_that_closes_it(
    tmp_path: Path, what: str
) -> None:
    path = tmp_path / "secret"
    path.write_text("quite secret 7\n")
    path.chmod(0o644)
    said = ending(READERS[what], path)
    assert "(mode 644); run: chmod" in said and str(path) in said
    path.chmod(0o640)  # as systemd gives a service its credentials
    assert "chmod" not in ending(READERS[what], path)


def test_a_device_in_place_of_a_file_is_refused() -> None:
    with pytest.raises(OSError, match="it is a pipe or a device"):
        read_whole(Path("/dev/zero"))


def test_a_folder_or_a_link_to_nothing_is_refused_in_the_words_of_the_system(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nothing")
    with pytest.raises(IsADirectoryError):
        read_whole(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_whole(tmp_path / "link")
