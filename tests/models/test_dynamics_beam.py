"""Exact segments against closed forms that are solved here, by other means."""

from dataclasses import replace

import numpy as np
import pytest
from modal_sum import modal_sum_receptance
from receptance_coupling import segment_receptance
from scipy.linalg import expm
from scipy.optimize import brentq

from models.dynamics.beam import Segment, segment_span, transfer_matrix
from models.dynamics.chain import Chain, SpringDamper, Support
from models.dynamics.modes import natural_frequencies, rigid_body_modes, segment_matrix
from models.dynamics.section import Elasticity, Tube, beam_segment

STEEL = Elasticity(young_pa=200e9, shear_pa=76.9e9, poisson=0.3, density_kg_per_m3=7850.0)
SHEAR_SOFT = Elasticity(young_pa=214e9, shear_pa=7.2e9, poisson=0.12, density_kg_per_m3=2300.0)


def tube(length_mm: float, outer_mm: float, inner_mm: float, elasticity: Elasticity = STEEL) -> Segment:
    section = Tube(outer_m=outer_mm / 1e3, inner_m=inner_mm / 1e3, elasticity=elasticity)
    return beam_segment(length_mm / 1e3, (section,), structural_damping=0.003)


def closed_form_frequencies(segment: Segment, count: int) -> list[float]:
    """Return the free-free natural frequencies from the four boundary conditions on complex exponentials."""
    mass, turning = segment.mass_kg_per_m, segment.rotary_inertia_kgm
    shear, bending, length = segment.shear_stiffness_n, segment.bending_stiffness_nm2, segment.length_m

    def determinant(frequency_hz: float, even: bool) -> float:
        """Return what vanishes for a mode that is even (or odd) about the middle; real beyond the cut-off, too."""
        w2 = (2 * np.pi * frequency_hz) ** 2
        slip = w2 * mass / shear
        squares = np.roots([1.0, slip + w2 * turning / bending, w2 * mass / bending * (w2 * turning / shear - 1.0)])
        rows = []
        for square in sorted(squares):
            k = np.sqrt(complex(square))
            cosh, sinh = (f(k * length / 2) * np.exp(-abs(k.real) * length / 2) for f in (np.cosh, np.sinh))
            # y is cosh(k z) / k^2 or sinh(k z) / k; shear and curvature at the end, times k^2, stay finite at k = 0
            shear_angle, curvature = (sinh / k, cosh) if even else (cosh, k * sinh)
            rows.append((float((shear_angle * slip).real), float((curvature * (k**2 + slip)).real)))
        (a, b), (c, d) = rows
        return a * d - b * c

    grid = np.geomspace(50.0, 4e5, 3000)
    found = []
    for even in (True, False):
        values = [determinant(f, even) for f in grid]
        for low, high, v_low, v_high in zip(grid, grid[1:], values, values[1:], strict=False):
            if v_low * v_high < 0.0:
                found.append(brentq(determinant, low, high, args=(even,), xtol=1e-12, rtol=1e-14))
    return sorted(found)[:count]


@pytest.mark.parametrize(
    "segment",
    [tube(500, 50, 0), tube(501.1, 60, 28, SHEAR_SOFT), tube(133, 53, 32.3), tube(40, 10, 0), tube(20, 89, 42.4)],
    ids=["slender", "soft in shear", "thick", "tool", "short"],
)
def test_uniform_beam_against_the_frequency_equation(segment: Segment) -> None:
    expected = closed_form_frequencies(segment, 6)
    found = natural_frequencies(Chain(parts=(segment,)), 6, search_end_hz=1e7)
    assert found == pytest.approx(expected, rel=1e-8)
    assert rigid_body_modes(Chain(parts=(segment,))) == 2


@pytest.mark.parametrize("length_mm", [2.9, 0.05, 500.0])
def test_dividing_a_beam_changes_nothing(length_mm: float) -> None:
    whole = tube(501.1, 60, 28)
    if length_mm == 500.0:
        pieces = [whole.cut(whole.length_m / 60)] * 60
    else:
        pieces = [whole.cut(0.1), whole.cut(length_mm / 1e3), whole.cut(whole.length_m - 0.1 - length_mm / 1e3)]
    found = natural_frequencies(Chain(parts=tuple(pieces)), 8)
    assert found == pytest.approx(natural_frequencies(Chain(parts=(whole,)), 8), rel=1e-9)


@pytest.mark.parametrize("frequency_hz", [1.0, 3000.0, 4e4])
def test_transfer_matrix_is_the_exponential_of_the_state_matrix(frequency_hz: float) -> None:
    segment = Segment(length_m=0.01, mass_kg_per_m=22.0, rotary_inertia_kgm=5e-3, bending_stiffness_nm2=1.3e5,
                      shear_stiffness_n=1.9e8, axial_load_n=2e6)  # fmt: skip
    transfer = transfer_matrix(segment, np.array([frequency_hz]), 0.01)
    w2, factor = (2 * np.pi * frequency_hz) ** 2, 1 + 0.01j
    shear, bending, load = 1.9e8 * factor, 1.3e5 * factor, 2e6
    # y' = theta + shear strain; the strain follows from T = shear strain - load y'
    slope = np.array([0, shear, 1, 0]) / (shear - load)
    shear_force = shear * (slope - np.array([0, 1, 0, 0]))
    state = np.array([slope, [0, 0, 0, 1 / bending], [-22.0 * w2, 0, 0, 0], -shear_force - [0, 5e-3 * w2, 0, 0]])
    rows = [[[entry[0] for entry in row] for row in block] for block in transfer]
    found = np.block([[np.array(rows[0]), np.array(rows[1])], [np.array(rows[2]), np.array(rows[3])]])
    assert found == pytest.approx(expm(state * 0.01), rel=1e-9)


def test_axial_load_shifts_a_pinned_beam_as_euler_says() -> None:
    free = tube(1000, 10, 0)
    pin = SpringDamper(kt_n_per_m=1e13)
    pins = (
        Support(position_m=0.0, group="12", properties=pin),
        Support(position_m=free.length_m, group="5", properties=pin),
    )
    buckling_n = np.pi**2 * free.bending_stiffness_nm2 / free.length_m**2
    base, compressed, stretched = (
        natural_frequencies(Chain(parts=(replace(free, axial_load_n=part * buckling_n),), supports=pins), 1)[0]
        for part in (0.0, 0.5, -1.0)
    )
    assert (compressed / base) ** 2 == pytest.approx(0.5, rel=1e-3)
    assert (stretched / base) ** 2 == pytest.approx(2.0, rel=1e-3)


def test_published_inertia_leaves_the_free_modes_and_overstates_the_rotation() -> None:
    segment = tube(11.0, 89, 40.3)
    printed = replace(segment, rigid_rotary_inertia="published")
    at = np.array([500.0])
    correct, published = (segment_receptance(each, at, [0.0, 0.011])[0, 1, 1].real for each in (segment, printed))
    assert published / correct == pytest.approx(1 + 12 * segment.rotary_inertia_kgm / segment.mass_kg_per_m / 0.011**2,
                                                rel=1e-3)  # fmt: skip
    span, _ = segment_span(printed, at, damped=True)
    whole = segment_matrix(printed, 500.0, [0.0, 0.011], damped=True)
    assert span.front[0, 0] == pytest.approx(whole[0, 0], rel=1e-6)
    assert span.cross[1, 0] == pytest.approx(whole[0, 3], rel=1e-6)
    assert natural_frequencies(Chain(parts=(printed,)), 2, 1e7) == pytest.approx(
        natural_frequencies(Chain(parts=(segment,)), 2, 1e7), rel=1e-9
    )


def test_modal_sum_with_the_printed_rotation_has_the_published_receptance() -> None:
    segment = replace(tube(133, 53, 32.3), rigid_rotary_inertia="published")
    at = np.array([600.0])
    exact = segment_receptance(segment, at, [0.0, 0.133])[0]
    assert modal_sum_receptance(segment, at, 0.0, 0.133, 12)[0] == pytest.approx(exact[2:, :2], rel=0.01)
    wrong = segment_receptance(segment.as_correct(), at, [0.0, 0.133])[0]
    assert abs(wrong[3, 1] / exact[3, 1] - 1.0) > 0.1


def test_modal_sum_converges_to_the_exact_receptance_like_one_over_n() -> None:
    segment = tube(133, 53, 32.3)
    at = np.array([2500.0])
    exact = segment_receptance(segment, at, [0.0, 0.05, 0.133])[0]
    errors = []
    for count in (5, 10, 20, 40):
        drive = modal_sum_receptance(segment, at, 0.0, 0.0, count)[0]
        errors.append(abs(drive[0, 0] - exact[0, 0]) / abs(exact[0, 0]))
        transfer = modal_sum_receptance(segment, at, 0.0, 0.05, count)[0]
    assert errors[0] > errors[1] > errors[2] > errors[3]
    assert 1.6 < errors[2] / errors[3] < 2.6
    assert transfer == pytest.approx(exact[2:4, 0:2], rel=0.02)


@pytest.mark.parametrize("wrong", [{"length_m": 0.0}, {"shear_stiffness_n": -1.0}, {"mass_kg_per_m": float("nan")}])
def test_impossible_segments_are_refused(wrong: dict[str, float]) -> None:
    good = {"length_m": 0.1, "mass_kg_per_m": 1.0, "rotary_inertia_kgm": 1e-4, "bending_stiffness_nm2": 1e4,
            "shear_stiffness_n": 1e7}  # fmt: skip
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Segment(**{**good, **wrong})
