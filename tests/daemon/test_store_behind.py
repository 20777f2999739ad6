"""The store cannot be written, the output goes on, the daemon ends: what the next start may go on from."""

import asyncio
import sqlite3
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

import pytest
from control_rig import FOREVER_S, Bench, HandClock, Rig, Z, machine, running
from speed_machine import speed_machine
from structlog.testing import capture_logs

from daemon.app import Daemon
from daemon.cnc.write_ahead import BEHIND, WriteAheadRecord
from daemon.compensation.restart import STORE_BEHIND
from daemon.history import database, engine, writer
from daemon.history.layout import MachineLayout
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from models.control.state import OperatorRequest

Happens = Callable[[Rig], Awaitable[None]]


@pytest.fixture(autouse=True)
def _in_a_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "BUSY_TIMEOUT_S", 0.01)
    monkeypatch.setattr(writer, "CLOSE_WITHIN_S", 0.1)
    monkeypatch.setattr(engine, "RETRY_FIRST_S", 0.01)


@contextmanager
def unwritable(store: Path) -> Iterator[None]:
    """Have another program lock the store, which refuses every commit as a full disk does."""
    with sqlite3.connect(store) as connection:
        connection.execute("BEGIN IMMEDIATE")
        yield
    connection.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(FOREVER_S):
        while not condition():
            await asyncio.sleep(0.01)


@asynccontextmanager
async def following(bench: Bench) -> AsyncIterator[Rig]:
    """A daemon whose output follows, with 10 um applied, and whose store has got everything."""
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        await rig.follow(0.0, -10.0, 40)
        rig.alive()
        await rig.history.flushed()
        yield rig


async def until_behind(rig: Rig) -> None:
    """Return when the daemon has noticed that its store cannot be written, and noted it beside."""
    await rig.turn()
    await until(lambda: bool(rig.history.problem))
    rig.alive()


async def disable(rig: Rig) -> None:
    rig.control.request(OperatorRequest(disable=frozenset({"y", "z"})), "anna")
    await rig.turn()


async def disable_and_retreat(rig: Rig) -> None:
    await disable(rig)
    await rig.follow(0.0, -10.0, 60)
    assert rig.state == "OFF"


async def fault(rig: Rig) -> None:
    ours = rig.nc.macros.get(Z)
    assert ours is not None
    rig.nc.macros.set(Z, ours + 0.003)
    await rig.turn()
    assert rig.state == "FAULT"
    rig.nc.macros.set(Z, ours)


async def reference(rig: Rig) -> None:
    rig.set_reference("r2", handshake=True)
    await rig.follow(0.0, -3.0, 20)


@pytest.mark.parametrize("happens", [disable, disable_and_retreat, fault, reference])
async def test_what_the_store_could_not_take_is_not_undone_by_a_restart(bench: Bench, happens: Happens) -> None:
    async with following(bench) as rig:
        with unwritable(rig.history.path):
            await happens(rig)
            await until_behind(rig)
            await asyncio.to_thread(rig.history.close)
    applied, ended = dict(bench.nc.guard.applied_um), []
    for identity in ("r3", "r4"):  # nor by the next one: nobody has decided anything meanwhile
        async with running(bench.rig()) as rig:
            await rig.turn()
            ended.append(rig.control.reference_ended)
            rig.set_reference(identity)
            await rig.follow(0.0, -25.0, 5)
            assert rig.state == ("OFF" if applied["z"] == 0.0 else "HOLD")
            assert dict(rig.applied) == applied
            rig.alive()
            await rig.history.flushed()
    assert "could not be written when" in ended[0]
    with HistoryReader(rig.history.path) as reader:
        assert [event.text for event in reader.events(0.0, 1e11)].count(STORE_BEHIND) == 1


async def test_a_person_s_decision_ends_the_waiting(bench: Bench) -> None:
    async with following(bench) as rig:
        with unwritable(rig.history.path):
            await until_behind(rig)
            await asyncio.to_thread(rig.history.close)
    async with running(bench.rig()) as rig:
        await rig.turn()
        rig.set_reference("r3", handshake=True)
        await rig.switch_on("z")
        await rig.follow(0.0, -2.0, 20)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(12.0, abs=0.11)
        rig.alive()
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -2.0, 3)
        assert rig.state == "ACTIVE" and rig.control.memory is not None
        assert rig.control.memory.wanted == (False, False, True)


async def test_a_store_that_has_got_everything_after_all_is_gone_on_with(bench: Bench) -> None:
    async with following(bench) as rig:
        with unwritable(rig.history.path):
            await until_behind(rig)
        async with asyncio.timeout(FOREVER_S):
            while rig.last_block.behind:  # some record or other waits at every moment
                await rig.follow(0.0, -10.0, 1)
                rig.alive()
                assert rig.history.waiting
                await asyncio.sleep(0.01)
    async with running(bench.rig()) as rig:
        await rig.follow(0.0, -10.0, 3)
        assert rig.state == "ACTIVE"


async def test_a_disk_that_does_not_answer_is_said_and_leaves_the_store_behind_too(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    async with following(bench) as rig:
        monkeypatch.setattr(writer, "STUCK_S", 0.05)
        rig.history.submit(lambda _connection: answers.wait(FOREVER_S))
        rig.alive()
        await until(lambda: "the disk has not answered for" in rig.history.problem)
        rig.alive()
        assert rig.last_block.behind and WriteAheadRecord.beside(rig.history.path).behind
        answers.set()
        await until(lambda: not rig.history.problem)


async def test_what_the_cnc_holds_and_no_record_explains_is_no_restart_to_go_on_from(bench: Bench) -> None:
    """A disk that can no longer be written at all: neither the store nor the last block has what was written then."""
    last_block = bench.configuration.history.path.with_name("history.sqlite.last-block")
    async with following(bench) as rig:
        before = last_block.read_bytes()
        with unwritable(rig.history.path):
            await reference(rig)
            await asyncio.to_thread(rig.history.close)
    last_block.write_bytes(before)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.state == "FAULT"
        rig.acknowledge("anna")
        await rig.follow(0.0, -10.0, 5)
        assert rig.state == "HOLD" and rig.control.reference is None
        assert rig.applied["z"] == pytest.approx(13.0, abs=0.11)


async def test_a_long_outage_is_none_to_go_on_from_at_the_second_start_either(bench: Bench) -> None:
    async with following(bench):
        pass
    bench.clock.monotonic_s += 3600.0
    for identity in ("r3", "r4"):
        async with running(bench.rig()) as rig:
            await rig.turn()
            rig.set_reference(identity)
            await rig.follow(0.0, -25.0, 5)
            assert rig.state == "HOLD" and rig.applied["z"] == pytest.approx(10.0, abs=0.11)
            rig.alive()


def test_the_tuning_of_the_spindle_speed_is_off_then_until_a_person_switches_it_on(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.configuration = speed_machine(tmp_path)
    WriteAheadRecord.beside(bench.configuration.history.path).keep({500: (1.0,)}, 1)
    last_block = bench.configuration.history.path.with_name("history.sqlite.last-block")
    assert bench.rig().speed.follower.switch.inhibit == ""  # type: ignore[union-attr]
    last_block.write_bytes(last_block.read_bytes() + BEHIND)
    assert "could not be written" in bench.rig().speed.follower.switch.inhibit  # type: ignore[union-attr]


async def test_a_state_that_was_dropped_while_the_disk_was_full_is_in_the_store_afterwards(bench: Bench) -> None:
    store = HistoryWriter(
        bench.configuration.history.path,
        clock=bench.clock,
        machine=MachineLayout.from_configuration(bench.configuration),
        queue_limit=5,
    )
    store.start()
    store.put_state("wanted", {"z": True})
    await store.flushed()
    with unwritable(store.path):
        store.put_state("wanted", {"z": False})
        for number in range(20):
            store.event("notice", f"event {number}")
    assert store.dropped["states"] == 1
    store.event("notice", "there is space again")
    await until(lambda: not store.waiting and not store.problem)
    store.close()
    with HistoryReader(store.path) as reader:
        assert reader.get_state("wanted") == {"z": False}


async def test_the_log_says_that_the_store_works_again(tmp_path: Path) -> None:
    configuration = machine(tmp_path)
    daemon = Daemon(configuration, HandClock())
    with capture_logs() as logs:
        daemon._history.start()
        with unwritable(configuration.history.path):
            daemon._history.event("note", "while the disk was full", "anna")
            await until(lambda: [each["event"] for each in logs] == ["history.problem"])
        await until(lambda: [each["event"] for each in logs][-1] == "history.works_again")
        daemon._history.close()
