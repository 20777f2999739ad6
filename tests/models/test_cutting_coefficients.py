"""Coefficients that are derived from a published law, against that law itself."""

import math

import pytest

from models.stability.cutting_coefficients import MATERIALS, USUAL_CHIP_MM, orthogonal_coefficients


@pytest.mark.parametrize(("name", "specific", "exponent"), [("c45", 2220.0, 0.14), ("gg25", 1160.0, 0.26)])
def test_the_line_touches_kienzles_law(name: str, specific: float, exponent: float) -> None:
    def force_n_per_mm(chip_mm: float) -> float:
        return specific * chip_mm ** (1.0 - exponent)

    known = MATERIALS[name]
    slope, edge = known.tangential_n_per_m2 / 1e6, known.tangential_edge_n_per_m / 1e3
    assert edge + slope * USUAL_CHIP_MM == pytest.approx(force_n_per_mm(USUAL_CHIP_MM))
    step = 1e-5
    steep = (force_n_per_mm(USUAL_CHIP_MM + step) - force_n_per_mm(USUAL_CHIP_MM - step)) / (2.0 * step)
    assert slope == pytest.approx(steep, rel=1e-6)
    assert known.radial_ratio == pytest.approx(0.3)
    assert "assumed" in known.source


def test_the_shear_plane_carries_its_stress_and_the_rake_face_its_friction() -> None:
    rake_deg, friction_deg, ratio = 12.0, 22.58, 0.7
    tangential, radial = orthogonal_coefficients(613.0, friction_deg, ratio, rake_deg)
    rake = math.radians(rake_deg)
    assert math.degrees(math.atan2(radial, tangential)) == pytest.approx(friction_deg - rake_deg)
    shear = math.atan(ratio * math.cos(rake) / (1.0 - ratio * math.sin(rake)))
    along_the_plane = tangential * math.cos(shear) - radial * math.sin(shear)
    assert along_the_plane * math.sin(shear) == pytest.approx(613.0)


def test_titanium_lies_where_its_rake_and_chip_put_it() -> None:
    """Rake 12 deg, chip 0.05 mm: chip ratio 0.707, friction angle 22.58 deg."""
    known = MATERIALS["ti6al4v"]
    tangential, radial = orthogonal_coefficients(613.0, 22.58, 0.707, 12.0)
    assert known.tangential_n_per_m2 == pytest.approx(tangential * 1e6, rel=2e-3)
    assert known.radial_n_per_m2 == pytest.approx(radial * 1e6, rel=2e-3)
    assert (known.tangential_edge_n_per_m, known.radial_edge_n_per_m) == (24e3, 43e3)
