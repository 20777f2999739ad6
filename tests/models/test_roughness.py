"""Roughness of profiles whose values are known."""

import numpy as np
import pytest

from models.stability.roughness import profile_roughness, roughness_per_depth

POSITION_MM = np.arange(5451) * 0.032e-1


def test_a_sine_on_a_slope() -> None:
    height = 3.0 * np.sin(2.0 * np.pi * POSITION_MM / 0.1) + 0.5 * POSITION_MM
    found = profile_roughness(POSITION_MM, height)
    assert found.ra_um == pytest.approx(3.0 * 2.0 / np.pi, rel=0.01)
    assert found.rq_um == pytest.approx(3.0 / np.sqrt(2.0), rel=0.01)
    assert found.rz_um == pytest.approx(6.0, rel=0.02)


def test_each_depth_has_its_own() -> None:
    depth = np.repeat([4.0, 6.0], 200)
    position = np.tile(np.arange(200) * 0.01, 2)
    height = np.where(depth == 4.0, 1.0, 5.0) * np.sin(position * 40.0)
    found = roughness_per_depth(depth, position, height)
    assert list(found) == [4.0, 6.0]
    assert found[6.0].ra_um == pytest.approx(5.0 * found[4.0].ra_um)


def test_the_cut_off_passes_half_of_its_own_wavelength_and_all_of_what_is_fine() -> None:
    waves = np.sin(2.0 * np.pi * POSITION_MM / 0.8)
    fine = 0.2 * np.sin(2.0 * np.pi * POSITION_MM / 0.05)
    assert profile_roughness(POSITION_MM, waves, 0.8).rq_um == pytest.approx(0.5 / np.sqrt(2.0), rel=0.05)
    assert profile_roughness(POSITION_MM, fine, 0.8).rq_um == pytest.approx(0.2 / np.sqrt(2.0), rel=0.02)


def test_a_cut_off_may_be_half_of_the_profile() -> None:
    """As its refusal says; 2 mm of 4 mm were a defect."""
    position_mm = np.arange(800) * 0.005
    found = profile_roughness(position_mm, 5.0 * np.sin(2.0 * np.pi * position_mm / 0.1), 2.0)
    assert found.points == 400 and found.ra_um == pytest.approx(10.0 / np.pi, rel=0.01)
