"""What a previous run left, and whether it may be taken up again."""

from dataclasses import replace

import numpy as np
import pytest
from control_rig import HandClock, machine

from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.compensation.references import reference_from_state, reference_to_state
from daemon.compensation.restart import load_resume_point, rest_to_state, wanted_at_start, with_rest
from daemon.history import HistoryReader
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from models.control.compensation import initial_memory
from models.records import Reference

AXES = ("x", "y", "z")


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


def reference(clock):
    return Reference(
        reference_id="r1",
        time=clock.now(),
        source="O1000 N100",
        degc=np.array([20.0, np.nan, 21.5, 22.0, 23.0]),
        program=1000,
        work_offset=54,
        power_on_count=7,
    )


def leave(configuration, clock):
    history = history_of(configuration, clock)
    history.start()
    history.put_state("wanted", {"x": False, "y": True, "z": True})
    history.put_state("reference", reference_to_state(reference(clock)))
    history.put_state("alive_utc_s", clock.now().utc_s)
    history.close()


def test_a_reference_survives_the_store_with_its_age_and_its_gaps(clock):
    state = reference_to_state(reference(clock))
    later = HandClock(77.0)  # another boot: the monotonic clock began again
    taken = reference_from_state({**state, "utc_s": later.now().utc_s - 40.0}, later)
    assert taken.time.monotonic_s == pytest.approx(37.0)
    assert np.array_equal(taken.degc, [20.0, np.nan, 21.5, 22.0, 23.0], equal_nan=True)
    assert (taken.program, taken.work_offset, taken.power_on_count) == (1000, 54, 7)


@pytest.mark.parametrize(("outage_s", "resumed"), [(0.0, True), (599.0, True), (601.0, False), (-5.0, False)])
def test_only_a_short_outage_is_resumed(configuration, clock, outage_s, resumed):
    leave(configuration, clock)
    clock.monotonic_s += outage_s
    point = load_resume_point(configuration, history_of(configuration, clock), clock, block_of(configuration))
    assert point.wanted == (False, True, True)
    assert point.resumable == resumed
    applied_um = np.array([0.0, 0.0, 5.0])
    assert wanted_at_start(point, applied_um, in_time=True) == (
        (False, True, True) if resumed else (False, False, True)
    )
    assert wanted_at_start(point, applied_um, in_time=False) == (False, False, True)
    assert (point.reference is not None) == resumed


def test_a_new_store_leaves_nothing(configuration, clock):
    point = load_resume_point(configuration, history_of(configuration, clock), clock, block_of(configuration))
    assert (point.wanted, point.reference, point.known_macros, point.rest) == ((False,) * 3, None, None, None)


def memory():
    start = initial_memory(now_s=0.0, applied_um=np.array([0.0, -5.0, 10.0]), wanted=(False, True, True))
    return replace(
        start,
        reference_id="r1",
        model_id="m",
        baseline_um=np.array([0.0, -1.0, 2.0]),
        offset_um=np.array([0.0, 0.5, 0.25]),
    )


def test_the_baseline_comes_back_with_its_reference(clock):
    rest = rest_to_state(memory(), AXES)
    fresh = initial_memory(now_s=9.0, applied_um=np.array([0.0, -4.0, 9.0]), wanted=(False, True, True))
    taken = with_rest(fresh, rest, AXES, reference(clock), "m")
    assert (taken.reference_id, taken.model_id) == ("r1", "m")
    assert taken.baseline_um.tolist() == [0.0, -1.0, 2.0] and taken.offset_um.tolist() == [0.0, 0.5, 0.25]
    assert taken.command_um.tolist() == [0.0, -4.0, 9.0], "the command still begins at the echo"


def test_without_the_baseline_of_this_reference_it_is_not_taken_up(clock):
    rest = rest_to_state(memory(), AXES)
    fresh = initial_memory(now_s=9.0, applied_um=np.zeros(3), wanted=(False,) * 3)
    for wrong in (None, {**rest, "reference_id": "r0"}, rest_to_state(memory(), ("x", "y", "w"))):
        with pytest.raises(ValueError, match="baseline was not stored"):
            with_rest(fresh, wrong, AXES, reference(clock), "m")


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


@pytest.mark.parametrize("content", [b"", b"00000000 {}\n", b"garbage", b"\xff" * 5000])
def test_a_broken_file_is_as_good_as_none(configuration, content):
    path = configuration.history.path.with_name(configuration.history.path.name + ".last-block")
    path.write_bytes(content)
    assert block_of(configuration).load() is None


def test_a_shorter_line_over_a_longer_one_is_read_as_what_it_is(configuration):
    block = block_of(configuration)
    block.keep({500: (1.0, 2.0, 3.0), 501: (0.123456789,)})
    block.keep({500: (4.0,)})
    block.close()
    assert block.load() == {500: (4.0,)}


def test_a_folder_that_cannot_be_written_stops_nothing(tmp_path):
    block = WriteAheadRecord(tmp_path / "missing" / "last-block")
    block.keep({500: (1.0,)})
    assert block.load() is None
