"""Coupling against the standard formula of LM-FBS, against each other, and the condensed shaft against both."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from receptance_coupling import (
    couple_elastic,
    couple_rigid,
    couple_sideways,
    ground,
    ground_stiffness,
    segment_receptance,
)

from models.dynamics.assembly import CondensedAssembly, SpindleAssembly
from models.dynamics.beam import Segment
from models.dynamics.bearings import (
    PARAMETERS,
    CondensedShaft,
    inverse_rows,
    parameters_from_properties,
    properties_from_parameters,
)
from models.dynamics.chain import Chain, SpringDamper, Support
from models.dynamics.modes import (
    dense_stiffness,
    natural_frequencies,
)
from models.dynamics.section import Elasticity, Tube, beam_segment

ComplexArray = npt.NDArray[np.complex128]
STEEL = Elasticity(young_pa=200e9, shear_pa=76.9e9, poisson=0.3, density_kg_per_m3=7850.0)
FREQUENCY_HZ = np.array([80.0, 700.0, 1234.5, 2500.0])
JOINT = SpringDamper(kt_n_per_m=1.25e8, ct_ns_per_m=3.6e3, kr_nm_per_rad=8.6e5, cr_nms_per_rad=2.4e3)
PROPERTIES = {
    "12": SpringDamper(kt_n_per_m=5.11e7, ct_ns_per_m=198.0, kr_nm_per_rad=2.96e5, cr_nms_per_rad=0.0338),
    "34": SpringDamper(kt_n_per_m=2.68e8, ct_ns_per_m=9.15e4, kr_nm_per_rad=3.66e5, cr_nms_per_rad=2e-6),
    "5": SpringDamper(kt_n_per_m=1.5e8, ct_ns_per_m=3e-5, kr_nm_per_rad=6.56e5, cr_nms_per_rad=2e-6),
}
PLACES = (("12", 0.0991), ("12", 0.1271), ("34", 0.1841), ("34", 0.2111), ("5", 0.4371))


def tube(length_mm: float, outer_mm: float, inner_mm: float = 0.0) -> Segment:
    section = Tube(outer_m=outer_mm / 1e3, inner_m=inner_mm / 1e3, elasticity=STEEL)
    return beam_segment(length_mm / 1e3, (section,), structural_damping=0.003)


def shaft(properties: dict[str, SpringDamper] = PROPERTIES) -> Chain:
    supports = tuple(Support(position_m=m, group=group, properties=properties[group]) for group, m in PLACES)
    return Chain(
        parts=(tube(89.1, 89, 38), tube(165, 60, 28), tube(154, 95, 32.3), tube(93, 45, 33)), supports=supports
    )


def lm_fbs(substructures: list[ComplexArray], boolean: npt.NDArray[np.float64], joint: ComplexArray) -> ComplexArray:
    """Return Y - Y B^T (B Y B^T + K^-1)^-1 B Y, the dual form of de Klerk and others, K^-1 zero when rigid."""
    size = sum(len(matrix) for matrix in substructures)
    whole = np.zeros((size, size), dtype=complex)
    first = 0
    for matrix in substructures:
        whole[first : first + len(matrix), first : first + len(matrix)] = matrix
        first += len(matrix)
    gap = boolean @ whole @ boolean.T + joint
    return whole - whole @ boolean.T @ np.linalg.inv(gap) @ boolean @ whole


def gap_between(first: int, second: int) -> npt.NDArray[np.float64]:
    boolean = np.zeros((2, first + second))
    boolean[0, first - 2] = boolean[1, first - 1] = 1.0
    boolean[0, first] = boolean[1, first + 1] = -1.0
    return boolean


@pytest.fixture
def pair() -> tuple[ComplexArray, ComplexArray]:
    return (
        segment_receptance(tube(120, 60, 20), FREQUENCY_HZ, [0.0, 0.03, 0.12]),
        segment_receptance(tube(45, 42), FREQUENCY_HZ, [0.0, 0.0029, 0.02, 0.045]),
    )


def test_rigid_coupling_against_lm_fbs(pair: tuple[ComplexArray, ComplexArray]) -> None:
    first, second = pair
    found = couple_rigid(first, second)
    kept = [*range(6), *range(8, 14)]
    for index in range(len(FREQUENCY_HZ)):
        expected = lm_fbs([first[index], second[index]], gap_between(6, 8), np.zeros((2, 2)))[np.ix_(kept, kept)]
        assert found[index] == pytest.approx(expected, rel=1e-9, abs=1e-9 * abs(expected).max() * 1e-3)


def test_elastic_coupling_against_lm_fbs(pair: tuple[ComplexArray, ComplexArray]) -> None:
    first, second = pair
    found = couple_elastic(first, second, JOINT, FREQUENCY_HZ)
    for index, at in enumerate(FREQUENCY_HZ):
        omega = 2 * np.pi * at
        soft = np.diag([1 / (1.25e8 + 1j * omega * 3.6e3), 1 / (8.6e5 + 1j * omega * 2.4e3)])
        expected = lm_fbs([first[index], second[index]], gap_between(6, 8), soft)
        assert found[index] == pytest.approx(expected, rel=1e-9, abs=1e-9 * abs(expected).max() * 1e-3)


def test_sideways_coupling_against_lm_fbs() -> None:
    places = [0.0, 0.03, 0.12]
    inner = segment_receptance(tube(120, 60, 20), FREQUENCY_HZ, places)
    outer = segment_receptance(tube(120, 75, 60), FREQUENCY_HZ, places)
    found = couple_sideways(inner, outer)
    boolean = np.hstack([np.eye(6), -np.eye(6)])
    for index in range(len(FREQUENCY_HZ)):
        whole = lm_fbs([inner[index], outer[index]], boolean, np.zeros((6, 6)))
        assert found[index] == pytest.approx(whole[:6, :6], rel=1e-9, abs=1e-9 * abs(whole).max() * 1e-3)


def test_grounding_against_lm_fbs(pair: tuple[ComplexArray, ComplexArray]) -> None:
    free = pair[0]
    found = ground(free, ground_stiffness([None, JOINT, PROPERTIES["12"]], FREQUENCY_HZ))
    for index, at in enumerate(FREQUENCY_HZ):
        omega = 2 * np.pi * at
        soft = np.diag([1 / (1.25e8 + 1j * omega * 3.6e3), 1 / (8.6e5 + 1j * omega * 2.4e3),
                        1 / (5.11e7 + 1j * omega * 198), 1 / (2.96e5 + 1j * omega * 0.0338)])  # fmt: skip
        boolean = np.eye(6)[2:]
        expected = lm_fbs([free[index]], boolean, soft)
        assert found[index] == pytest.approx(expected, rel=1e-9, abs=1e-9 * abs(expected).max() * 1e-3)


def test_coupled_segments_are_the_whole_segment() -> None:
    whole = segment_receptance(tube(160, 60, 20), FREQUENCY_HZ, [0.0, 0.05, 0.12, 0.16])
    parts = couple_rigid(
        segment_receptance(tube(120, 60, 20), FREQUENCY_HZ, [0.0, 0.05, 0.12]),
        segment_receptance(tube(40, 60, 20), FREQUENCY_HZ, [0.0, 0.04]),
    )
    assert parts == pytest.approx(whole, rel=1e-7, abs=1e-9 * abs(whole).max())


def test_condensed_shaft_is_the_literal_formula() -> None:
    """4-35: the inverse of the sum of two inverses, the second one with K used directly."""
    frequency_hz = np.linspace(300.0, 2500.0, 23)
    places = sorted({0.0, 0.0891, 0.2541, 0.4081, 0.5011, *(m for _, m in PLACES)})
    springs: list[SpringDamper | None] = [None] * len(places)
    for group, m in PLACES:
        springs[places.index(m)] = PROPERTIES[group]
    free = replace(shaft(), supports=())
    receptance = None
    start = 0.0
    for part in free.segments:
        inside = [m - start for m in places if start - 1e-9 <= m <= start + part.length_m + 1e-9]
        piece = segment_receptance(part, frequency_hz, [*inside[:-1], part.length_m])
        receptance = piece if receptance is None else couple_rigid(receptance, piece)
        start += part.length_m
    assert receptance is not None
    literal = np.linalg.inv(np.linalg.inv(receptance) + ground_stiffness(springs, frequency_hz))
    assert inverse_rows(CondensedShaft(free_with_supports(), frequency_hz).nose_stiffness(PROPERTIES)) == pytest.approx(
        np.stack([literal[:, 0, 0], literal[:, 0, 1], literal[:, 1, 1]]), rel=1e-7
    )


def free_with_supports() -> Chain:
    return shaft(dict.fromkeys(PROPERTIES, SpringDamper()))


def test_derivatives_by_every_parameter() -> None:
    condensed = CondensedShaft(shaft(), FREQUENCY_HZ)
    found, derivatives = condensed.nose_receptance_and_derivatives(PROPERTIES)
    assert found == pytest.approx(condensed.nose_receptance(PROPERTIES), rel=1e-12)
    values = parameters_from_properties(PROPERTIES)
    for name in PARAMETERS:
        step = max(1e-4 * values[name], 1e-2)
        up, down = ({**values, name: values[name] + sign * step} for sign in (1, 0))
        slope = (condensed.nose_receptance(properties_from_parameters(up))
                 - condensed.nose_receptance(properties_from_parameters(down))) / step  # fmt: skip
        assert derivatives[name] == pytest.approx(slope, rel=2e-2, abs=1e-3 * abs(slope).max()), name


@pytest.mark.parametrize("inertia", ["correct", "published"])
def test_natural_frequencies_on_supports_are_where_the_undamped_response_is_singular(inertia: str) -> None:
    parts = tuple(replace(part, rigid_rotary_inertia=inertia) for part in shaft().segments)
    chain = replace(shaft(), parts=parts)
    lever = np.tile([1.0, 50.0], len(dense_stiffness(chain, 500.0, 0.01, damped=False)[1]))
    for frequency in natural_frequencies(chain, 4):
        stiffness, _ = dense_stiffness(chain, float(frequency), 0.01, damped=False)
        values = np.linalg.eigvalsh(stiffness * lever[:, None] * lever)
        assert np.min(np.abs(values)) < 1e-9 * np.max(np.abs(values))


@pytest.mark.parametrize("inertia", ["correct", "published"])
def test_no_natural_frequency_is_missed_and_none_is_spurious(inertia: str) -> None:
    """Sign changes of the dense determinant on a fine grid, counted without the condensed chain."""
    parts = tuple(replace(part, rigid_rotary_inertia=inertia) for part in shaft().segments)
    chain = replace(shaft(), parts=parts)
    found = natural_frequencies(chain, 6)
    lever = np.tile([1.0, 50.0], len(dense_stiffness(chain, 500.0, 0.01, damped=False)[1]))
    negative = []
    for at in (0.999 * found[0], *(0.5 * (found[1:] + found[:-1]))):
        stiffness, _ = dense_stiffness(chain, float(at), 0.01, damped=False)
        negative.append(int(np.sum(np.linalg.eigvalsh(stiffness * lever[:, None] * lever) < 0.0)))
    # Points 10 mm apart: no part clamped at both its points has a natural frequency here, so the count is complete.
    assert negative == list(range(6))


@pytest.mark.parametrize("first_place", [0.0991, 0.0], ids=["bearings behind the nose", "one at the nose"])
def test_several_sets_of_bearings_at_once_equal_one_by_one(first_place: float) -> None:
    chain = shaft()
    front = (replace(chain.supports[0], position_m=first_place), *chain.supports[1:])
    assembly = SpindleAssembly(shaft=replace(chain, supports=front), front=(tube(78, 45, 20), JOINT))
    condensed = CondensedAssembly(assembly, FREQUENCY_HZ)
    told = parameters_from_properties(PROPERTIES)
    factors = np.array([1.0, 0.3, 4.0])
    found = condensed.receptances({name: value * factors for name, value in told.items()}, slice(1, 4))
    assert found.shape == (3, 3)
    for factor, row in zip(factors, found, strict=True):
        properties = properties_from_parameters({name: value * factor for name, value in told.items()})
        assert row == pytest.approx(condensed.receptance(properties)[1:4], rel=1e-9)
