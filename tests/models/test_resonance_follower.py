"""The resonance that is followed while the properties of the bearings change."""

from collections.abc import Mapping

import numpy as np
import pytest

from config.machine.spindle import spindle_folder
from config.machine.spindle_chain import read_spindle
from models.dynamics.assembly import CondensedAssembly
from models.dynamics.bearings import properties_from_parameters
from models.dynamics.identification import FIXED
from models.thermomechanics.resonance import ResonanceFollower, band, peaks

TYPICAL = {"ct_12": 300.0, "kr_12": 3e6, "kt_34": 1e8, "kt_5": 5e7, "ct_5": 800.0}
FREQUENCY_HZ = 300.0 + 1.5625 * np.arange(640)


def two_modes(parameters: Mapping[str, float]) -> np.ndarray:
    """Return two modes; `hz` moves the first, which makes the second the higher one."""
    s = 2j * np.pi * FREQUENCY_HZ
    total = np.zeros(len(s), dtype=np.complex128)
    lower = parameters["hz"]
    for hz, mass in ((lower, 1.0 + 0.05 * abs(lower - 500.0)), (900.0, 1.0)):
        w = 2.0 * np.pi * hz
        total += 1.0 / (mass * (s**2 + 2.0 * 0.01 * w * s + w**2))
    return total


def test_the_mode_is_followed_when_another_becomes_the_highest() -> None:
    follower = ResonanceFollower(FREQUENCY_HZ, two_modes, {"hz": 500.0})
    assert follower.resonance.frequency_hz == pytest.approx(500.0, abs=1.0)
    found = follower.follow({"hz": 650.0})
    highest = max(peaks(FREQUENCY_HZ, two_modes({"hz": 650.0})), key=lambda peak: peak.magnitude_m_per_n)
    assert highest.frequency_hz == pytest.approx(900.0, abs=1.0)
    assert found.continuous
    assert found.frequency_hz == pytest.approx(650.0, abs=2.0)
    assert follower.follow({"hz": 500.0}).frequency_hz == pytest.approx(500.0, abs=1.0)


def approaching_modes(parameters: Mapping[str, float]) -> np.ndarray:
    """Return two modes 45 Hz apart that both grow with the root of `kt`."""
    s = 2j * np.pi * FREQUENCY_HZ
    total = np.zeros(len(s), dtype=np.complex128)
    for hz in (580.0, 640.0):
        w = 2.0 * np.pi * hz * np.sqrt(parameters["kt"])
        total += 1.0 / (s**2 + 2.0 * 0.008 * w * s + w**2)
    return total


@pytest.mark.parametrize("factor", [0.8, 1.17, 1.21, 1.3])
def test_a_jump_onto_the_place_of_another_mode_does_not_deceive(factor: float) -> None:
    """At a factor of 1.21 the lower mode stands where the upper one was (638 of 640 Hz)."""
    follower = ResonanceFollower(FREQUENCY_HZ, approaching_modes, {"kt": 1.0}, 640.0)
    found = follower.follow({"kt": factor})
    assert found.continuous
    assert found.frequency_hz == pytest.approx(640.0 * np.sqrt(factor), abs=3.0)


def test_a_mode_that_leaves_the_band_is_lost_and_found_again() -> None:
    follower = ResonanceFollower(FREQUENCY_HZ, two_modes, {"hz": 500.0})
    assert not follower.follow({"hz": 150.0}).continuous
    back = follower.follow({"hz": 520.0})
    assert back.continuous
    assert back.frequency_hz == pytest.approx(520.0, abs=1.0)


def test_steps_looked_at_together_lead_where_single_ones_lead() -> None:
    """Nothing outside the band that is looked at decides, and the steps of a jump are computed at once."""
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    condensed = CondensedAssembly(spindle.assembly("tool"), FREQUENCY_HZ)

    def receptance(parameters: Mapping[str, float]) -> np.ndarray:
        return condensed.receptance(properties_from_parameters(parameters))

    def together(columns: Mapping[str, np.ndarray], low_hz: float, high_hz: float) -> tuple[np.ndarray, np.ndarray]:
        lines = band(FREQUENCY_HZ, low_hz, high_hz)
        return FREQUENCY_HZ[lines], condensed.receptances(columns, lines)

    start = {**FIXED[5], **TYPICAL}
    far = {**start, "kt_34": 2.1 * start["kt_34"], "kt_5": 0.4 * start["kt_5"], "ct_12": 5.0 * start["ct_12"]}
    single = ResonanceFollower(FREQUENCY_HZ, receptance, start)
    several = ResonanceFollower(FREQUENCY_HZ, receptance, start, on_the_way=together)
    whole = ResonanceFollower(
        FREQUENCY_HZ, receptance, start, on_the_way=lambda columns, low, high: together(columns, 0.0, np.inf)
    )
    for there in (far, start, {**far, "kt_5": 3e8}):
        expected = single.follow(there)
        for found in (several.follow(there), whole.follow(there)):
            assert found.continuous == expected.continuous
            assert found.frequency_hz == pytest.approx(expected.frequency_hz, abs=1e-6)
