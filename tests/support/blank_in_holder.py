"""A blank in a holder on a published spindle, hit at its tip and at a second point, without the formulas under test."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from config.machine.spindle_chain import read_spindle
from models.dynamics.assembly import CondensedAssembly, SpindleAssembly
from models.dynamics.beam import ComplexArray, Segment
from models.dynamics.chain import SpringDamper, Support
from models.dynamics.section import Elasticity, Tube, beam_segment

HZ = np.arange(100.0, 4000.0, 2.0)
STEEL = Elasticity(young_pa=205e9, shear_pa=79e9, poisson=0.3, density_kg_per_m3=7850.0)
CARBIDE = Elasticity(young_pa=580e9, shear_pa=238e9, poisson=0.22, density_kg_per_m3=14400.0)
SECOND_M = 0.03


def cylinder(length_m: float, diameter_m: float, elasticity: Elasticity = STEEL) -> Segment:
    return beam_segment(
        length_m, (Tube(outer_m=diameter_m, inner_m=0.0, elasticity=elasticity),), structural_damping=0.002
    )


BLANK = cylinder(0.07, 0.016)
TOOL = (cylinder(0.03, 0.8 * 0.016, CARBIDE), cylinder(0.06, 0.016, CARBIDE))


def holder_on_spindle() -> SpindleAssembly:
    """A published spindle with a holder on an elastic taper."""
    spindle = read_spindle(Path("holder_cold_x"))
    taper = SpringDamper(kt_n_per_m=3e8, ct_ns_per_m=300.0, kr_nm_per_rad=4e5, cr_nms_per_rad=0.1)
    return SpindleAssembly(shaft=spindle.shaft, front=(cylinder(0.06, 0.04), taper))


def tip(holder: SpindleAssembly, parts: tuple[Segment, ...], probe_n_per_m: float | None = None) -> ComplexArray:
    """Return the response at the tip [m/N], by the chain that the spindle's own responses come from."""
    whole = replace(holder, front=(*parts, *holder.front)).whole()
    properties = {each.group: each.properties for each in whole.supports}
    if probe_n_per_m is not None:
        probe = Support(position_m=SECOND_M, group="probe", properties=SpringDamper(kt_n_per_m=probe_n_per_m))
        whole, properties = replace(whole, supports=(*whole.supports, probe)), {**properties, "probe": probe.properties}
    return CondensedAssembly(SpindleAssembly(shaft=whole), HZ).receptance(properties)


def blank_test(holder: SpindleAssembly) -> ComplexArray:
    """Return the three responses of the blank without the formulas under test.

    A spring k to the ground at the second point takes k Hc^2 / (1 + k Hs) from the response at the tip: two springs
    give the cross response Hc and the second point's Hs.
    """
    bare, soft, hard = (tip(holder, (BLANK,), k) for k in (None, 1e6, 3e7))
    taken_soft, taken_hard = 1.0 / (bare - soft), 1.0 / (bare - hard)
    square = (1.0 / 1e6 - 1.0 / 3e7) / (taken_soft - taken_hard)
    cross = np.sqrt(square)
    for line in range(1, len(cross)):
        if np.real(np.conj(cross[line - 1]) * cross[line]) < 0.0:
            cross[line] = -cross[line]
    cross *= np.sign(np.real(np.conj(bare[0]) * cross[0]))
    return np.stack([bare, cross, square * taken_soft - 1.0 / 1e6])


def noisy(measured: ComplexArray, share: float, seed: int) -> ComplexArray:
    """Return responses with complex noise of a share of their size."""
    drawn = np.random.default_rng(seed).standard_normal((2, *measured.shape))
    return measured * (1.0 + share * (drawn[0] + 1j * drawn[1]) / np.sqrt(2.0))
