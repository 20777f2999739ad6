"""Hollow circular sections: area, second moment, shear coefficient, and rings that are shrunk on."""

from dataclasses import dataclass

import numpy as np

from models.dynamics.beam import RotaryInertia, Segment


@dataclass(frozen=True, slots=True, kw_only=True)
class Elasticity:
    """Equivalent elastic constants and density of a cross-section."""

    young_pa: float
    """E along the axis [Pa]."""
    shear_pa: float
    """G across the axis [Pa]."""
    poisson: float
    """nu of the shear coefficient 4-26."""
    density_kg_per_m3: float

    def __post_init__(self) -> None:
        """Check the numbers; raises ValueError."""
        for name in ("young_pa", "shear_pa", "density_kg_per_m3"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be positive and finite, got {value:g}")
        if not -1.0 < self.poisson < 1.0:
            raise ValueError(f"Poisson's ratio must lie between -1 and 1, got {self.poisson:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tube:
    """A hollow circular section of one (equivalent) material; an inner diameter of 0 is a full one."""

    outer_m: float
    inner_m: float
    elasticity: Elasticity

    def __post_init__(self) -> None:
        """Check the diameters; raises ValueError."""
        if not 0.0 <= self.inner_m < self.outer_m:
            raise ValueError(
                f"the inner diameter {self.inner_m:g} m must be at least 0 "
                f"and smaller than the outer {self.outer_m:g} m"
            )

    @property
    def area_m2(self) -> float:
        """A_c [m^2]."""
        return np.pi / 4.0 * (self.outer_m**2 - self.inner_m**2)

    @property
    def second_moment_m4(self) -> float:
        """I [m^4]."""
        return np.pi / 64.0 * (self.outer_m**4 - self.inner_m**4)

    @property
    def shear_stiffness_n(self) -> float:
        """A_s G [N] by 4-26."""
        coefficient = shear_coefficient(self.outer_m, self.inner_m, self.elasticity.poisson)
        return coefficient * self.area_m2 * self.elasticity.shear_pa


def shear_coefficient(outer_m: float, inner_m: float, poisson: float) -> float:
    """Return A_s / A_c of a hollow circle (4-26); 0.886 for a full one of steel.

    `outer_m` and `inner_m`: diameters [m] (any common unit). `poisson`: Poisson's ratio.
    """
    ratio = (inner_m / outer_m) ** 2
    square = (1.0 + ratio) ** 2
    return 6.0 * (1.0 + poisson) * square / ((7.0 + 6.0 * poisson) * square + (20.0 + 12.0 * poisson) * ratio)


def beam_segment(
    length_m: float,
    tubes: tuple[Tube, ...],
    *,
    axial_load_n: float = 0.0,
    structural_damping: float = 0.0,
    rigid_rotary_inertia: RotaryInertia = "correct",
) -> Segment:
    """Return the segment of tubes that bend together (shaft, shrunk rotor, sleeve, holder inside a taper).

    Every tube adds its own share: rho A, rho I, E I and its own A_s G (4-26 with its own
    diameters and Poisson's ratio).

    `length_m`: length [m]. `tubes`: at least one tube. `axial_load_n`, `structural_damping`, `rigid_rotary_inertia`:
    see `models.dynamics.beam.Segment`.
    """
    return Segment(
        length_m=length_m,
        mass_kg_per_m=sum(tube.elasticity.density_kg_per_m3 * tube.area_m2 for tube in tubes),
        rotary_inertia_kgm=sum(tube.elasticity.density_kg_per_m3 * tube.second_moment_m4 for tube in tubes),
        bending_stiffness_nm2=sum(tube.elasticity.young_pa * tube.second_moment_m4 for tube in tubes),
        shear_stiffness_n=sum(tube.shear_stiffness_n for tube in tubes),
        axial_load_n=axial_load_n,
        structural_damping=structural_damping,
        rigid_rotary_inertia=rigid_rotary_inertia,
    )
