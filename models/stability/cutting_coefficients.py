"""Cutting coefficients of materials with their source, and their fit from measured forces.

The coefficients depend on the tool, its wear and the speed: what stands here is a beginning, and
`fit_mean_forces` replaces it by what a dynamometer says about the tool in the spindle.
"""

import math
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.milling import Cut
from models.units import m_from_mm

REVIEW = (
    "Milling Force Model for Aviation Aluminum Alloy, Chinese Journal of Mechanical Engineering 34 (2021), "
    "doi:10.1186/s10033-021-00536-9, table 5"
)
USUAL_CHIP_MM = 0.1
"""Chip thickness at which a curved law of the force is taken for a line."""
TITANIUM_CHIP_MM = 0.05
ASSUMED_RATIO = 0.3
"""K_rc / K_tc where a source has the cutting force only; that of the dissertation."""
KIENZLE = (
    "Koenig and Essel, Spezifische Schnittkraftwerte fuer die Zerspanung metallischer Werkstoffe, Stahleisen 1973, "
    f"from turning; derived: slope at a chip of {USUAL_CHIP_MM:g} mm; assumed: K_rc/K_tc {ASSUMED_RATIO:g}"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CuttingCoefficients:
    """Linear cutting force law: force = K_c x chip area + K_e x edge length."""

    material: str
    tangential_n_per_m2: float
    """K_tc [N/m^2]."""
    radial_n_per_m2: float
    """K_rc [N/m^2]."""
    tangential_edge_n_per_m: float = 0.0
    """K_te [N/m]; has no part in stability."""
    radial_edge_n_per_m: float = 0.0
    """K_re [N/m]; has no part in stability."""
    source: str

    @property
    def radial_ratio(self) -> float:
        """K_rc / K_tc."""
        return self.radial_n_per_m2 / self.tangential_n_per_m2


def tangent_of_kienzle(
    material: str, specific_n_per_mm2: float, exponent: float, radial_ratio: float, source: str
) -> CuttingCoefficients:
    """Return the line that touches Kienzle's law F = b k h^(1 - m) at a chip of `USUAL_CHIP_MM`.

    A vibration feels the slope of the force; what the line has at a chip of nothing is the edge's. The law gives the
    cutting force only, so the ratio of the radial one is told.
    """
    slope = specific_n_per_mm2 * (1.0 - exponent) * USUAL_CHIP_MM**-exponent
    edge = specific_n_per_mm2 * exponent * USUAL_CHIP_MM ** (1.0 - exponent)
    return CuttingCoefficients(
        material=material,
        tangential_n_per_m2=slope * 1e6,
        radial_n_per_m2=radial_ratio * slope * 1e6,
        tangential_edge_n_per_m=edge * 1e3,
        radial_edge_n_per_m=radial_ratio * edge * 1e3,
        source=source,
    )


def orthogonal_coefficients(
    shear_stress_n_per_mm2: float, friction_deg: float, chip_ratio: float, rake_deg: float
) -> tuple[float, float]:
    """Return K_tc and K_rc [N/mm^2] of a shear plane: Merchant's force diagram; chip over cut thickness inversely."""
    rake = math.radians(rake_deg)
    shear = math.atan2(chip_ratio * math.cos(rake), 1.0 - chip_ratio * math.sin(rake))
    leaning = math.radians(friction_deg) - rake
    whole = shear_stress_n_per_mm2 / (math.sin(shear) * math.cos(shear + leaning))
    return whole * math.cos(leaning), whole * math.sin(leaning)


def _titanium() -> CuttingCoefficients:
    rake_deg = 12.0
    ratio = (1.755 - 0.028 * rake_deg) * TITANIUM_CHIP_MM ** (0.331 - 0.0082 * rake_deg)
    tangential, radial = orthogonal_coefficients(613.0, 19.1 + 0.29 * rake_deg, ratio, rake_deg)
    return CuttingCoefficients(
        material="Ti6Al4V, cemented carbide, rake 12 deg",
        tangential_n_per_m2=tangential * 1e6,
        radial_n_per_m2=radial * 1e6,
        tangential_edge_n_per_m=24e3,
        radial_edge_n_per_m=43e3,
        source="Budak, Altintas and Armarego, J. Eng. Ind. 118 (1996) 216-224, orthogonal cuts: shear stress 613 "
        f"N/mm^2, friction angle 19.1 deg + 0.29 rake; derived for rake 12 deg and a chip of {TITANIUM_CHIP_MM:g} mm",
    )


MATERIALS: dict[str, CuttingCoefficients] = {
    "a5052": CuttingCoefficients(
        material="aluminium alloy A5052",
        tangential_n_per_m2=2.20e8,
        radial_n_per_m2=0.66e8,
        source="the dissertation, Fig. 5-24: assumed from the tensile strength; low for a cutting coefficient",
    ),
    "aluminium_benchmark": CuttingCoefficients(
        material="aluminium alloy of the published milling benchmark",
        tangential_n_per_m2=6.0e8,
        radial_n_per_m2=2.0e8,
        source="Insperger and Stepan, Int. J. Numer. Meth. Engng 61 (2004), one-degree-of-freedom milling example",
    ),
    "al6061_t6": CuttingCoefficients(
        material="Al6061-T6, cemented carbide, dry",
        tangential_n_per_m2=243.77e6,
        radial_n_per_m2=113.5e6,
        tangential_edge_n_per_m=7.53e3,
        radial_edge_n_per_m=7.83e3,
        source=f"{REVIEW}, ref. 160",
    ),
    "al6082_t6": CuttingCoefficients(
        material="Al6082-T6, cemented carbide, dry",
        tangential_n_per_m2=631.0e6,
        radial_n_per_m2=99.0e6,
        tangential_edge_n_per_m=13.0e3,
        radial_edge_n_per_m=10.0e3,
        source=f"{REVIEW}, ref. 189",
    ),
    "al7075_t6": CuttingCoefficients(
        material="Al7075-T6, cemented carbide, dry",
        tangential_n_per_m2=600.46e6,
        radial_n_per_m2=180.96e6,
        tangential_edge_n_per_m=17.9e3,
        radial_edge_n_per_m=20.42e3,
        source=f"{REVIEW}, ref. 160",
    ),
    "c45": tangent_of_kienzle(
        "steel C45 (AISI 1045), normalised", 2220.0, 0.14, ASSUMED_RATIO, f"k_c1.1 2220 N/mm^2, m 0.14: {KIENZLE}"
    ),
    "gg25": tangent_of_kienzle(
        "grey cast iron GG-25 (EN-GJL-250)", 1160.0, 0.26, ASSUMED_RATIO, f"k_c1.1 1160 N/mm^2, m 0.26: {KIENZLE}"
    ),
    "ti6al4v": _titanium(),
}
"""Name in a case -> coefficients."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CoefficientFit:
    """Coefficients from measured forces, and how well they explain them."""

    coefficients: CuttingCoefficients
    residual_rms_n: float
    """Of the mean forces that the fit leaves unexplained [N]."""
    determination: float
    """Coefficient of determination R^2."""


def fit_mean_forces(
    cut: Cut,
    depth_mm: float,
    feed_per_tooth_mm: FloatArray,
    mean_force_x_n: FloatArray,
    mean_force_y_n: FloatArray,
    material: str = "fitted",
) -> CoefficientFit:
    """Fit the four coefficients to mean forces over whole turns at several feeds.

    The mean of the law over a turn is linear in feed per tooth: its slope gives K_tc and K_rc, its
    intercept K_te and K_re.

    Result: coefficients and residual. Raises StabilityError with fewer than two feeds, forces that are no numbers, or a
    tangential coefficient that is not positive.

    `cut`: engagement and teeth; its coefficients are not used. `depth_mm`: axial depth of cut [mm].
    `feed_per_tooth_mm`: shape (n,) [mm], at least two different feeds. `mean_force_x_n`, `mean_force_y_n`: mean force
    on the tool along the feed and normal to it [N], shape (n,). `material`: name of the result.
    """
    feeds = np.asarray(feed_per_tooth_mm, dtype=np.float64)
    if len(np.unique(feeds)) < 2:
        raise StabilityError("mean forces at one feed give no slope; measure at two feeds per tooth or more")
    measured = np.stack((mean_force_x_n, mean_force_y_n), axis=1).reshape(-1)
    if not (np.all(np.isfinite(measured)) and np.all(feeds > 0.0) and depth_mm > 0.0):
        raise StabilityError("feeds and depth must be above 0 mm and every force a number; remove other rows")
    area, edge = _mean_force_matrices(cut)
    depth_m = m_from_mm(depth_mm)
    rows = [np.hstack((depth_m * feed_m * area, depth_m * edge)) for feed_m in m_from_mm(feeds)]
    design = np.vstack(rows)
    scale = np.abs(design).max(axis=0)
    values = np.linalg.lstsq(design / scale, measured, rcond=None)[0] / scale
    if not values[0] > 0.0:
        raise StabilityError(
            f"the fit gives a tangential coefficient of {values[0]:g} N/m^2; check the signs of the forces "
            "(on the tool, X along the feed, Y to the left of it) and the milling direction"
        )
    residual = measured - design @ values
    spread = float(np.sum((measured - measured.mean()) ** 2))
    return CoefficientFit(
        coefficients=CuttingCoefficients(
            material=material,
            tangential_n_per_m2=float(values[0]),
            radial_n_per_m2=float(values[1]),
            tangential_edge_n_per_m=float(values[2]),
            radial_edge_n_per_m=float(values[3]),
            source=f"mean forces at {len(feeds)} feeds, depth {depth_mm:g} mm",
        ),
        residual_rms_n=float(np.sqrt(np.mean(residual**2))),
        determination=1.0 - float(np.sum(residual**2)) / spread if spread > 0.0 else 1.0,
    )


def _mean_force_matrices(cut: Cut) -> tuple[FloatArray, FloatArray]:
    """Return mean force per (K_tc, K_rc) x depth x feed, and per (K_te, K_re) x depth, shapes (2, 2)."""

    def antiderivatives(angle: float) -> tuple[FloatArray, FloatArray]:
        """Return the antiderivatives of the force's shape functions at an angle [rad]."""
        sine, cosine, double = math.sin(angle), math.cos(angle), 2.0 * angle
        square = angle / 2.0 - math.sin(double) / 4.0
        product = -math.cos(double) / 4.0
        return (
            np.array([[-product, -square], [square, -product]]),
            np.array([[-sine, cosine], [-cosine, -sine]]),
        )

    last_area, last_edge = antiderivatives(cut.exit_rad)
    first_area, first_edge = antiderivatives(cut.start_rad)
    turns = cut.teeth / (2.0 * math.pi)
    return turns * (last_area - first_area), turns * (last_edge - first_edge)
