"""The script of a fault campaign: every kind in the first day, the same for the same seed, within the machine."""

from pathlib import Path

import pytest

from config.loader import load_configuration
from config.machines import shipped_file
from daemon.simulation.faults.script import HABITS, Incident, campaign
from drivers.sim.faults import FaultKind

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
