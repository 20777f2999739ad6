"""What a previous run left, and whether it may be taken up again."""

import numpy as np
import pytest
from control_rig import HandClock, machine

from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.compensation.restart import KEPT_CAUSE, load_resume_point, wanted_at_start
from daemon.history.layout import MachineLayout
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import DaemonAlive, WantedAxes
from daemon.state_store.store import StateStore


@pytest.fixture
def clock():
    return HandClock()


@pytest.fixture
def configuration(tmp_path):
    return machine(tmp_path)


def history_of(configuration, clock):
    return HistoryWriter(
        configuration.history.path, clock=clock, machine=MachineLayout.from_configuration(configuration)
    )


def block_of(configuration):
    return WriteAheadRecord.beside(configuration.history.path)


def leave(configuration, clock):
    history = history_of(configuration, clock)
    history.start()
    store = StateStore(history, clock)
    store.put(WantedAxes(axes={"x": False, "y": True, "z": True}))
    store.put(DaemonAlive(utc_s=clock.now().utc_s))
    history.close()


@pytest.mark.parametrize(("outage_s", "resumed"), [(0.0, True), (599.0, True), (601.0, False), (-5.0, False)])
def test_only_a_short_outage_is_resumed(configuration, clock, outage_s, resumed):
    leave(configuration, clock)
    clock.monotonic_s += outage_s
    point = load_resume_point(configuration, history_of(configuration, clock), clock, block_of(configuration))
    assert point.wanted == (False, True, True)
    assert not point.refused if resumed else "away for longer than 600 s" in point.refused


def test_what_carries_no_offset_is_off_until_a_person_decides():
    wanted, applied_um = (False, True, True, True), np.array([0.0, 0.0, 5.0, 5.0])
    assert wanted_at_start(wanted, [False] * 4, applied_um) == wanted
    assert wanted_at_start(wanted, [True] * 4, applied_um) == (False, False, True, True)
    assert wanted_at_start(wanted, [False, True, False, False], applied_um) == (False, False, True, True)


def test_what_was_kept_before_the_write_counts_more_than_the_audit(configuration, clock):
    leave(configuration, clock)
    kept = {500: (7.0, 8.0), 503: (0.001, 0.0012)}
    block_of(configuration).keep(kept)
    history = history_of(configuration, clock)
    assert load_resume_point(configuration, history, clock, block_of(configuration)).known_macros == kept
    history.start()
    history.close()
    with HistoryReader(configuration.history.path) as reader:
        gaps = [event.text for event in reader.events(0.0, 1e11) if event.kind == "audit gap"]
    assert len(gaps) == 1 and "#500 8" in gaps[0] and "#503 0.0012" in gaps[0]


def test_a_write_that_the_audit_had_not_got_is_in_it_after_the_next_start(configuration, clock):
    leave(configuration, clock)
    history = history_of(configuration, clock)
    newest = history.last_write_id() or 0
    block_of(configuration).keep({500: (7.0, 8.0), 503: (0.001, 0.0012)}, newest + 2)
    load_resume_point(configuration, history, clock, block_of(configuration))
    history.start()
    later = history.write_intent(None, ((500, 9.0),), "tick")
    load_resume_point(configuration, history, clock, block_of(configuration))
    history.close()
    with HistoryReader(configuration.history.path) as reader:
        kept, tick = reader.unsettled_writes()[-2:]
    assert (kept.write_id, kept.cause, kept.macros) == (newest + 2, KEPT_CAUSE, ((500, 8.0), (503, 0.0012)))
    assert tick.write_id == int(later) == newest + 3, "no number is given twice"


@pytest.mark.parametrize("content", [b"", b"00000000 {}\n", b"garbage", b"\xff" * 5000])
def test_a_broken_file_is_as_good_as_none(configuration, content):
    path = configuration.history.path.with_name(configuration.history.path.name + ".last-block")
    path.write_bytes(content)
    assert block_of(configuration).load() is None
