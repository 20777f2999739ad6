"""The simulated spindle's finite elements and bearings, against independent computations; its campaigns."""

from dataclasses import replace

import numpy as np
import pytest
from true_resonance import TrueResonance

from config.machine.spindle import spindle_folder
from config.machine.spindle_chain import read_spindle
from drivers.sim.machine.heat import INDEX
from drivers.sim.spindle import spindle_beam
from drivers.sim.spindle.spindle_beam import BEARING_PLACES_MM, SpindleBeam, Spring, Stretch
from drivers.sim.spindle.spindle_bearings import bearings, nominal_bearings
from models.dynamics.assembly import CondensedAssembly
from models.dynamics.chain import SpringDamper
from models.records import FloatArray

FREQUENCY_HZ = np.arange(300.0, 1500.0, 3.125)


def at(shaft_degc: float, bearing_degc: float, housing_degc: float) -> FloatArray:
    degc = np.full(len(INDEX), housing_degc)
    for end in ("front", "rear"):
        degc[INDEX[f"shaft_{end}"]], degc[INDEX[f"bearing_{end}"]] = shaft_degc, bearing_degc
    return degc


def test_a_uniform_bar_has_its_closed_form_frequencies(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slender free bar: (4.7300, 7.8532)^2 / (2 pi L^2) sqrt(E I / rho A); shear and rotation take under 0.1 %."""
    bar = (Stretch(length_mm=1000.0, outer_mm=10.0, inner_mm=0.0, **spindle_beam.STEEL),)
    monkeypatch.setattr(spindle_beam, "SHAFT", bar)
    soft = [Spring(kt=1e-3, ct=0.0, kr=1e-3, cr=0.0)] * 5
    found = SpindleBeam(soft, with_tool=False).modes(soft).resonance_hz
    bending = [each for each in found if each > 5.0][:2]
    wave_m_per_s = np.sqrt(200e9 / 7850.0) * 0.0025
    expected = np.array([4.730041, 7.853205]) ** 2 / (2.0 * np.pi) * wave_m_per_s
    assert bending == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("with_tool", [False, True])
def test_finite_elements_agree_with_the_exact_beam(with_tool: bool) -> None:
    """The same springs under the product's exact beam; shear areas differ by Poisson's ratio (some per cent of G)."""
    usual = nominal_bearings("y")
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    supports = tuple(
        replace(
            support,
            group=str(place),
            properties=SpringDamper(
                kt_n_per_m=each.kt, ct_ns_per_m=each.ct, kr_nm_per_rad=each.kr, cr_nms_per_rad=each.cr
            ),
        )
        for place, (support, each) in enumerate(zip(spindle.shaft.supports, usual, strict=True))
    )
    assert [support.position_m for support in supports] == pytest.approx(np.array(BEARING_PLACES_MM) / 1e3)
    assembly = spindle.assembly("tool" if with_tool else "nose")
    assembly = replace(assembly, shaft=replace(assembly.shaft, supports=supports))
    exact = CondensedAssembly(assembly, FREQUENCY_HZ).receptance({each.group: each.properties for each in supports})
    elements = SpindleBeam(usual, with_tool=with_tool).modes(usual).receptance(FREQUENCY_HZ)
    peak = FREQUENCY_HZ[[np.argmax(np.abs(each)) for each in (exact, elements)]]
    assert peak[0] == pytest.approx(peak[1], rel=0.01)
    assert np.median(np.abs(np.log(exact / elements))) < 0.05


def test_bearings_stiffen_as_the_shaft_outgrows_the_housing() -> None:
    cold, warm, hot = (bearings(at(*degc), "y") for degc in ((20, 20, 20), (26, 25, 23), (40, 40, 30)))
    for place in range(5):
        assert cold[place].kt < warm[place].kt < hot[place].kt
        assert cold[place].kr < warm[place].kr < hot[place].kr
    assert all(x.kt < y.kt for x, y in zip(bearings(at(20, 20, 20), "x"), cold, strict=True))
    loose = bearings(at(5, 5, 40), "y")
    assert all(each.kt > 0.0 and each.ct > 0.0 for each in loose)


def test_the_true_resonance_is_followed_through_temperature() -> None:
    truth = TrueResonance("y")
    way = [truth.at(at(20.0 + k, 20.0 + 0.8 * k, 20.0 + 0.4 * k)) for k in np.linspace(0.0, 20.0, 41)]
    assert np.abs(np.diff(way)).max() < 5.0
    assert way[-1] - way[0] > 30.0
