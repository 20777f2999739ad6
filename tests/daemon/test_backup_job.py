"""Back-ups that the daemon makes by itself, and those of the command line."""

import json
import os
import time
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from installation import Installation

from config.loader import load_configuration
from config.schema.service import BackupConfig
from daemon.app import Daemon
from daemon.backup.names import existing_backups
from daemon.backup.restoring import read_manifest
from daemon.cli import main
from daemon.history import HistoryReader
from daemon.housekeeping.jobs import BackupJob
from drivers.clock import SystemClock

EVER = (0.0, 1e11)


@pytest.fixture
def installation(tmp_path: Path) -> Installation:
    made = Installation(tmp_path / "here")
    made.fill()
    return made


async def test_the_daemon_makes_one_when_the_newest_is_too_old(installation):
    folder, said = installation.folder / "backups", []
    config = BackupConfig(directory=folder, every_hours=1.0, keep=2)
    job = BackupJob(installation.configuration, installation.config_path, config, lambda *words: said.append(words))
    assert job.due(time.time())
    folder.mkdir()
    await job.run_if_due()
    (made,) = existing_backups(folder, "Mill 7 (hall)")
    read_manifest(made)
    assert said[0][0] == "backup" and str(made) in said[0][1] and "MiB" in said[0][1]
    await job.run_if_due()
    assert len(said) == 1, "the newest is young"
    now_s = made.stat().st_mtime
    (folder / "toolpoint-mill-7-hall-20990101T000000Z.tar").touch()
    os.utime(folder / "toolpoint-mill-7-hall-20990101T000000Z.tar", (4e9, 4e9))
    assert job.due(now_s + 3601.0) and job.due(now_s - 5.0) and not job.due(now_s + 3599.0)


async def test_a_backup_that_fails_is_said_once(installation):
    said: list[tuple[str, str]] = []
    config = BackupConfig(directory=installation.folder / "etc/toolpoint.yaml/no", every_hours=1.0)
    job = BackupJob(installation.configuration, installation.config_path, config, lambda *words: said.append(words))
    for _ in range(2):
        await job.run_if_due()
    ((kind, text),) = said
    assert kind == "backup" and "failed" in text


async def test_the_daemon_that_is_told_to_makes_them_and_says_so(installation):
    text = installation.config_path.read_text(encoding="utf-8")
    path_line = "history:\n"
    assert path_line in text
    more = f"{path_line}  backup:\n    directory: {installation.folder / 'backups'}\n"
    installation.config_path.write_text(text.replace(path_line, more), encoding="utf-8")
    daemon = Daemon(load_configuration(installation.config_path), SystemClock(), config_path=installation.config_path)
    daemon._history.start()
    (job,) = daemon._jobs
    await job.run_if_due()
    await daemon._history.flushed()
    daemon._history.close()
    (made,) = existing_backups(installation.folder / "backups", "Mill 7 (hall)")
    with HistoryReader(installation.configuration.history.path) as reader:
        said = reader.events(*EVER)[-1]
    assert (said.kind, said.person) == ("backup", "daemon") and str(made) in said.text


def test_the_commands(installation):
    def toolpoint(*words: str) -> Result:
        return CliRunner().invoke(main, words)

    config = ("--config", str(installation.config_path))
    nowhere = toolpoint("backup", *config)
    assert nowhere.exit_code == 2 and "history.backup.directory" in nowhere.output
    made = toolpoint("backup", str(installation.folder / "b.tar"), *config, "--json", str(installation.folder / "j"))
    said = json.loads((installation.folder / "j").read_text(encoding="utf-8"))
    assert made.exit_code == 0 and said["manifest"]["machine"] == "Mill 7 (hall)"
    proved = toolpoint("restore", str(installation.folder / "b.tar"), "--verify", *config)
    assert proved.exit_code == 0 and "whole" in proved.output
    refused = toolpoint("restore", str(installation.folder / "b.tar"), *config)
    assert refused.exit_code == 1 and "--replace" in refused.output
    done = toolpoint("restore", str(installation.folder / "b.tar"), "--replace", *config)
    assert done.exit_code == 0 and "acknowledge" in done.output
