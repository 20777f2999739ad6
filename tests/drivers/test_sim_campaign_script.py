"""The script of a fault campaign: every kind in the first day, the same for the same seed, within the machine."""

from pathlib import Path

import pytest

from config.loader import load_configuration
from config.machines import shipped_file
from daemon.simulation.faults.script import DAY_S, HABITS, ON_LINES, Happening, Incident, campaign, wire_faults
from drivers.sim.faults import FaultKind, check_targets
from drivers.sim.nc.program import campaign_program

CONFIGURATION = load_configuration(Path(shipped_file("cfrpmt.yaml")))
LINES = CONFIGURATION.temperatures.lines


@pytest.mark.parametrize("seed", range(5))
def test_every_kind_comes_within_the_first_day(seed: int) -> None:
    first = {happening.kind for happening in campaign(1.0, seed, LINES)}
    assert first == set(HABITS) == {*FaultKind, *Incident}


def test_the_same_seed_gives_the_same_script_and_another_gives_another() -> None:
    assert campaign(3.0, 7, LINES) == campaign(3.0, 7, LINES)
    assert campaign(3.0, 7, LINES) != campaign(3.0, 8, LINES)


def test_a_short_campaign_brings_other_kinds_with_every_seed() -> None:
    assert campaign(0.2, 7, LINES) == campaign(0.2, 7, LINES)
    kinds = [{happening.kind for happening in campaign(0.2, seed, LINES)} for seed in range(40)]
    assert set.union(*kinds) >= set(HABITS) - {Incident.WRONG_SENSOR}, "that one comes last, and lasts for an hour"
    assert all(len(each) > 8 for each in kinds)


def test_everything_ends_before_the_campaign_does_and_comes_in_order() -> None:
    happenings = campaign(4.0, 3, LINES)
    assert all(happening.end_s < 4.0 * DAY_S for happening in happenings)
    assert [h.at_s for h in happenings] == sorted(h.at_s for h in happenings)
    later = [h for h in happenings if h.at_s > DAY_S]
    assert len(later) > 3 * 20, "by chance, some forty a day"


def test_the_faults_on_the_wires_are_ones_that_this_machine_can_have() -> None:
    for seed in range(5):
        faults = wire_faults(campaign(10.0, seed, LINES), LINES)
        check_targets(faults, CONFIGURATION)
        assert {fault.kind for fault in faults} == set(FaultKind)


def test_a_blinded_machine_has_every_line_dead() -> None:
    faults = wire_faults([Happening(kind=Incident.BLIND, at_s=5.0, duration_s=9.0)], LINES)
    assert {(fault.kind, fault.target, fault.amount) for fault in faults} == {
        (FaultKind.DEAD_LINE, line.name, 0.0) for line in LINES
    }


def test_clock_steps_and_drifts_go_both_ways() -> None:
    happenings = campaign(60.0, 1, LINES)
    for kind in (Incident.CLOCK_STEP, FaultKind.DRIFTING_SENSOR):
        amounts = [happening.amount for happening in happenings if happening.kind is kind]
        assert min(amounts) < 0 < max(amounts)


def test_line_faults_name_a_line() -> None:
    names = {line.name for line in LINES}
    assert all(h.target in names for h in campaign(5.0, 2, LINES) if h.kind in ON_LINES)


def test_a_shift_fills_the_day() -> None:
    _, *day = campaign_program().blocks
    assert sum(block.duration_s for block in day) == pytest.approx(DAY_S)
