"""What holds a tool, from impacts on a blank: exact without noise, told with noise, and what is refused."""

import numpy as np
import pytest
from blank_in_holder import BLANK, HZ, SECOND_M, TOOL, blank_test, cylinder, holder_on_spindle, noisy, tip

from models.dynamics.assembly import SpindleAssembly
from models.dynamics.beam import ComplexArray
from models.dynamics.inverse_coupling import held_stiffness, tool_point_receptance
from models.dynamics.local_rational import smoothed
from models.errors import IdentificationError


@pytest.fixture(scope="module")
def holder() -> SpindleAssembly:
    return holder_on_spindle()


@pytest.fixture(scope="module")
def measured(holder: SpindleAssembly) -> ComplexArray:
    return blank_test(holder)


def test_another_tool_has_the_response_that_the_whole_chain_gives(holder, measured):
    predicted = tool_point_receptance(TOOL, held_stiffness(BLANK, SECOND_M, HZ, measured), HZ)
    true = tip(holder, TOOL)
    assert np.max(np.abs(predicted - true) / np.abs(true)) < 1e-5  # what two springs leave of ten digits


def test_the_blank_itself_comes_back(holder, measured):
    predicted = tool_point_receptance((BLANK,), held_stiffness(BLANK, SECOND_M, HZ, measured), HZ)
    assert predicted == pytest.approx(measured[0], rel=1e-6)


def test_of_noise_little_reaches_the_tool(holder, measured):
    true = tip(holder, TOOL)
    peak = int(np.argmax(np.abs(true)))
    for seed in range(4):
        raw = noisy(measured, 0.01, seed)
        clean = smoothed(raw)
        assert clean.noise == pytest.approx(0.01, rel=0.35)
        bare, found = (
            tool_point_receptance(TOOL, held_stiffness(BLANK, SECOND_M, HZ, values), HZ)
            for values in (raw, clean.responses)
        )
        error, without = (np.median(np.abs(each / true - 1.0)) for each in (found, bare))
        assert error < 0.02 and error < 0.5 * without
        at = int(np.argmax(np.abs(found)))
        assert abs(HZ[at] - HZ[peak]) <= 0.005 * HZ[peak]
        assert np.abs(found[at]) == pytest.approx(np.abs(true[peak]), rel=0.25)


def test_smoothing_does_not_bend_what_has_no_noise(measured):
    clean = smoothed(measured)
    assert np.max(np.abs(clean.responses / measured - 1.0)) < 1e-3


def test_too_few_lines_stay_as_they_are(measured):
    clean = smoothed(measured[:, :8])
    assert clean.half_width == 0 and np.isnan(clean.noise) and np.array_equal(clean.responses, measured[:, :8])


@pytest.mark.parametrize("second_m", [0.0, 0.07, 0.1, -0.01])
def test_a_point_outside_the_blank_is_refused(measured, second_m):
    with pytest.raises(IdentificationError, match="lies outside the blank of 70 mm"):
        held_stiffness(BLANK, second_m, HZ, measured)


def test_two_responses_are_not_enough(measured):
    with pytest.raises(IdentificationError, match="three responses"):
        held_stiffness(BLANK, SECOND_M, HZ, measured[:2])


def test_a_clamped_blank_is_held_by_nothing_that_moves():
    """The first frequency of a cantilever is 1.8751^2 / (2 pi L^2) sqrt(EI / (rho A))."""
    rigid = np.zeros((3, len(HZ)), dtype=np.complex128)
    rigid[0], rigid[2] = 1e15, 1e12
    slender = cylinder(0.1, 0.004)
    found = tool_point_receptance((slender,), rigid, HZ)
    bending, mass = slender.bending_stiffness_nm2, slender.mass_kg_per_m
    first_hz = 1.8751**2 / (2.0 * np.pi * slender.length_m**2) * np.sqrt(bending / mass)
    assert HZ[int(np.argmax(np.abs(found[: len(HZ) // 4])))] == pytest.approx(first_hz, rel=0.01)
