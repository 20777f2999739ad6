"""Modes from a receptance: exact on exact samples, close on noisy ones, refused where there are none."""

import numpy as np
import pytest

from models.errors import StabilityError
from models.stability.frf_modal_fit import fit_modes
from models.stability.response import modal_receptance, mode_from_residue, mode_from_stiffness

LINES_HZ = np.arange(384, 3201) * 12800 / 16384
THREE = (
    mode_from_stiffness(664.0, 0.03, 6e6),
    mode_from_residue(760.0, 0.02, 1e-6 - 3e-6j),
    mode_from_stiffness(1500.0, 0.02, 2e7),
)


@pytest.mark.parametrize(
    "outside", [(), (mode_from_stiffness(150.0, 0.05, 6e7), mode_from_stiffness(4000.0, 0.02, 2e7))]
)
def test_exact_samples_give_the_modes_back(outside: tuple) -> None:
    modes = tuple(sorted((*THREE, *outside), key=lambda mode: mode.frequency_hz))
    fit = fit_modes(LINES_HZ, modal_receptance(modes, LINES_HZ))
    assert fit.relative_residual < 1e-9
    assert len(fit.modes) == len(modes)
    for found, expected in zip(fit.modes, modes, strict=True):
        assert found.frequency_hz == pytest.approx(expected.frequency_hz, rel=1e-6)
        assert found.damping_ratio == pytest.approx(expected.damping_ratio, rel=1e-5)
        assert found.displacement_gain_per_kg == pytest.approx(expected.displacement_gain_per_kg, rel=1e-4)


def test_noise_moves_the_modes_little_and_adds_no_spikes() -> None:
    exact = modal_receptance(THREE, LINES_HZ)
    rng = np.random.default_rng(4)
    noise = rng.normal(size=exact.shape) + 1j * rng.normal(size=exact.shape)
    fit = fit_modes(LINES_HZ, exact + 0.005 * np.abs(exact).max() * noise)
    fine_hz = np.linspace(LINES_HZ[0], LINES_HZ[-1], 40_000)
    difference = modal_receptance(fit.modes, fine_hz) - modal_receptance(THREE, fine_hz)
    assert np.abs(difference).max() < 0.05 * np.abs(exact).max()
    strongest = max(fit.modes, key=lambda mode: abs(modal_receptance((mode,), np.array([mode.frequency_hz])))[0])
    assert strongest.frequency_hz == pytest.approx(664.0, abs=100.0)


def test_what_is_no_sum_of_modes_is_refused() -> None:
    rng = np.random.default_rng(5)
    noise = 1e-8 * (rng.normal(size=LINES_HZ.shape) + 1j * rng.normal(size=LINES_HZ.shape))
    with pytest.raises(StabilityError, match="coherence"):
        fit_modes(LINES_HZ, noise)
    with pytest.raises(StabilityError, match="too short"):
        fit_modes(LINES_HZ[:10], noise[:10])
