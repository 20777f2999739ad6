"""Likeness of shapes, and how modes change with the moduli."""

from dataclasses import replace

import numpy as np
import pytest

from models.dynamics.beam import Segment
from models.dynamics.chain import Chain
from models.dynamics.modes import modal_assurance, mode_changes, modes
from models.dynamics.section import Elasticity, Tube, beam_segment

STEEL = Elasticity(young_pa=200e9, shear_pa=76.9e9, poisson=0.3, density_kg_per_m3=7850.0)


def free_tube() -> Segment:
    tube = Tube(outer_m=0.06, inner_m=0.02, elasticity=STEEL)
    return beam_segment(length_m=0.5, tubes=(tube,))


def test_a_shape_is_like_itself_whatever_its_size_and_phase() -> None:
    """As printed, without conjugates, 4-39 gives a complex shape and its turned self less or more than 1."""
    shape = np.array([1.0 + 0.2j, 0.4 - 0.7j, -0.9 + 0.1j])
    assert modal_assurance(shape, (0.3 - 2.0j) * shape) == pytest.approx(1.0)
    printed = abs(np.sum(shape * shape)) ** 2 / abs(np.sum(shape**2) * np.sum(np.abs(shape) ** 2))
    assert printed < 0.9


def test_the_likeness_of_two_real_shapes_is_the_squared_cosine_between_them() -> None:
    assert modal_assurance(np.array([1.0, 0.0]), np.array([1.0, 1.0])) == pytest.approx(0.5)
    assert modal_assurance(np.array([1.0, 2.0]), np.array([-2.0, 1.0])) == pytest.approx(0.0)


@pytest.mark.parametrize(("second", "words"), [([0.0, 0.0], "zero everywhere"), ([1.0, 2.0, 3.0], "same points")])
def test_what_cannot_be_compared_is_refused(second: list[float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        modal_assurance(np.array([1.0, 2.0]), np.array(second))


def test_moduli_that_are_5_percent_higher_raise_every_mode_by_the_root_of_that() -> None:
    base = free_tube()
    stiffer = replace(
        base,
        bending_stiffness_nm2=1.05 * base.bending_stiffness_nm2,
        shear_stiffness_n=1.05 * base.shear_stiffness_n,
    )
    found = mode_changes(modes(Chain(parts=(base,)), 3), modes(Chain(parts=(stiffer,)), 3))
    assert len(found) == 3
    for change in found:
        assert change.change_percent == pytest.approx(100.0 * (1.05**0.5 - 1.0), rel=1e-6)
        assert change.mac == pytest.approx(1.0, abs=1e-9)
