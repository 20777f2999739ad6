"""What holds a tool, from impacts on a blank: exact without noise, told with noise, and what is refused."""

import numpy as np
import pytest
from blank_in_holder import BLANK, HZ, SECOND_M, TOOL, blank_test, holder_on_spindle, noisy, tip

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


@pytest.mark.parametrize("second_m", [0.0, 0.07, 0.1, -0.01])
def test_a_point_outside_the_blank_is_refused(measured, second_m):
    with pytest.raises(IdentificationError, match="lies outside the blank of 70 mm"):
        held_stiffness(BLANK, second_m, HZ, measured)


@pytest.mark.parametrize("seed", range(8))
def test_flat_responses_stay_as_they_are(seed):
    """Exported with few digits, responses stand still over many lines: the fit was singular, or off by factors."""
    values = np.random.default_rng(seed).normal(size=(2, 3)) * 1e-8
    flat = np.repeat((values[0] + 1j * values[1])[:, None], 60, axis=1)
    assert smoothed(flat).responses == pytest.approx(flat, rel=1e-9)
