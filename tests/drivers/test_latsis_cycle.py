"""Cycles of a LATSIS line: values in chain order, who is missing and why, and whose numbering is trusted."""

import math
import random
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.contract import FatalDriverError
from drivers.latsis_cycle import SILENT_AFTER_CYCLES, CycleAssembler
from drivers.latsis_frames import crc8, sum8
from drivers.latsis_numbering import RELEASED_AFTER_CYCLES, RENUMBERED_AFTER_CYCLES
from drivers.latsis_values import RESET_BURST_SENSORS, decode_mlx90615, decode_tmp102
from models.quality import Quality, Reason
from models.records import Instant, TemperatureCycle

PERIOD_S = 10.0
BYTE_S = 10 / 9600
CRC = {"start": ":", "separator": ",", "status": True, "checksum": "crc8"}


def instant(at_s: float) -> Instant:
    return Instant(monotonic_s=at_s, utc_s=1e9 + at_s, real_s=at_s)


class Line:
    """A chain of nodes, its bytes on the wire, and the assembler that listens."""

    def __init__(self, count: int = 12, *, infrared: Iterable[int] = (), **settings: object) -> None:
        chain = [f"{500 + 1}-{500 + count}"]  # sensor IDs differ from the IDs on the wire
        self.config = LineConfig.model_validate({"name": "spindle", "port": "none", "chain": chain, **settings})
        infrared = {500 + position for position in infrared}
        sensors = [
            SensorConfig(id=i, component="c", device="MLX90615" if i in infrared else "TMP102")
            for i in self.config.sensor_ids
        ]
        self.assembler = CycleAssembler(self.config, sensors)
        self.offset = self.config.id_offset
        self.digits = {i + self.offset: 4 if 500 + i in infrared else 3 for i in range(1, count + 1)}
        self.codes = {i: 0x190 + i if n == 3 else 0x3A2B for i, n in self.digits.items()}
        self.ids = tuple(range(self.offset + count, self.offset, -1))
        self.at_s = 0.0

    def frame(self, wire_id: int, code: int | None = None, status: int = 0, digits: int | None = None) -> bytes:
        code = self.codes.get(wire_id, 0x190) if code is None else code
        digits = digits or self.digits.get(wire_id, 3)
        grammar = self.config.frame_grammar
        if grammar.checksum == "none":
            return b"%0*X%0*X\r\n" % (grammar.id_digits, wire_id, digits, code)
        body = b"%03X,%0*X,%02X" % (wire_id, digits, code, status)
        check = sum8(body) if grammar.checksum == "sum8" else crc8(body)
        return b":%b*%02X\r\n" % (body, check)

    def send(self, *frames: bytes) -> list[TemperatureCycle]:
        """Send frames at 9600 baud, one byte at a time, without a pause before them."""
        cycles = []
        for byte in b"".join(frames):
            cycles += self.assembler.feed(bytes([byte]), instant(self.at_s))
            self.at_s += BYTE_S
        return cycles

    def rest(self) -> list[TemperatureCycle]:
        """Let the line be silent until its next pass is due."""
        start_s = self.at_s
        cycles = []
        while self.at_s < start_s + 0.6 * PERIOD_S:
            self.at_s += PERIOD_S / 16
            cycles += self.assembler.poll(instant(self.at_s))
        return cycles

    def one_pass(self, ids: Sequence[int] | None = None, **codes: int) -> list[TemperatureCycle]:
        """Send one whole pass (or the given IDs) and let the line rest."""
        changed = {int(name[1:]): code for name, code in codes.items()}
        frames = [self.frame(i, changed.get(i)) for i in (self.ids if ids is None else ids)]
        return self.send(*frames) + self.rest()

    def good(self, cycle: TemperatureCycle) -> dict[int, float]:
        """Accepted values by ID on the wire."""
        return {
            self.offset + 1 + i: float(value) for i, value in enumerate(cycle.degc) if cycle.quality[i] == Quality.GOOD
        }

    def reasons(self, cycle: TemperatureCycle) -> dict[int, Reason]:
        return {self.offset + 1 + i: Reason(code) for i, code in enumerate(cycle.reason) if code}

    def expected(self) -> dict[int, float]:
        return {
            i: decode_tmp102(code)[0] if self.digits[i] == 3 else decode_mlx90615(code)[0]
            for i, code in self.codes.items()
        }


def only(cycles: list[TemperatureCycle]) -> TemperatureCycle:
    assert len(cycles) == 1
    return cycles[0]


@pytest.fixture
def line() -> Line:
    """A bare line that has already delivered one good cycle."""
    line = Line()
    assert only(line.one_pass()).complete
    return line


# Decoding


@pytest.mark.parametrize(
    ("code", "extended", "degc"),
    [(0x190, False, 25.0), (0xE70, False, -25.0), (0x001, False, 0.0625), (0xFFF, False, -0.0625),
     (0x7FF, False, 127.9375), (0x800, False, -128.0), (0x0190, True, 25.0), (0x1E70, True, -25.0),
     (0x0960, True, 150.0), (0x1FFF, True, -0.0625)],
)  # fmt: skip
def test_tmp102_register(code: int, extended: bool, degc: float) -> None:
    assert decode_tmp102(code, extended_mode=extended) == (degc, Reason.NONE)


def test_codes_beyond_the_register_have_no_temperature() -> None:
    value, reason = decode_tmp102(0x2000, extended_mode=True)
    assert math.isnan(value)
    assert reason == Reason.UNREADABLE


def test_mlx90615_register_and_error_flag() -> None:
    assert decode_mlx90615(0x3A2B)[0] == pytest.approx(0x3A2B * 0.02 - 273.15)
    value, reason = decode_mlx90615(0x8000 | 0x3A2B)
    assert math.isnan(value)
    assert reason == Reason.DEVICE_ERROR


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
    assert line.assembler.statistics.frames == 60
    assert line.assembler.statistics.bytes == sum(len(line.frame(i)) for i in line.ids) * 3


def test_extended_mode_uses_four_digits() -> None:
    line = Line(3, extended_mode=True)
    line.digits = dict.fromkeys(line.digits, 4)
    cycle = only(line.one_pass(c3=0x0190, c2=0x1E70, c1=0x0960))
    assert line.good(cycle) == {3: 25.0, 2: -25.0, 1: 150.0}


def test_a_chain_of_one_sensor() -> None:
    line = Line(1)
    assert [only(line.one_pass()).complete for _ in range(3)] == [True] * 3


def test_chain_order_is_the_order_of_the_configuration() -> None:
    config = LineConfig(name="mixed", port="none", chain=[30, 10, 20])
    assembler = CycleAssembler(config, [SensorConfig(id=i, component="c") for i in (10, 20, 30)])
    cycle = only(assembler.feed(b"03190\r\n02191\r\n01192\r\n", instant(0)))
    assert list(cycle.degc) == [25.125, 25.0625, 25.0]  # position 1 is sensor 30


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
    start = line.assembler.statistics.bytes
    damaged = [line.frame(i)[1:] if i == 7 else line.frame(i) for i in line.ids]
    cycle = only(line.send(*damaged))
    assert line.reasons(cycle) == {7: Reason.NOT_RECEIVED}
    first = start + 5 * 7
    assert f"bytes {first}-{first + 5} rejected: wrong length" in cycle.faults[1]
    assert line.assembler.statistics.rejected == {"wrong length": 1}


@pytest.mark.parametrize("shown", [11, 10, 5, 4, 3, 2])
def test_a_damaged_id_drops_both_places(line: Line, shown: int) -> None:
    # The frame of ID 7 comes under another ID of the chain, above or below.
    frames = [line.frame(shown if i == 7 else i, line.codes[i]) for i in line.ids]
    cycle = only(line.send(*frames) + line.rest())
    assert line.reasons(cycle) == {7: Reason.NOT_RECEIVED, shown: Reason.DUPLICATE_ID}
    assert not cycle.complete
    assert line.good(cycle) == {i: v for i, v in line.expected().items() if i not in {7, shown}}
    assert any(f"sensor {500 + shown}" in fault and "out of order at byte" in fault for fault in cycle.faults)


@pytest.mark.parametrize("shown", [0x87, 0xF7, 0])
def test_a_damaged_id_that_no_sensor_has(line: Line, shown: int) -> None:
    frames = [line.frame(shown if i == 7 else i, line.codes[i]) for i in line.ids]
    cycle = only(line.send(*frames) + line.rest())
    assert line.reasons(cycle) == {7: Reason.NOT_RECEIVED}
    assert any(f"no sensor of this line (ID {shown:03X}h)" in fault for fault in cycle.faults)
    assert only(line.one_pass()).complete


def test_a_damaged_id_that_shows_the_lowest_does_not_end_the_cycle(line: Line) -> None:
    frames = [line.frame(1 if i == 9 else i, line.codes[i]) for i in line.ids]
    cycle = only(line.send(*frames) + line.rest())
    assert line.reasons(cycle) == {9: Reason.NOT_RECEIVED, 1: Reason.DUPLICATE_ID}
    assert only(line.one_pass()).complete


def test_a_damaged_highest_id_costs_its_value_only(line: Line) -> None:
    frames = [line.frame(4 if i == 12 else i, line.codes[i]) for i in line.ids]
    cycle = only(line.send(*frames) + line.rest())
    assert line.reasons(cycle) == {12: Reason.NOT_RECEIVED, 4: Reason.DUPLICATE_ID}


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


def test_silence_is_noticed_when_the_next_bytes_come() -> None:
    line = Line()
    line.one_pass()
    line.send(*(line.frame(i) for i in line.ids[:-3]))
    line.at_s += PERIOD_S  # nobody polls
    first, second = line.send(*(line.frame(i) for i in line.ids))
    assert (first.complete, second.complete) == (False, True)


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


def test_a_pass_joined_under_way_is_discarded_and_counted() -> None:
    line = Line()
    assert line.send(line.frame(6)[3:], *(line.frame(i) for i in line.ids if i < 6)) + line.rest() == []
    assert line.assembler.statistics.passes_discarded == 1
    cycle = only(line.one_pass())
    assert (cycle.complete, cycle.number, cycle.faults) == (True, 1, ())


def test_a_lost_link_delivers_what_had_arrived(line: Line) -> None:
    line.send(*(line.frame(i) for i in line.ids[:4]))
    cycle = only(line.assembler.finish())
    assert sorted(line.good(cycle)) == [9, 10, 11, 12]
    assert line.assembler.finish() == []


# Silent sensors


def test_a_dead_tail_is_not_waited_for_any_more_and_heard_again_when_it_speaks() -> None:
    line = Line()
    line.one_pass()
    alive = line.ids[:-3]
    for _ in range(SILENT_AFTER_CYCLES):
        assert line.send(*(line.frame(i) for i in alive)) == []
        assert not only(line.rest()).complete
    assert line.assembler.statistics.silent_ids == (3, 2, 1)
    cycle = only(line.send(*(line.frame(i) for i in alive)))
    assert cycle.complete  # nothing waits for them
    assert line.reasons(cycle) == dict.fromkeys([1, 2, 3], Reason.NOT_RECEIVED)
    assert "silent and not waited for any more: sensor 503 (ID 003h)" in cycle.faults[0]
    line.rest()
    only(line.one_pass())  # they speak again: too late for this cycle
    assert line.assembler.statistics.silent_ids == ()
    cycle = only(line.one_pass())
    assert cycle.complete
    assert line.good(cycle) == line.expected()


def test_lost_bytes_make_nobody_silent() -> None:
    line = Line(profile="checked")
    line.one_pass()
    damaged = [line.frame(i)[:-4] + b"\r\n" if i in {1, 2, 3} else line.frame(i) for i in line.ids]
    for _ in range(3 * SILENT_AFTER_CYCLES):
        line.send(*damaged)
        line.rest()
    assert line.assembler.statistics.silent_ids == ()


# Node resets


def test_a_reset_burst_is_refused_and_named(line: Line) -> None:
    cycle = only(line.one_pass(c9=0, c8=0, c7=0))
    assert line.reasons(cycle) == dict.fromkeys([7, 8, 9], Reason.RESET)
    assert all(math.isnan(cycle.degc[i - 1]) for i in (7, 8, 9))
    (fault,) = cycle.faults
    assert "burst of node resets, 3 sensors" in fault
    assert all(f"sensor {500 + i}" in fault for i in (7, 8, 9))
    assert line.assembler.statistics.resets == 3
    assert line.good(only(line.one_pass())) == line.expected()


def test_a_single_reset_is_refused(line: Line) -> None:
    assert line.reasons(only(line.one_pass(c5=0))) == {5: Reason.RESET}


def test_zero_without_a_predecessor_is_refused() -> None:
    line = Line()
    assert line.reasons(only(line.one_pass(c5=0))) == {5: Reason.RESET}


@pytest.mark.parametrize(("before", "genuine"), [(0x020, True), (0xFE0, True), (0x021, False), (0xFDF, False)])
def test_a_sensor_near_zero_may_read_zero(line: Line, before: int, genuine: bool) -> None:
    line.one_pass(c5=before)  # 2 degC, -2 degC, and one step beyond each
    cycle = only(line.one_pass(c5=0))
    assert (line.reasons(cycle) == {}) == genuine
    assert line.reasons(only(line.one_pass(c5=0))) == ({} if genuine else {5: Reason.RESET})


def test_within_a_burst_no_zero_is_believed(line: Line) -> None:
    line.one_pass(c5=0x008)
    burst = {f"c{i}": 0 for i in range(6, 6 + RESET_BURST_SENSORS)}
    assert line.reasons(only(line.one_pass(c5=0, **burst)))[5] == Reason.RESET


def test_infrared_sensors_have_no_reset_rule() -> None:
    line = Line(3, infrared=[2])
    line.one_pass()
    assert line.good(only(line.one_pass(c2=0x355A)))[2] == pytest.approx(0.01)


# Errors that the sensor reports


def test_a_status_byte_is_a_device_error() -> None:
    line = Line(profile="checked")
    frames = [line.frame(i, status=0x04 if i == 6 else 0) for i in line.ids]
    cycle = only(line.send(*frames))
    assert line.reasons(cycle) == {6: Reason.DEVICE_ERROR}
    assert "sensor 506 (ID 006h) reports an error: code 0196h, status 04h, at byte 96" in cycle.faults[0]
    assert cycle.complete


# Numbering


def test_a_renumbered_line_is_quarantined_and_released() -> None:
    line = Line()
    line.one_pass()
    fewer = line.ids[2:]
    for number in range(1, 4):
        cycle = only(line.one_pass(fewer))
        # Not even the first of them is assigned to sensors.
        assert set(line.reasons(cycle).values()) == {Reason.QUARANTINED}
        assert np.isnan(cycle.degc).all()
        assert not cycle.complete
        assert "announce 10 sensors where the chain has 12" in cycle.faults[0]
        assert line.assembler.statistics.quarantined == (number >= RENUMBERED_AFTER_CYCLES)
    alarm = line.assembler.statistics.alarm
    assert alarm is not None
    assert "line spindle" in alarm
    assert "Restore the chain, or correct `chain`" in alarm
    for number in range(1, RELEASED_AFTER_CYCLES + 1):
        cycle = only(line.one_pass())
        assert (Reason.QUARANTINED in line.reasons(cycle).values()) == (number < RELEASED_AFTER_CYCLES)
    assert line.good(cycle) == line.expected()
    assert line.assembler.statistics.alarm is None


def test_more_nodes_than_configured_are_quarantined() -> None:
    line = Line()
    line.one_pass()
    for _ in range(RENUMBERED_AFTER_CYCLES):
        cycle = only(line.one_pass((13, *line.ids)))
    assert line.assembler.statistics.quarantined
    assert "announce 13 sensors" in cycle.faults[0]


def test_ids_below_the_chain_are_quarantined() -> None:
    line = Line(id_offset=1)
    line.one_pass()
    for _ in range(RENUMBERED_AFTER_CYCLES + 1):
        line.one_pass((*line.ids, 1))
    assert line.assembler.statistics.quarantined
    assert "IDs below the chain's lowest" in (line.assembler.statistics.alarm or "")


def test_sensors_of_another_kind_under_an_id_are_quarantined() -> None:
    line = Line(infrared=[11, 12])
    line.one_pass()
    # The same count, but the chain has been put in backwards.
    backwards = [line.frame(i, 0x3A2B if i <= 2 else 0x190, digits=4 if i <= 2 else 3) for i in line.ids]
    for _ in range(RENUMBERED_AFTER_CYCLES):
        cycle = only(line.send(*backwards) + line.rest())
        assert set(line.reasons(cycle).values()) == {Reason.QUARANTINED}
    assert "another kind of sensor come under the IDs 002h, 001h" in cycle.faults[0]
    assert line.assembler.statistics.quarantined


def test_renumbering_is_seen_although_the_first_value_has_the_wrong_width() -> None:
    line = Line(infrared=[12])
    line.one_pass()
    for _ in range(RENUMBERED_AFTER_CYCLES):
        frames = [line.frame(i, 0x3A2B if i == 11 else 0x190, digits=4 if i == 11 else 3) for i in line.ids[1:]]
        cycle = only(line.send(*frames) + line.rest())
        assert set(line.reasons(cycle).values()) == {Reason.QUARANTINED}
    assert "announce 11 sensors" in cycle.faults[0]


def test_a_line_that_is_renumbered_from_the_start_is_never_assigned() -> None:
    line = Line()
    cycles = [cycle for _ in range(5) for cycle in line.one_pass(line.ids[1:])]
    assert len(cycles) == 4  # the first might have been joined under way
    assert all(set(line.reasons(cycle).values()) == {Reason.QUARANTINED} for cycle in cycles)
    assert line.assembler.statistics.quarantined


def test_lost_bytes_at_the_head_of_the_pass_are_no_renumbering() -> None:
    line = Line(profile="checked")
    line.one_pass()
    for _ in range(10):
        cycle = only(line.send(line.frame(12)[1:], line.frame(11)[:-5], *(line.frame(i) for i in line.ids[2:])))
        line.rest()
        assert line.reasons(cycle) == {12: Reason.NOT_RECEIVED, 11: Reason.NOT_RECEIVED}
    assert not line.assembler.statistics.quarantined


def test_a_quarantine_survives_lost_heads_and_ends_only_with_the_expected_count() -> None:
    line = Line()
    line.one_pass()
    for _ in range(RENUMBERED_AFTER_CYCLES):
        line.one_pass(line.ids[1:])
    for _ in range(2 * RELEASED_AFTER_CYCLES):
        line.send(line.frame(12)[1:], *(line.frame(i) for i in line.ids[1:]))
        line.rest()
    assert line.assembler.statistics.quarantined


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
    assert not line.assembler.statistics.quarantined
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
