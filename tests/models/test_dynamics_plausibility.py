"""Responses that metal cannot have: wrong units, wrong axes, wrong signs."""

import numpy as np
import pytest

from models.dynamics.beam import Segment
from models.dynamics.bearings import CondensedShaft
from models.dynamics.chain import Chain, SpringDamper, Support
from models.dynamics.measurement import Measurement, MeasurementError
from models.dynamics.plausibility import (
    check_tool_point,
    least_mass_kg,
    moving_mass_kg,
    other_readings,
)

AT_HZ = np.linspace(20.0, 4000.0, 3981)
OMEGA = 2 * np.pi * AT_HZ
MASSES_KG = {700.0: 0.5, 2800.0: 0.04, 300.0: 6.0}


def tool_point(damping: float = 0.02) -> np.ndarray:
    total = np.zeros(len(AT_HZ), dtype=complex)
    for hz, mass in MASSES_KG.items():
        natural = 2 * np.pi * hz
        total += 1 / (mass * (natural**2 - OMEGA**2 + 2j * damping * natural * OMEGA))
    return total


def measured(values: np.ndarray, frequency_hz: np.ndarray = AT_HZ) -> Measurement:
    return Measurement(frequency_hz=frequency_hz, receptance_m_per_n=np.asarray(values, dtype=complex))


@pytest.mark.parametrize("diameter_mm", [6.0, 20.0])
def test_the_least_mass_is_that_of_the_end_of_a_long_cylinder(diameter_mm: float) -> None:
    """Against the exact beam, so damped that its end does not hear the other one."""
    radius, length = diameter_mm / 2e3, 60 * diameter_mm / 1e3
    area, inertia = np.pi * radius**2, np.pi * radius**4 / 4
    rod = Segment(
        length_m=length, mass_kg_per_m=7850 * area, rotary_inertia_kgm=7850 * inertia,
        bending_stiffness_nm2=2.04e11 * inertia, shear_stiffness_n=0.9 * area * 7.9e10, structural_damping=0.02,
    )  # fmt: skip
    held = SpringDamper(kt_n_per_m=1e9, kr_nm_per_rad=1e6)
    chain = Chain(parts=(rod,), supports=(Support(position_m=length, group="5", properties=held),))
    at = np.linspace(1.0, 4000.0, 8000)
    tip = CondensedShaft(chain, at).nose_receptance({"5": held})
    mass = moving_mass_kg(measured(tip, at))
    assert mass == pytest.approx(least_mass_kg(diameter_mm / 1e3, 4000.0), rel=0.15)


@pytest.mark.parametrize(
    ("values", "frequency_hz", "words"),
    [
        (tool_point() * 1e3, AT_HZ, "a mass of 0.038 g moves with the tool point .* is the unit mm/N or um/N"),
        (tool_point() * 1e6, AT_HZ, "moves with the tool point"),
        (tool_point() * 2j * np.pi * AT_HZ, AT_HZ, "positive on balance|moves with the tool point"),
        (tool_point() * (2 * np.pi * AT_HZ) ** 2, AT_HZ, "moves with the tool point .* an accelerance"),
        (tool_point(), AT_HZ / 1e3, "end at 4 Hz, below every resonance of a spindle .* kHz"),
        (tool_point(), AT_HZ * 60, "end at 240000 Hz, where no hammer excites"),
        (tool_point().conj(), AT_HZ, "at the highest peak, 699 Hz, it is .* turn the phase"),
        (-tool_point(), AT_HZ, "turn the phase"),
        (tool_point() * 1e-6, AT_HZ, "stiffer than a carbide cylinder of 10 mm"),
    ],
    ids=["mm/N", "um/N", "mobility", "accelerance", "kHz", "1/min", "conjugate", "sign", "too stiff"],
)
def test_what_no_tool_point_shows_is_refused(values: np.ndarray, frequency_hz: np.ndarray, words: str) -> None:
    with pytest.raises(MeasurementError, match=words):
        check_tool_point(measured(values, frequency_hz), 0.01)


@pytest.mark.parametrize("diameter_m", [0.001, 0.01, 0.08])
@pytest.mark.parametrize("phase", [-0.05, 0.0, 0.05])
def test_a_tool_point_passes_with_noise_and_with_a_phase_that_is_a_little_off(diameter_m: float, phase: float) -> None:
    random = np.random.default_rng(7)
    noise = 1 + 0.1 * (random.standard_normal(len(AT_HZ)) + 1j * random.standard_normal(len(AT_HZ)))
    check_tool_point(measured(tool_point() * noise * np.exp(1j * phase)), diameter_m)


def test_every_other_reading_of_numbers_in_that_unit_is_the_response() -> None:
    right = measured(tool_point())
    j_omega = 2j * np.pi * AT_HZ
    written = {
        "in mm/N": (AT_HZ, 1e3 * tool_point()),
        "in um/N": (AT_HZ, 1e6 * tool_point()),
        "in m/kN": (AT_HZ, 1e-3 * tool_point()),
        "of a mobility in m/s per N": (AT_HZ, tool_point() * j_omega),
        "of a mobility in mm/s per N": (AT_HZ, tool_point() * j_omega * 1e3),
        "of an accelerance in m/s^2 per N": (AT_HZ, tool_point() * j_omega**2),
        "of an accelerance in g per N": (AT_HZ, tool_point() * j_omega**2 / 9.80665),
        "over kHz": (AT_HZ / 1e3, tool_point()),
        "over rad/s": (AT_HZ * 2 * np.pi, tool_point()),
        "over 1/min": (AT_HZ * 60, tool_point()),
    }
    assert {what for what, _ in other_readings(right)} == set(written)
    for told, (frequency_hz, values) in written.items():
        read = dict(other_readings(measured(values, frequency_hz)))[told]
        assert read.frequency_hz == pytest.approx(right.frequency_hz), told
        assert read.receptance_m_per_n == pytest.approx(right.receptance_m_per_n), told
