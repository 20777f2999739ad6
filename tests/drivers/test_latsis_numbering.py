"""The numbering of a LATSIS line: when it is not trusted, and when it is trusted again."""

import numpy as np
import pytest
from latsis_line import Line, only

from drivers.latsis.line_pass import EXPLAINED_CYCLES, RELEASED_AFTER_CYCLES, RENUMBERED_AFTER_CYCLES
from models.quality import Reason


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
        assert line.quarantined == (number >= RENUMBERED_AFTER_CYCLES)
    alarm = line.alarm
    assert alarm is not None
    assert "line spindle" in alarm
    assert "Restore the chain, or correct `chain`" in alarm
    for number in range(1, RELEASED_AFTER_CYCLES + 1):
        cycle = only(line.one_pass())
        assert (Reason.QUARANTINED in line.reasons(cycle).values()) == (number < RELEASED_AFTER_CYCLES)
    assert line.good(cycle) == line.expected()
    assert line.alarm is None


def test_more_nodes_than_configured_are_quarantined() -> None:
    line = Line()
    line.one_pass()
    for _ in range(RENUMBERED_AFTER_CYCLES):
        cycle = only(line.one_pass((13, *line.ids)))
    assert line.quarantined
    assert "announce 13 sensors" in cycle.faults[0]


def test_sensors_of_another_kind_under_an_id_are_quarantined() -> None:
    line = Line(infrared=[11, 12])
    line.one_pass()
    # The same count, but the chain has been put in backwards.
    backwards = [line.frame(i, 0x3A2B if i <= 2 else 0x190, digits=4 if i <= 2 else 3) for i in line.ids]
    for _ in range(RENUMBERED_AFTER_CYCLES):
        cycle = only(line.send(*backwards) + line.rest())
        assert set(line.reasons(cycle).values()) == {Reason.QUARANTINED}
    assert "another kind of sensor come under the IDs 002h, 001h" in cycle.faults[0]
    assert line.quarantined


def test_lost_bytes_at_the_head_of_the_pass_are_no_renumbering() -> None:
    line = Line(profile="checked")
    line.one_pass()
    for _ in range(10):
        cycle = only(line.send(line.frame(12)[1:], line.frame(11)[:-5], *(line.frame(i) for i in line.ids[2:])))
        line.rest()
        assert line.reasons(cycle) == {12: Reason.NOT_RECEIVED, 11: Reason.NOT_RECEIVED}
    assert not line.quarantined


@pytest.mark.parametrize("profile", ["bare", "checked"])
def test_noise_ahead_of_every_pass_hides_no_renumbering_for_ever(profile: str) -> None:
    line = Line(profile=profile)
    line.one_pass()
    beside = {i: line.codes[i + 1] for i in line.ids[1:]}  # node 1 is dead, and the others have counted anew
    for number in range(EXPLAINED_CYCLES + RENUMBERED_AFTER_CYCLES):
        frames = [line.frame(i, code) for i, code in beside.items()]
        cycle = only(line.send(b"\x00\x81\x13\x42\x55\x10\x22\x99", *frames) + line.rest())
        assert (set(line.reasons(cycle).values()) == {Reason.QUARANTINED}) == (number >= EXPLAINED_CYCLES)
    assert line.quarantined and "sensors where the chain has 12" in cycle.faults[0]
    assert line.alarm is not None and "have been renumbered or the chain is broken" in line.alarm


def test_heads_that_are_lost_now_and_then_are_no_renumbering() -> None:
    line = Line(profile="checked")
    line.one_pass()
    for number in range(3 * EXPLAINED_CYCLES):
        lost = line.frame(12)[1:] if number % EXPLAINED_CYCLES else line.frame(12)
        cycle = only(line.send(lost, *(line.frame(i) for i in line.ids[1:])) + line.rest())
        assert line.good(cycle).items() <= line.expected().items() and len(line.good(cycle)) >= 11
    assert not line.quarantined


def test_a_quarantine_survives_lost_heads_and_ends_only_with_the_expected_count() -> None:
    line = Line()
    line.one_pass()
    for _ in range(RENUMBERED_AFTER_CYCLES):
        line.one_pass(line.ids[1:])
    for _ in range(2 * RELEASED_AFTER_CYCLES):
        line.send(line.frame(12)[1:], *(line.frame(i) for i in line.ids[1:]))
        line.rest()
    assert line.quarantined
