"""Mixtures against limits that are known in closed form, and against an integral done otherwise."""

import numpy as np
import pytest
from scipy.integrate import dblquad

from models.dynamics.mixture import Layer, Material, layered, mixed

STEEL = Material(name="steel", density_kg_per_m3=7850, young_pa=200e9, shear_radial_pa=76.9e9,
                 shear_tangential_pa=76.9e9, poisson=0.3)  # fmt: skip
SOFT = Material(name="soft", density_kg_per_m3=1600, young_pa=40e9, shear_radial_pa=4e9, shear_tangential_pa=4e9,
                poisson=0.4)  # fmt: skip
LAMINATE = Material(name="laminate", density_kg_per_m3=1720, young_pa=14.2e9, shear_radial_pa=3.1e9,
                    shear_tangential_pa=99.7e9, poisson=None)  # fmt: skip


def test_isotropic_mixture_is_the_rule_of_mixtures() -> None:
    found = mixed([(STEEL, 0.4), (SOFT, 0.6)], 0.06, 0.0)
    assert found.young_pa == pytest.approx(0.4 * 200e9 + 0.6 * 40e9)
    assert found.shear_pa == pytest.approx(1.0 / (0.4 / 76.9e9 + 0.6 / 4e9), rel=1e-12)
    assert found.density_kg_per_m3 == pytest.approx(0.4 * 7850 + 0.6 * 1600)
    assert found.poisson == pytest.approx(0.4 * 0.3 + 0.6 * 0.4)


def test_shear_modulus_of_a_laminate_against_quadrature() -> None:
    """Strips side by side, each with its cells in a row, as an integral instead of cells."""
    outer, inner = 0.5, 0.25

    def compliance(x: float, y: float) -> float:
        radial = x * x / (x * x + y * y)
        return 1.0 / (3.1e9 * radial + 99.7e9 * (1.0 - radial))

    heights = np.polynomial.legendre.leggauss(80)
    points = np.concatenate([inner / 2 * (heights[0] + 1), inner + (outer - inner) / 2 * (heights[0] + 1)])
    weights = np.concatenate([inner / 2 * heights[1], (outer - inner) / 2 * heights[1]])
    total = area = 0.0
    for y, weight in zip(points, weights, strict=True):
        left, right = np.sqrt(max(inner**2 - y * y, 0.0)), np.sqrt(outer**2 - y * y)
        row = dblquad(lambda x, _, y=y: compliance(x, y), 0.0, 1.0, left, right)[0]
        total += weight * (right - left) ** 2 / row
        area += weight * (right - left)
    found = mixed([(LAMINATE, 1.0)], 2 * outer, 2 * inner, poisson=0.3)
    assert found.shear_pa == pytest.approx(total / area, rel=0.01)
    finer = mixed([(LAMINATE, 1.0)], 2 * outer, 2 * inner, poisson=0.3, cells=960)
    assert finer.shear_pa == pytest.approx(total / area, rel=0.002)


def test_youngs_modulus_of_layers_weighs_with_the_second_moment() -> None:
    found = layered([Layer(material=SOFT, outer_m=0.06), Layer(material=STEEL, outer_m=0.08)], 0.02)
    inner, outer = 0.06**4 - 0.02**4, 0.08**4 - 0.06**4
    assert found.young_pa == pytest.approx((40e9 * inner + 200e9 * outer) / (inner + outer))
    areas = 0.06**2 - 0.02**2, 0.08**2 - 0.06**2
    assert found.density_kg_per_m3 == pytest.approx((1600 * areas[0] + 7850 * areas[1]) / sum(areas))
