"""A power cut between write and disk: what the two records may then say, and what the CNC may hold."""

import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import pytest
from control_rig import BLOCK, SEQUENCE_A, SEQUENCE_B, Bench, running
from speed_machine import MACROS, speed_machine

from daemon.cnc.macro_block import begun_after
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.history.reader import HistoryReader
from daemon.spindle_speed.macro_block import OperationKey, SpeedBlock, SpeedPair
from daemon.spindle_speed.writer import SpeedWriter

LAST_BLOCK = "history.sqlite.last-block"
AUDIT_FROM = {"old": "old", "intent": "new", "new": "new"}
"""What the disk has of the audit: nothing of the newest write, its intent, its outcome as well."""
LEFT = [("old", "old"), ("old", "new"), ("intent", "old"), ("intent", "new"), ("new", "new")]
"""Audit and control; an outcome is in the audit only after the control has answered."""


class Cut:
    """Three moments of one run: before a write, between its sending and its commit, and after it."""

    def __init__(self, directory: Path, bench: Bench) -> None:
        self.directory, self.bench = directory, bench
        self.macros: dict[str, dict[int, float | None]] = {}

    def photograph(self, moment: str) -> None:
        """Keep what a power cut would leave if everything had reached the disk by now."""
        folder = self.directory / moment
        folder.mkdir()
        for path in self.bench.configuration.history.path.parent.glob("history.sqlite*"):
            shutil.copyfile(path, folder / path.name)
        self.macros[moment] = {number: self.bench.nc.macros.get(number) for number in BLOCK}

    def restore(self, *, file: str, audit: str, cnc: str) -> None:
        """Put the disk and the control to what stood there at these moments."""
        store = self.bench.configuration.history.path
        for path in store.parent.glob("history.sqlite*"):
            path.unlink()
        for suffix in ("", "-wal", "-shm"):
            if (path := self.directory / AUDIT_FROM[audit] / f"history.sqlite{suffix}").exists():
                shutil.copyfile(path, store.with_name(path.name))
        if audit == "intent":
            with closing(sqlite3.connect(store)) as connection:
                connection.execute("UPDATE writes SET outcome = 0 WHERE write_id = (SELECT max(write_id) FROM writes)")
                connection.commit()
        last_block = store.with_name(LAST_BLOCK)
        if file in ("old", "new"):
            shutil.copyfile(self.directory / file / LAST_BLOCK, last_block)
        elif file == "torn":
            old, new = ((self.directory / moment / LAST_BLOCK).read_bytes() for moment in ("old", "new"))
            last_block.write_bytes(new[:40] + old[40:])
        for number, value in self.macros[cnc].items():
            self.bench.nc.macros.set(number, value)


@pytest.fixture
async def cut(tmp_path: Path) -> Cut:
    (tmp_path / "state").mkdir()
    bench = Bench(tmp_path / "state")
    cut = Cut(tmp_path, bench)
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(-4.0, -6.0, 5)
        for moment, error_um in (("old", -6.0), ("new", -6.4)):
            await rig.turn(rig.estimate(error_um, error_um - 1.0))
            await rig.history.flushed()
            cut.photograph(moment)
    assert cut.macros["old"] != cut.macros["new"]
    assert cut.macros["new"][SEQUENCE_A] == cut.macros["old"][SEQUENCE_A] + 1.0  # type: ignore[operator]
    return cut


async def state_after(cut: Cut) -> tuple[str, str | None]:
    async with running(cut.bench.rig()) as rig:
        for _ in range(2):
            await rig.turn()
        await rig.history.flushed()
        return rig.state, rig.control.journal.fault


@pytest.mark.parametrize(("audit", "cnc"), LEFT)
@pytest.mark.parametrize("file", ["old", "new", "torn", "absent"])
async def test_no_order_of_what_reached_the_disk_is_a_fault(cut: Cut, file: str, audit: str, cnc: str) -> None:
    cut.restore(file=file, audit=audit, cnc=cnc)
    state, fault = await state_after(cut)
    assert fault is None and state in ("ACTIVE", "HOLD", "ARMED")
    with HistoryReader(cut.bench.configuration.history.path) as reader:
        gaps = [event.text for event in reader.events(0.0, 1e11) if event.kind == "audit gap"]
    unknown_to_audit = audit == "old" and (cnc == "new" or file == "new")
    assert bool(gaps) == unknown_to_audit, gaps


@pytest.mark.parametrize(
    ("file", "audit", "number"),
    [
        *(("old", "new", number) for number in BLOCK),
        *((file, audit, 503) for file in ("old", "new", "torn", "absent") for audit in ("old", "new")),
    ],
)
async def test_a_foreign_value_stays_a_fault(cut: Cut, file: str, audit: str, number: int) -> None:
    cut.restore(file=file, audit=audit, cnc=audit)
    held = cut.bench.nc.macros.get(number)
    assert held is not None
    cut.bench.nc.macros.set(number, held + (100.0 if number in (SEQUENCE_A, SEQUENCE_B) else 0.0037))
    state, fault = await state_after(cut)
    assert state == "FAULT" and fault is not None and f"#{number} holds" in fault


async def test_the_next_numbers_over_a_value_out_of_bounds_are_a_fault(cut: Cut) -> None:
    cut.restore(file="absent", audit="old", cnc="new")
    cut.bench.nc.macros.set(503, 0.031)
    state, fault = await state_after(cut)
    assert state == "FAULT" and fault is not None and "#503 holds 0.031" in fault


async def test_half_a_block_after_a_power_cut_is_ours(cut: Cut) -> None:
    cut.restore(file="torn", audit="old", cnc="new")
    cut.bench.nc.macros.set(SEQUENCE_B, cut.macros["old"][SEQUENCE_B])
    assert (await state_after(cut))[1] is None


async def test_what_a_power_cut_may_leave_counts_at_the_start_alone(cut: Cut) -> None:
    cut.restore(file="new", audit="new", cnc="new")
    async with running(cut.bench.rig()) as rig:
        await rig.turn()
        assert rig.control.journal.fault is None
        for number in (SEQUENCE_A, SEQUENCE_B):
            cut.bench.nc.macros.set(number, cut.bench.nc.macros.get(number) + 1.0)  # type: ignore[operator]
        await rig.turn()
        assert rig.state == "FAULT"


@pytest.mark.parametrize(
    ("first", "last", "ours"),
    [
        (44.0, 44.0, True),
        (44.0, 43.0, True),
        (46.0, 46.0, True),
        (47.0, 47.0, False),
        (43.0, 44.0, False),
        (44.5, 44.5, False),
        (45.0, 44.0, False),
        (None, 44.0, False),
        (float("inf"), float("inf"), False),
        (float("nan"), float("nan"), False),
    ],
)
def test_which_numbers_show_a_write_of_ours(first: float | None, last: float, ours: bool) -> None:
    assert begun_after({1: (42.0, 43.0), 2: (42.0, 43.0)}, {1: first, 2: last}, 1, 2) is ours


# --- the file alone --------------------------------------------------------------------------

AUDIT: Mapping[int, tuple[float, ...]] = {500: (94.0,), 524: (3.0,)}


@pytest.mark.parametrize(
    ("write_id", "known", "lost"),
    [
        (93, {500: (94.0,), 524: (3.0,)}, ""),
        (94, {500: (94.0,), 524: (3.0,)}, ""),
        (95, {500: (43.0, 44.0), 524: (3.0,)}, "#500 44"),
        (None, {500: (94.0, 43.0, 44.0), 524: (3.0,)}, "#500 44"),
    ],
)
def test_the_newer_of_file_and_audit_counts(
    tmp_path: Path, write_id: int | None, known: Mapping[int, tuple[float, ...]], lost: str
) -> None:
    block = WriteAheadRecord(tmp_path / "last-block")
    block.keep({500: (43.0, 44.0)}, write_id)
    assert block.newer_of(AUDIT, 94) == (known, lost)
    assert block.newer_of(None, None) == ({500: (43.0, 44.0)}, "#500 44")
    block.close()


def test_every_tear_of_the_file_leaves_the_audit(tmp_path: Path) -> None:
    path = tmp_path / "last-block"
    block = WriteAheadRecord(path)
    block.keep({500: (43.0, 44.0), 503: (-0.0061, -0.0064)}, 94)
    old = path.read_bytes()
    block.keep({500: (44.0, 45.0), 503: (-0.0064, -0.0066)}, 95)
    new = path.read_bytes()
    for k in range(len(new)):
        for torn in (new[:k] + old[k:], old[:k] + new[k:], new[:k], new[:k] + bytes(len(new) - k)):
            path.write_bytes(torn)
            known, _ = block.newer_of(AUDIT, 94)
            assert known is not None and (94.0 in known[500] or torn.startswith(new.partition(b"\n")[0]))
    block.close()


# --- the block of the spindle speed ----------------------------------------------------------


def speed_block(tmp_path: Path, sequence: int) -> dict[int, float]:
    made_for = OperationKey(
        tool_number=1.0, speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=2.0, radial_mm=0.0, kind=1.0
    )
    pair = SpeedPair(made_for=made_for, speed_rpm=9000.0 + sequence, feed_mm_min=1800.0, enable=True)
    groups = SpeedBlock(MACROS).encode(pair, after=sequence - 1, valid_until_s=700.0 + sequence)
    return {number: value for group in groups for number, value in group}


@pytest.mark.parametrize("kept", [41, None], ids=["file old", "file absent"])
@pytest.mark.parametrize("audited", [41, 43], ids=["audit old", "audit new"])
@pytest.mark.parametrize("whole", [True, False])
def test_a_power_cut_leaves_a_speed_that_is_ours(tmp_path: Path, kept: int | None, audited: int, whole: bool) -> None:
    store, tuning = tmp_path / "history.sqlite", speed_machine(tmp_path).spindle_speed
    assert tuning is not None
    if kept is not None:
        WriteAheadRecord.of_speed(store).keep({n: (value,) for n, value in speed_block(tmp_path, kept).items()})
    audit = {number: (value,) for number, value in speed_block(tmp_path, audited).items()}
    found = dict(speed_block(tmp_path, 43))
    if not whole and audited == 41:
        found[MACROS.sequence_b] = 41.0

    def mismatch(**changes: float) -> str:
        writer = SpeedWriter(tuning, SpeedBlock(MACROS), store, audit, 7)
        held = found | {getattr(MACROS, name): value for name, value in changes.items()}
        return writer.mismatch(held, clock_s=600.0, now_s=0.0)

    assert mismatch() == ""
    assert "holds 60" in mismatch(sequence_a=60.0, sequence_b=60.0)
    if audited == 43:
        assert "holds 12000" in mismatch(speed=12000.0)
