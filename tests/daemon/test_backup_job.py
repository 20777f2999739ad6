"""Back-ups that the daemon makes by itself, and those of the command line."""

import asyncio
import json
import os
import signal
import threading
import time
from datetime import datetime

import psutil
from click.testing import CliRunner, Result

from config.loader import load_configuration
from config.schema.service import BackupConfig
from daemon.app import Daemon
from daemon.backup.names import existing_backups
from daemon.backup.restoring import read_manifest
from daemon.cli import main
from daemon.history.reader import HistoryReader
from daemon.housekeeping import jobs
from daemon.housekeeping.jobs import BackupJob
from drivers.clock import SystemClock

EVER = (0.0, 1e11)


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
    now_s = datetime.strptime(made.stem[-16:], "%Y%m%dT%H%M%S%z").timestamp()
    (folder / "toolpoint-mill-7-hall-20990101T000000Z.tar").touch()
    os.utime(folder / "toolpoint-mill-7-hall-20990101T000000Z.tar", (4e9, 4e9))
    for server_s in (0.0, 7200.0, -7200.0):  # what the clock of a share says of its files does not count
        os.utime(made, (now_s + server_s, now_s + server_s))
        assert job.due(now_s + 3601.0) and job.due(now_s - 5.0) and not job.due(now_s + 3599.0)


class SilentShare(BackupJob):
    """A back-up job whose folder does not answer until it is let go."""

    def __init__(self, *given):
        super().__init__(*given)
        self.answers, self.looks = threading.Event(), 0

    def due(self, now_utc_s):
        self.looks += 1
        self.answers.wait(60.0)
        return super().due(now_utc_s)


async def test_a_share_that_does_not_answer_stops_neither_the_loop_nor_later_backups(installation, monkeypatch):
    monkeypatch.setattr(jobs, "LOOK_WITHIN_S", 0.3)
    said: list[tuple[str, str]] = []
    config = BackupConfig(directory=installation.folder / "backups", every_hours=1.0)
    job = SilentShare(installation.configuration, installation.config_path, config, lambda *words: said.append(words))
    looking, longest_s, last_s = asyncio.create_task(job.run_if_due()), 0.0, time.monotonic()
    while not looking.done():
        await asyncio.sleep(0.01)
        longest_s, last_s = max(longest_s, time.monotonic() - last_s), time.monotonic()
    assert longest_s < 0.2
    await job.run_if_due()
    assert job.looks == 1, "one look waits at a time"
    ((kind, text),) = said
    assert kind == "backup" and "has not answered for 0.3 s" in text and text == job.snapshot().problem
    job.answers.set()
    await asyncio.sleep(0.1)
    monkeypatch.setattr(jobs, "LOOK_WITHIN_S", 30.0)
    await job.run_if_due()
    assert job.snapshot().problem == "" and len(existing_backups(config.directory, "Mill 7 (hall)")) == 1


async def test_a_run_that_does_not_end_is_ended_said_and_tried_again(installation, monkeypatch):
    said: list[tuple[str, str]] = []
    config = BackupConfig(directory=installation.folder / "backups", every_hours=1.0)
    waits = installation.config_path.with_name("waits.yaml")
    os.mkfifo(waits)  # the command waits until somebody writes its configuration
    job = BackupJob(installation.configuration, waits, config, lambda *words: said.append(words))
    monkeypatch.setattr(jobs, "RUN_WITHIN_S", 1.0)
    begun_s = time.monotonic()
    async with asyncio.timeout(30.0):
        await job.run_if_due()
    ended, took_s = job._process, time.monotonic() - begun_s
    assert ended.returncode == -signal.SIGTERM, "what it had begun it can remove: a back-up has twice the store's size"
    assert not [child for child in psutil.Process().children() if str(waits) in " ".join(child.cmdline())]
    ((kind, text),) = said
    assert kind == "backup" and "it was ended because it took longer than" in text and text == job.snapshot().problem
    waits.unlink()
    waits.write_bytes(installation.config_path.read_bytes())
    monkeypatch.setattr(jobs, "RUN_WITHIN_S", 60.0)
    await job.run_if_due()
    assert job._process is ended, "a share that is too slow is not written to all day"
    await asyncio.sleep(took_s)
    await job.run_if_due()
    assert job.snapshot().problem == "" and len(existing_backups(config.directory, "Mill 7 (hall)")) == 1


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


def test_the_commands(installation, monkeypatch):
    def toolpoint(*words: str) -> Result:
        return CliRunner().invoke(main, words)

    config = ("--config", str(installation.config_path))
    nowhere = toolpoint("backup", *config)
    assert nowhere.exit_code == 2 and "history.backup.directory" in nowhere.output
    away = toolpoint("backup", str(installation.folder / "stick"), *config)
    assert away.exit_code == 1 and f"{installation.folder / 'stick'}: there is no such folder; mount it" in away.output
    assert not (installation.folder / "stick").exists()
    share = installation.folder / "share"  # not mounted: the disk of the system would fill, hidden by the next mount
    for words in ((str(share / "mill"), "--keep", "2"), (str(share / "mill/b.tar"),)):
        away = toolpoint("backup", *words, *config)
        assert away.exit_code == 1 and f"{share}: there is no such folder; mount it or make it" in away.output
    share.mkdir()
    monkeypatch.setattr("daemon.backup.making.MOUNT_TABLE", installation.folder / "fstab")
    (installation.folder / "fstab").write_text(f"# shares\n//nas/b  {share}\tcifs ro 0 0\n", encoding="utf-8")
    for words in ((str(share / "mill"), "--keep", "2"), (str(share), "--keep", "2"), (str(share / "b.tar"),)):
        away = toolpoint("backup", *words, *config)
        assert away.exit_code == 1 and f"{share}: is not mounted, and" in away.output
    assert not list(share.iterdir())
    made = toolpoint("backup", str(installation.folder / "b.tar"), *config, "--json", str(installation.folder / "j"))
    said = json.loads((installation.folder / "j").read_text(encoding="utf-8"))
    assert made.exit_code == 0 and said["manifest"]["machine"] == "Mill 7 (hall)"
    proved = toolpoint("restore", str(installation.folder / "b.tar"), "--verify", *config)
    assert proved.exit_code == 0 and "whole" in proved.output
    refused = toolpoint("restore", str(installation.folder / "b.tar"), *config)
    assert refused.exit_code == 1 and "--replace" in refused.output
    done = toolpoint("restore", str(installation.folder / "b.tar"), "--replace", *config)
    assert done.exit_code == 0 and "acknowledge" in done.output
