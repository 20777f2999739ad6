"""Cycles of a LATSIS line: values in chain order, who is missing and why, and when a pass ends."""

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from latsis_line import BYTE_S, PERIOD_S, Line, instant, only

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.contract import FatalDriverError
from drivers.latsis.cycle import SILENT_AFTER_CYCLES, CycleAssembler
from drivers.latsis.line_pass import RELEASED_AFTER_CYCLES
from models.quality import Reason
from models.records import Instant

CRC = {"start": ":", "separator": ",", "status": True, "checksum": "crc8"}


@pytest.fixture
def line() -> Line:
    """A bare line that has already delivered one good cycle."""
    line = Line()
    assert only(line.one_pass()).complete
    return line


# A sound line


@pytest.mark.parametrize(
    "settings",
    [{"profile": "bare"}, {"profile": "checked"}, {"profile": "custom", "grammar": CRC}, {"id_offset": 40}],
    ids=["bare", "checked", "crc8", "offset"],
)
def test_a_pass_is_a_complete_cycle_at_its_last_byte(settings: dict[str, object]) -> None:
    line = Line(20, infrared=[3, 20], **settings)
    for number in (1, 2, 3):
        start_s = line.at_s
        cycle = only(line.send(*(line.frame(i) for i in line.ids)))
        last_byte_s = line.at_s - BYTE_S
        assert (cycle.complete, cycle.number, cycle.faults, cycle.line) == (True, number, (), "spindle")
        assert line.good(cycle) == line.expected()
        assert cycle.trace.first_byte.monotonic_s == start_s
        assert cycle.trace.last_byte.monotonic_s == pytest.approx(last_byte_s, abs=1e-9)
        assert line.rest() == []
    assert line.assembler.frames == 60


def test_a_chain_with_an_unknown_sensor_is_refused() -> None:
    with pytest.raises(FatalDriverError, match=r"spindle.*\[502\]"):
        CycleAssembler(
            LineConfig(name="spindle", port="none", chain=["501-502"]), [SensorConfig(id=501, component="c")]
        )


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 120), min_size=1, max_size=40))
def test_any_chunking_gives_the_same_cycles(sizes: list[int]) -> None:
    whole, pieces = Line(9, profile="checked"), Line(9, profile="checked")
    stream = b"".join(whole.frame(i) for _ in range(3) for i in whole.ids)
    expected = whole.assembler.feed(stream, instant(0))
    got = []
    rest = stream
    for size in sizes:
        got += pieces.assembler.feed(rest[:size], instant(0))
        rest = rest[size:]
    got += pieces.assembler.feed(rest, instant(0))
    assert len(got) == len(expected) == 3
    assert all(np.array_equal(a.degc, b.degc) and a.complete and b.complete for a, b in zip(got, expected, strict=True))


# Missing, duplicate and damaged IDs


def test_a_missing_sensor_is_named_and_delays_nothing(line: Line) -> None:
    cycle = only(line.send(*(line.frame(i) for i in line.ids if i != 7)))
    assert not cycle.complete
    assert line.reasons(cycle) == {7: Reason.NOT_RECEIVED}
    assert cycle.faults == ("line spindle: not received: sensor 507 (ID 007h)",)


def test_a_rejected_frame_is_reported_with_its_byte(line: Line) -> None:
    start = sum(len(line.frame(i)) for i in line.ids)  # the fixture's pass
    damaged = [line.frame(i)[1:] if i == 7 else line.frame(i) for i in line.ids]
    cycle = only(line.send(*damaged))
    assert line.reasons(cycle) == {7: Reason.NOT_RECEIVED}
    first = start + 5 * 7
    assert f"bytes {first}-{first + 5} rejected: wrong length" in cycle.faults[1]


@pytest.mark.parametrize("shown", [11, 10, 5, 4, 3, 2])
def test_a_damaged_id_drops_both_places(line: Line, shown: int) -> None:
    # The frame of ID 7 comes under another ID of the chain, above or below.
    frames = [line.frame(shown if i == 7 else i, line.codes[i]) for i in line.ids]
    cycle = only(line.send(*frames) + line.rest())
    assert line.reasons(cycle) == {7: Reason.NOT_RECEIVED, shown: Reason.DUPLICATE_ID}
    assert not cycle.complete
    assert line.good(cycle) == {i: v for i, v in line.expected().items() if i not in {7, shown}}
    assert any(f"sensor {500 + shown}" in fault and "out of order at byte" in fault for fault in cycle.faults)


def test_an_id_sent_twice_in_a_row_is_not_believed(line: Line) -> None:
    frames = [line.frame(i) for i in line.ids]
    cycle = only(line.send(*frames[:5], line.frame(8, 0x7AA), *frames[5:]))
    assert line.reasons(cycle) == {8: Reason.DUPLICATE_ID}


# The end of a pass


def test_silence_closes_an_incomplete_pass() -> None:
    line = Line()
    line.one_pass()
    assert line.send(*(line.frame(i) for i in line.ids[:-3])) == []
    last_s = line.at_s - BYTE_S
    assert line.assembler.poll(instant(last_s + 0.24 * PERIOD_S)) == []
    cycle = only(line.assembler.poll(instant(last_s + 0.26 * PERIOD_S)))
    assert line.reasons(cycle) == dict.fromkeys([1, 2, 3], Reason.NOT_RECEIVED)
    assert cycle.trace.last_byte.monotonic_s == pytest.approx(last_s)


def test_an_id_that_rises_again_closes_an_incomplete_pass(line: Line) -> None:
    assert line.send(*(line.frame(i) for i in line.ids[:-3])) == []
    start_s = line.at_s
    first, second = line.send(*(line.frame(i) for i in line.ids))
    assert line.reasons(first) == dict.fromkeys([1, 2, 3], Reason.NOT_RECEIVED)
    assert second.complete
    assert second.trace.first_byte.monotonic_s == pytest.approx(start_s)


def test_a_short_pause_of_this_computer_is_no_silence_on_a_fast_clock() -> None:
    line = Line(4)

    def fast(at_s: float) -> Instant:  # 600 times real time
        return Instant(monotonic_s=at_s * 600, utc_s=at_s * 600, real_s=at_s)

    line.assembler.feed(b"".join(line.frame(i) for i in (4, 3)), fast(0.0))
    assert line.assembler.poll(fast(0.04)) == []
    (cycle,) = line.assembler.feed(b"".join(line.frame(i) for i in (2, 1)), fast(0.045))
    assert cycle.complete
    line.assembler.feed(line.frame(4), fast(0.05))
    assert [c.complete for c in line.assembler.poll(fast(0.2))] == [False]


# Silent sensors


def test_a_dead_tail_is_not_waited_for_any_more_and_heard_again_when_it_speaks() -> None:
    line = Line()
    line.one_pass()
    alive = line.ids[:-3]
    for _ in range(SILENT_AFTER_CYCLES):
        assert line.send(*(line.frame(i) for i in alive)) == []
        assert not only(line.rest()).complete
    assert line.silent_ids == {3, 2, 1}
    cycle = only(line.send(*(line.frame(i) for i in alive)))
    assert cycle.complete  # nothing waits for them
    assert line.reasons(cycle) == dict.fromkeys([1, 2, 3], Reason.NOT_RECEIVED)
    assert "missing and no longer waited for: sensor 503 (ID 003h)" in cycle.faults[0]
    line.rest()
    only(line.one_pass())  # they speak again: too late for this cycle
    assert line.silent_ids == set()
    cycle = only(line.one_pass())
    assert cycle.complete
    assert line.good(cycle) == line.expected()


# Everything at once


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([0.002, 0.02, 0.2]))
def test_lost_bytes_never_give_a_value_that_was_not_sent(seed: int, loss: float) -> None:
    chance = random.Random(seed)
    line = Line(60, infrared=[7, 60], profile="checked")
    line.one_pass()
    for _ in range(6):
        sent = {i: chance.randrange(0x100, 0x300) if n == 3 else 0x3A00 + i for i, n in line.digits.items()}
        stream = b"".join(line.frame(i, sent[i]) for i in line.ids)
        cycles = line.send(bytes(byte for byte in stream if chance.random() >= loss)) + line.rest()
        line.codes = sent
        expected = line.expected()
        for cycle in cycles:
            for wire_id, degc in line.good(cycle).items():
                assert degc == expected[wire_id]
            assert cycle.complete or cycle.faults
    assert not line.quarantined
    line.codes = {i: 0x190 if n == 3 else 0x3A2B for i, n in line.digits.items()}
    assert line.good(line.one_pass()[-1]) == line.expected()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32))
def test_flipped_bits_give_wrong_values_to_nobody_on_a_checked_line(seed: int) -> None:
    chance = random.Random(seed)
    line = Line(40, profile="checked")
    line.one_pass()
    for _ in range(4):
        frames = [bytearray(line.frame(i)) for i in line.ids]
        for frame in chance.sample(frames, 6):
            frame[chance.randrange(len(frame))] ^= 1 << chance.randrange(8)
        for cycle in line.send(*map(bytes, frames)) + line.rest():
            good = line.good(cycle)
            assert good == {i: line.expected()[i] for i in good}


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=300), st.floats(0, 20)), max_size=20), st.booleans())
def test_garbage_never_raises_and_a_sound_line_recovers(pieces: list[tuple[bytes, float]], checked: bool) -> None:
    line = Line(8, profile="checked" if checked else "bare")
    for data, wait_s in pieces:
        line.at_s += wait_s
        line.assembler.feed(data, instant(line.at_s))
        line.assembler.poll(instant(line.at_s + wait_s / 2))
    line.rest()
    line.send(b"\r\n")
    line.rest()
    for _ in range(RELEASED_AFTER_CYCLES + 1):
        cycle = line.one_pass()[-1]
    assert line.good(cycle) == line.expected()
