"""Who answers for a release, a commissioning record, a back-up: the daemon and restore check it."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from installation import Installation
from other_user import OTHER, as_root, as_user
from small_model import model

from config.loader import load_configuration
from config.records.commissioning import CommissioningError, load_commissioning
from config.records.commissioning_file import save_commissioning
from config.signing import SigningError, TrustedKeys, signature_beside
from config.signing_key import SigningKey
from daemon.app import load_record
from daemon.backup.manifest import BackupError
from daemon.backup.restoring import read_manifest, restore
from daemon.cli import main
from daemon.model_release.active import proposals_folder
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import LoadedModel, load_released
from daemon.model_release.releasing import rollback
from daemon.model_release.repository import ReleaseError
from models.thermal.family import ThermalModel


class Signing:
    """An installation, and people with homes of their own."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.installation = Installation(folder / "here")
        self.installation.fill()
        self._folder, self._monkeypatch = folder, monkeypatch
        self.be("nobody")

    def be(self, person: str) -> None:
        self._monkeypatch.setenv("TOOLPOINT_SIGNING_KEY", str(self._folder / person / "key.pem"))

    def run(self, *words: str) -> Result:
        return CliRunner().invoke(main, [*words, "--config", str(self.installation.config_path)])

    def key(self, person: str, name: str | None = None) -> None:
        self.be(person)
        made = self.run("keys", "make", name or person)
        assert made.exit_code == 0, made.output

    @property
    def loaded(self) -> LoadedModel[ThermalModel]:
        return load_released(self.installation.configuration, own_account())

    @property
    def record_path(self) -> Path:
        path = self.installation.configuration.compensation.commissioning_file
        assert path is not None
        return path

    @property
    def release_path(self) -> Path:
        model_file = self.installation.configuration.compensation.model_file
        assert model_file is not None
        return Path(os.path.realpath(model_file)).with_name("release.json")


@pytest.fixture
def signing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Signing:
    return Signing(tmp_path, monkeypatch)


def test_without_keys_nothing_is_asked_for_and_it_says_so(signing: Signing) -> None:
    signing.installation.release("ridge-1")
    assert signing.loaded.model is not None and "its signature not asked for" in signing.loaded.in_words()
    assert load_record(signing.installation.configuration)[0] is not None
    assert "no key counts" in signing.run("keys", "list").output


def test_a_release_is_signed_by_whoever_makes_it_and_by_nobody_else(signing: Signing) -> None:
    signing.key("anna")
    signing.installation.release("ridge-1", "ridge-2")
    assert signing.loaded.signed_by == "anna"
    signing.be("mallory")
    with pytest.raises(ReleaseError, match="has no key to sign with"):
        rollback(signing.installation.configuration, person="mallory")
    SigningKey.make(Path(os.environ["TOOLPOINT_SIGNING_KEY"]))
    with pytest.raises(ReleaseError, match="does not count here"):
        rollback(signing.installation.configuration, person="mallory")
    signing.be("anna")
    rollback(signing.installation.configuration, person="anna")
    assert signing.loaded.record is not None and signing.loaded.record.number == 3


@as_root
def test_who_may_not_write_the_folder_gets_the_public_key_and_what_root_must_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    signing, home = Signing(folder, monkeypatch), folder / "ben"
    home.mkdir()
    os.chown(home, OTHER, OTHER)
    signing.be("ben")
    said = as_user(OTHER, lambda: signing.run("keys", "make", "ben").output)
    trusted = signing.installation.configuration.signatures.public_keys
    command = f"sudo install -D --mode=0644 {home / 'ben.pub'} {trusted / 'ben.pub'}"
    assert f"it counts once root has put it into {trusted}: {command}" in said
    assert not (trusted / "ben.pub").exists()
    subprocess.run(command.removeprefix("sudo ").split(), check=True)
    assert signing.run("keys", "list").output.split()[1] == "ben"


@pytest.mark.parametrize("change", ["record", "signature", "another's", "other release", "garbage", "missing"])
def test_a_release_that_nobody_who_counts_has_signed_is_refused(signing: Signing, change: str, tmp_path: Path) -> None:
    signing.key("anna")
    signing.installation.release("ridge-1", "ridge-2")
    path = signing.release_path
    signature = signature_beside(path)
    if change == "record":
        path.write_text(path.read_text(encoding="utf-8").replace('"person": "anna"', '"person": "otto"'), "utf-8")
    elif change == "signature":
        told = json.loads(signature.read_bytes())
        told["signature"] = "A" + told["signature"][1:] if told["signature"][0] != "A" else "B" + told["signature"][1:]
        signature.write_text(json.dumps(told), encoding="utf-8")
    elif change == "another's":
        key = SigningKey.make(tmp_path / "mallory.pem")
        signature.write_bytes(key.signature("release record", path.read_bytes()))
    elif change == "other release":
        shutil.copyfile(signature_beside(path.parents[1] / "0001/release.json"), signature)
    elif change == "garbage":
        signature.write_bytes(b"[" * 100_000)
    else:
        signature.unlink()
    assert signing.loaded.model is None
    assert any(words in signing.loaded.inhibit for words in ("signed", "signature")), signing.loaded.inhibit


def test_a_signature_for_one_purpose_is_none_for_another(signing: Signing, tmp_path: Path) -> None:
    signing.key("anna")
    key = SigningKey.load(tmp_path / "anna/key.pem")
    trusted = TrustedKeys.read(signing.installation.configuration.signatures.public_keys)
    assert trusted.signer("back-up", b"x", key.signature("back-up", b"x"), "it") == "anna"
    with pytest.raises(SigningError, match="or the signature is of something else"):
        trusted.signer("release record", b"x", key.signature("back-up", b"x"), "it")


def test_a_key_that_is_limited_counts_for_nothing_else(signing: Signing) -> None:
    signing.key("night", "night.release")
    signing.installation.release("ridge-1")
    assert signing.loaded.signed_by == "night"
    assert load_record(signing.installation.configuration)[0] is not None, "no key counts for commissioning yet"
    signing.key("anna", "anna.commissioning")
    record = load_commissioning(signing.record_path)
    save_commissioning(record, signing.record_path, SigningKey.load(Path(os.environ["TOOLPOINT_SIGNING_KEY"])))
    assert load_record(signing.installation.configuration)[0] is not None
    signing.be("night")
    save_commissioning(record, signing.record_path, SigningKey.load(Path(os.environ["TOOLPOINT_SIGNING_KEY"])))
    with pytest.raises(CommissioningError, match="does not hold for a commissioning record"):
        load_commissioning(signing.record_path, signing.installation.configuration.signatures.public_keys)
    save_commissioning(record, signing.record_path)
    assert not signature_beside(signing.record_path).exists()
    assert load_record(signing.installation.configuration)[0] is None


def test_a_changed_commissioning_record_is_none(signing: Signing) -> None:
    signing.key("anna")
    assert signing.run("keys", "sign", "--yes").exit_code == 0
    assert load_record(signing.installation.configuration)[0] is not None
    text = signing.record_path.read_text(encoding="utf-8")
    signing.record_path.write_text(text.replace('"sign": 1', '"sign": -1') + "\n", encoding="utf-8")
    assert load_record(signing.installation.configuration)[0] is None


# --- back-ups --------------------------------------------------------------------------------


def test_a_backup_is_signed_and_brings_the_signatures_along(signing: Signing) -> None:
    signing.key("anna")
    signing.installation.release("ridge-1")
    assert signing.run("keys", "sign", "--yes").exit_code == 0
    archive = signing.installation.backup()
    names = [file.name for file in read_manifest(archive).files]
    assert "commissioning/record.json.sig" in names and "models/releases/0001/release.json.sig" in names
    for path in (signature_beside(signing.record_path), signature_beside(signing.release_path)):
        path.unlink()
    restore(archive, signing.installation.config_path, person="anna", replace=True)
    assert signing.loaded.signed_by == "anna"
    assert load_record(load_configuration(signing.installation.config_path)) is not None


def test_a_backup_that_nobody_who_counts_has_signed_needs_a_persons_word(signing: Signing, tmp_path: Path) -> None:
    unsigned = signing.installation.backup()
    signing.key("anna")
    with pytest.raises(BackupError, match=r"is not signed.*--accept-unsigned"):
        restore(unsigned, signing.installation.config_path, person="anna", replace=True)
    refused = signing.run("restore", str(unsigned), "--replace")
    assert refused.exit_code == 1 and "--accept-unsigned" in refused.output
    assert signing.run("restore", str(unsigned), "--replace", "--accept-unsigned").exit_code == 0
    signing.be("mallory")
    assert any("a signature:" in words for words in read_manifest(signing.installation.backup("b.tar")).left_out)


def test_a_backup_whose_manifest_was_made_anew_is_refused(signing: Signing) -> None:
    signing.key("anna")
    archive = signing.installation.backup()
    content = archive.read_bytes()
    archive.write_bytes(content.replace(b'"machine": "Mill 7 (hall)"', b'"machine": "Mill 8 (hall)"', 1))
    assert archive.read_bytes() != content
    with pytest.raises(BackupError, match="is not what anna has signed"):
        restore(archive, signing.installation.config_path, person="anna", replace=True)


# --- keys ------------------------------------------------------------------------------------


def test_what_is_no_key_among_those_that_count_refuses_everything(signing: Signing) -> None:
    signing.installation.release("ridge-1")
    folder = signing.installation.configuration.signatures.public_keys
    folder.mkdir()
    (folder / "broken.pub").write_text("no key", encoding="utf-8")
    assert signing.loaded.model is None and "no public key" in signing.loaded.inhibit
    assert load_record(signing.installation.configuration)[0] is None


@pytest.mark.parametrize("there", ["a link to what is not there", "a folder"])
def test_a_key_that_cannot_be_read_refuses_everything_and_is_named(signing: Signing, there: str) -> None:
    """A link to a stick that was pulled: nothing had to be signed any more."""
    signing.installation.release("ridge-1")
    folder = signing.installation.configuration.signatures.public_keys
    folder.mkdir()
    if there == "a folder":
        (folder / "anna.pub").mkdir()
    else:
        (folder / "anna.pub").symlink_to(folder / "stick/anna.pub")
    assert signing.loaded.model is None and f"{folder / 'anna.pub'}: this key" in signing.loaded.inhibit
    assert load_record(signing.installation.configuration)[0] is None


def test_the_list_says_which_proposals_wait_and_which_are_released(signing: Signing) -> None:
    signing.installation.release("ridge-1")
    configuration = signing.installation.configuration
    assert configuration.compensation.model_file is not None
    waiting = proposals_folder(configuration) / "2.json"
    waiting.parent.mkdir(exist_ok=True)
    shutil.copyfile(os.path.realpath(configuration.compensation.model_file), waiting)
    (waiting.parent / "3.json").write_text(model("ridge-3").to_json(), encoding="utf-8")
    listed = signing.run("model", "list").output
    assert f"is release 1  {waiting}: ridge-1" in listed and f"waits  {waiting.parent / '3.json'}: ridge-3" in listed
