"""What happens to the store: power cuts of every kind, a full disk, a disk that cannot be written, damaged pages."""

import contextlib
import os
import random
import shutil
import struct
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from account import Row, Unavailable
from rig import PATIENCE_S, STATES, Rig, need_small_disk

FRAME_HEADER, LOG_HEADER, BLOCK = 24, 32, 4096
MOST_TRIES = 20
AT_REST = ("OFF", "RETREAT", "HOLD")
"""Nothing is followed; what is still applied at a start is held until a person decides."""
MOST_LOG_BYTES = 100_000


@dataclass(frozen=True, slots=True)
class Log:
    """The write-ahead log of the store as its index tells."""

    salt: bytes
    frames: int
    """Frames that belong to commits."""
    copied: int
    """Frames that have been copied into the store's file."""
    page_size: int

    @property
    def end(self) -> int:
        """Length of these frames in the file [byte]."""
        return LOG_HEADER + self.frames * (FRAME_HEADER + self.page_size)


def read_log(store: Path) -> Log:
    """Read header and index of the log; https://sqlite.org/walformat.html."""
    header = Path(f"{store}-wal").read_bytes()[:LOG_HEADER]
    index = Path(f"{store}-shm").read_bytes()[:136]
    (frames,) = struct.unpack_from("=I", index, 16)
    (copied,) = struct.unpack_from("=I", index, 96)
    return Log(salt=header[16:24], frames=frames, copied=copied, page_size=struct.unpack_from(">I", header, 8)[0])


def power_cuts(rig: Rig, row: Row, count: int, moments: random.Random, cut: Callable[..., None]) -> None:
    """End the daemon in a commit, and leave on the disk what a power cut may leave.

    What was synced stands: the frames that the log's index counted when the daemon was asked what it had acknowledged.
    The commit after them was under way: its frames are torn, lost in parts, damaged or not there. The file of the last
    block is never synced: it is as it was some time ago, as it is, or gone. The index is gone in any case.
    """
    for _ in row.rounds(count):
        rig.ensure_following()
        offset, after = rig.log_path.stat().st_size, rig.last_write()
        last_block = rig.store.with_name(f"{rig.store.name}.last-block")
        for _ in range(MOST_TRIES):
            rig.ensure_following()
            block_before = last_block.read_bytes()
            time.sleep(moments.uniform(0.5, 2.0))
            said = rig.status()["history"]["acknowledged"]
            synced = now = read_log(rig.store)
            while now.frames == synced.frames:
                time.sleep(0.001)
                now = read_log(rig.store)
            rig.kill()
            left = read_log(rig.store)
            if left.salt == synced.salt and left.copied <= synced.frames:
                break
        else:
            raise Unavailable("the log was written back at every moment that was tried")
        row.runs += 1
        cut(Path(f"{rig.store}-wal"), synced.end, left.end, moments)
        Path(f"{rig.store}-shm").unlink(missing_ok=True)
        match moments.choice(("old", "new", "absent")):
            case "old":
                last_block.write_bytes(block_before)
            case "absent":
                last_block.unlink()
        rig.check_store(row, said)
        row.start_s.append(rig.start())
        rig.back(row, time.monotonic())
        rig.check_log(row, offset)
        rig.check_writes(row, after, unverified=2)


def torn(log: Path, synced: int, end: int, moments: random.Random) -> None:
    """The tail ends in the middle of a page."""
    os.truncate(log, moments.randrange(synced, end))


def lost(log: Path, synced: int, end: int, moments: random.Random) -> None:
    """Some blocks of the tail never reached the disk."""
    os.truncate(log, end)
    with log.open("r+b") as file:
        for at in range(synced, end, BLOCK):
            if moments.random() < 0.5:
                file.seek(at)
                file.write(bytes(min(BLOCK, end - at)))


def flipped(log: Path, synced: int, end: int, moments: random.Random) -> None:
    """Bits of the tail are wrong."""
    os.truncate(log, end)
    with log.open("r+b") as file:
        for _ in range(5):
            _flip(file, moments.randrange(synced, end), moments)


def unsynced(log: Path, synced: int, end: int, moments: random.Random) -> None:
    """All that was not synced is gone."""
    os.truncate(log, synced)


def _flip(file: BinaryIO, at: int, moments: random.Random) -> None:
    file.seek(at)
    byte = file.read(1)[0]
    file.seek(at)
    file.write(bytes([byte ^ 1 << moments.randrange(8)]))


def damaged_pages(rig: Rig, row: Row, count: int, moments: random.Random) -> None:
    """Flip bits in pages of the store's own file, as a worn disk does.

    Who cannot start says why; who starts on a wrong audit finds values that are not its own, and that is a FAULT.
    """
    rig.ensure_following()
    for _ in row.rounds(count):
        rig.running.daemon.terminate()
        rig.running.daemon.wait()
        whole = rig.directory / "whole"
        shutil.copytree(rig.store.parent, whole)
        offset = rig.log_path.stat().st_size
        row.runs += 1
        with rig.store.open("r+b") as file:
            page = moments.randrange(rig.store.stat().st_size // BLOCK)
            for _ in range(8):
                _flip(file, page * BLOCK + moments.randrange(BLOCK), moments)
        try:
            rig.start()
        except AssertionError:
            said = rig.tail()
            row.check(
                "who cannot start names the store and says what to do", str(rig.store) in said, f"page {page}: {said}"
            )
            row.notes["refused at the start"] = row.notes.get("refused at the start", 0) + 1
        else:
            time.sleep(2.0)
            row.check("it lives", rig.running.daemon.poll() is None, f"page {page}: {rig.tail()}")
        if rig.running.daemon.poll() is None:
            state = rig.status()["output"]["state"]
            row.notes[f"then {state}"] = row.notes.get(f"then {state}", 0) + 1
            rig.kill()
        rig.check_log(row, offset, fault=True)
        for path in rig.store.parent.iterdir():
            path.unlink()
        shutil.copytree(whole, rig.store.parent, dirs_exist_ok=True)
        shutil.rmtree(whole)
        # The store is older than the CNC now, as after a restored back-up: a person compares and acknowledges.
        rig.start()
        rig.wait("the CNC", lambda status: status["output"]["since_s"] is not None, PATIENCE_S)
        if fault := rig.status()["output"]["fault"]:
            rig.running.client.ask("acknowledge", fault=fault)
        rig.ensure_following()


def full_disk(rig: Rig, row: Row, count: int) -> None:
    """Fill the disk under the store, and free it again."""
    folder = need_small_disk(rig)
    for _ in row.rounds(count):
        rig.ensure_following()
        offset, after = rig.log_path.stat().st_size, rig.last_write()
        row.runs += 1
        ballast = folder / "ballast"
        _fill(ballast)
        try:
            said = rig.wait("the notice", lambda status: status["history"]["problem"] != "", PATIENCE_S)
            row.check("it says that the disk is full", "full" in said["history"]["problem"], said["history"]["problem"])
            end_s = time.monotonic() + 5.0
            while time.monotonic() < end_s:
                state = rig.status()["output"]["state"]
                row.check("no OFF, no FAULT", state in STATES, state)
                time.sleep(0.2)
        finally:
            ballast.unlink()
        freed_s = time.monotonic()
        rig.wait("the store", lambda status: status["history"]["problem"] == "", PATIENCE_S)
        rig.back(row, freed_s)
        size = rig.check_log(row, offset)
        row.check("the log stays below 100 kB", size < MOST_LOG_BYTES, size)
        rig.check_writes(row, after, unverified=1)
        rig.check_store(row, rig.acknowledged)


def switched_off_on_full_disk(rig: Rig, row: Row, count: int) -> None:
    """Switch off on a full disk, kill the daemon, and start it there: the store holds that everything is on."""
    folder = need_small_disk(rig)
    for _ in row.rounds(count):
        rig.ensure_following()
        offset, after, ballast = rig.log_path.stat().st_size, rig.last_write(), folder / "ballast"
        row.runs += 1
        _fill(ballast)
        try:
            rig.wait("the notice", lambda status: status["history"]["problem"] != "", PATIENCE_S)
            rig.running.client.ask("disable")
            rig.wait("the retreat", lambda status: status["output"]["state"] in AT_REST, PATIENCE_S)
            time.sleep(2.0)
            said = rig.status()["history"]["acknowledged"]
            rig.kill()
            os.truncate(ballast, 0)  # for the index of the one who looks
            rig.check_store(row, said)
            _fill(ballast)
            row.start_s.append(rig.start())
            _stays_off(rig, row)
        finally:
            ballast.unlink()
        rig.wait("the store", lambda status: status["history"]["problem"] == "", PATIENCE_S)
        _stays_off(rig, row)
        rig.ensure_following()
        rig.check_log(row, offset)
        rig.check_writes(row, after, unverified=2)


def _stays_off(rig: Rig, row: Row) -> None:
    rig.wait("the CNC", lambda status: status["output"]["since_s"] is not None, PATIENCE_S)
    end_s = time.monotonic() + 3.0
    while time.monotonic() < end_s:
        output = rig.status()["output"]
        row.check("what was switched off is not followed", output["state"] in AT_REST, output)
        time.sleep(0.2)


def _fill(ballast: Path) -> None:
    with ballast.open("wb", buffering=0) as file:
        for size in (1 << 20, 4096, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))
    assert shutil.disk_usage(ballast.parent).free == 0, "the disk could not be filled"


def read_only_disk(rig: Rig, row: Row, count: int) -> None:
    """Start the daemon on a disk that cannot be written, and make it writable again."""
    folder = need_small_disk(rig)
    for _ in row.rounds(count):
        rig.ensure_following()
        after = rig.last_write()
        said = rig.status()["history"]["acknowledged"]
        rig.kill()
        offset = rig.log_path.stat().st_size
        row.runs += 1
        _remount(folder, "ro")
        try:
            rig.spawn()
            status = rig.running.daemon.wait(PATIENCE_S)
            row.check("it does not start without its store", status > 0, status)
            row.check(
                "it names the file and why", f"{rig.store}" in rig.tail() and "Read-only" in rig.tail(), rig.tail()
            )
            rig.check_log(row, offset)
        finally:
            if rig.running.daemon.poll() is None:
                rig.kill()
            _remount(folder, "rw")
        rig.check_store(row, said)
        row.start_s.append(rig.start())
        rig.back(row, time.monotonic())
        rig.check_log(row, offset)
        rig.check_writes(row, after, unverified=1)


def _remount(folder: Path, how: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{how}", str(folder)], check=True, capture_output=True)
