"""Equivalent elastic constants of a composite section (equations 4-19 to 4-25 of the dissertation).

Three models of a section: `mixed` with volume ratios, taken from the target (uniform, draft model) or from the
segment (volume model), and `layered` with the diameters of the layers. No scheme that was tried reproduces the
Poisson's ratios of the dissertation's Table 4-2; a mixture's is the volume mean unless it is given.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from models.dynamics.section import Elasticity
from models.records import FloatArray

BoolArray = npt.NDArray[np.bool_]

CELLS = 120
"""n_d: unit cells along each side of the section."""
RATIO_SUM = 1e-6
"""How far the volume ratios of a section may sum up beside 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """A material that is isotropic, or a laminate about the axis of the shaft."""

    name: str
    density_kg_per_m3: float
    young_pa: float
    """E_z along the axis [Pa]."""
    shear_radial_pa: float
    """G_zx: between the axis and the radial direction [Pa]."""
    shear_tangential_pa: float
    """G_zy: between the axis and the tangential direction [Pa]."""
    poisson: float | None
    """nu; None where it is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """A layer of a section, from the one before it (or the bore) to its own outer diameter."""

    material: Material
    outer_m: float


def mixed(
    ratios: Sequence[tuple[Material, float]],
    outer_m: float,
    inner_m: float,
    *,
    poisson: float | None = None,
    cells: int = CELLS,
) -> Elasticity:
    """Return the constants of a section in which materials are spread uniformly (4-19, 4-23, 4-24).

    Raises ValueError when ratios are negative or do not sum up to 1, or Poisson's ratio is not known.

    `ratios`: materials and their volume ratios, which sum up to 1. `outer_m`, `inner_m`: diameters [m]. `poisson`: nu
    of the shear coefficient; None: the volume mean of the materials'. `cells`: unit cells along each side.
    """
    total = sum(ratio for _, ratio in ratios)
    if any(ratio < 0.0 for _, ratio in ratios) or abs(total - 1.0) > RATIO_SUM:
        raise ValueError(f"volume ratios must not be negative and must sum up to 1, not to {total:g}")
    present = [(material, ratio) for material, ratio in ratios if ratio > 0.0]
    radial, inside = _cells(outer_m, inner_m, cells)
    compliance = sum(
        ratio / (material.shear_radial_pa * radial + material.shear_tangential_pa * (1.0 - radial))
        for material, ratio in present
    )
    return Elasticity(
        young_pa=sum(ratio * material.young_pa for material, ratio in present),
        shear_pa=_strips(np.asarray(compliance), inside),
        poisson=_mean_poisson(present) if poisson is None else poisson,
        density_kg_per_m3=sum(ratio * material.density_kg_per_m3 for material, ratio in present),
    )


def layered(layers: Sequence[Layer], inner_m: float, *, poisson: float | None = None, cells: int = CELLS) -> Elasticity:
    """Return the constants of a section made of layers (4-22, 4-23, 4-25).

    A cell on the boundary of two layers belongs to the one that holds its centre.

    Raises ValueError when the diameters do not grow, or Poisson's ratio is not known.

    `layers`: from the bore outwards, with growing outer diameters. `inner_m`: diameter of the bore [m]. `poisson`: nu
    of the shear coefficient; None: the area mean of the materials'. `cells`: unit cells along each side.
    """
    borders = [inner_m, *(layer.outer_m for layer in layers)]
    if any(second <= first for first, second in pairwise(borders)):
        raise ValueError("the outer diameters of layers must grow from the bore outwards")
    outer_m = borders[-1]
    fourth, second = np.diff(np.power(borders, 4)), np.diff(np.square(borders))
    weights, areas = fourth / fourth.sum(), second / second.sum()
    radial, inside = _cells(outer_m, inner_m, cells)
    radius = _radius(outer_m, cells)
    compliance = np.ones_like(radial)
    for layer, inner in zip(layers, borders, strict=False):
        here = (radius >= inner / 2.0) & (radius <= layer.outer_m / 2.0)
        material = layer.material
        shear = material.shear_radial_pa * radial + material.shear_tangential_pa * (1.0 - radial)
        compliance = np.where(here, 1.0 / shear, compliance)
    shares = [(layer.material, float(area)) for layer, area in zip(layers, areas, strict=True)]
    return Elasticity(
        young_pa=float(sum(w * layer.material.young_pa for w, layer in zip(weights, layers, strict=True))),
        shear_pa=_strips(compliance, inside),
        poisson=_mean_poisson(shares) if poisson is None else poisson,
        density_kg_per_m3=sum(area * material.density_kg_per_m3 for material, area in shares),
    )


def _mean_poisson(ratios: Sequence[tuple[Material, float]]) -> float:
    total = 0.0
    for material, ratio in ratios:
        if material.poisson is None:
            raise ValueError(f"Poisson's ratio of {material.name} is not known; give nu for the section")
        total += ratio * material.poisson
    return total


def _radius(outer_m: float, cells: int) -> FloatArray:
    centre = ((np.arange(cells) + 0.5) / cells - 0.5) * outer_m
    return np.hypot(centre[:, None], centre[None, :])


def _cells(outer_m: float, inner_m: float, cells: int) -> tuple[FloatArray, BoolArray]:
    """Return cos^2 of the angle between the load and the radius for each cell, and which cells are material."""
    centre = ((np.arange(cells) + 0.5) / cells - 0.5) * outer_m
    radius = _radius(outer_m, cells)
    radial = np.square(centre)[:, None] / np.maximum(np.square(radius), np.finfo(np.float64).tiny)
    return radial, (radius <= outer_m / 2.0) & (radius >= inner_m / 2.0)


def _strips(compliance: FloatArray, inside: BoolArray) -> float:
    """Return G of 4-23: cells along the load in a row, the strips they form side by side."""
    count = inside.sum(axis=0)
    filled = count > 0
    strip = count[filled] / np.where(inside, compliance, 0.0).sum(axis=0)[filled]
    return float((strip * count[filled]).sum() / count.sum())
