"""A shaft that turns: against the closed form of a pinned Timoshenko shaft, and against itself where it stands.

The closed form is that of H. D. Nelson's Rayleigh and Timoshenko shaft (J. Mech. Des. 102, 1980): between pins the
shapes are sines, and the whirl speeds the roots of one quartic; nothing of the beam's code is in it.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from config.machine.spindle_chain import read_spindle
from daemon.workbench.dynamics.responses import response
from models.dynamics.assembly import SpindleAssembly
from models.dynamics.beam import Segment
from models.dynamics.chain import Chain, SpringDamper, Support
from models.dynamics.rotation import rotating_receptance, spinning, whirl_frequencies
from models.records import FloatArray

LENGTH_M, DIAMETER_M = 0.5, 0.05
YOUNG_PA, SHEAR_PA, DENSITY = 2.1e11, 8.0e10, 7850.0
FREQUENCY_HZ = np.array([150.0, 590.0, 602.3, 655.0, 1410.0, 3240.0])


@pytest.fixture(scope="module")
def pinned() -> Chain:
    area, second = math.pi * DIAMETER_M**2 / 4.0, math.pi * DIAMETER_M**4 / 64.0
    segment = Segment(
        length_m=LENGTH_M,
        mass_kg_per_m=DENSITY * area,
        rotary_inertia_kgm=DENSITY * second,
        bending_stiffness_nm2=YOUNG_PA * second,
        shear_stiffness_n=0.886 * area * SHEAR_PA,
    )
    pin = SpringDamper(kt_n_per_m=1e16)
    ends = tuple(Support(position_m=place, group=name, properties=pin) for place, name in ((0.0, "a"), (LENGTH_M, "b")))
    return Chain(parts=(segment,), supports=ends)


@pytest.fixture(scope="module")
def spindle() -> SpindleAssembly:
    return read_spindle(Path("simulated_machine")).assembly()


def of_the_quartic(segment: Segment, speed_rpm: float, number: int) -> tuple[float, float]:
    """Return the lowest whirls [Hz] against and with the rotation whose shape has so many half waves."""
    wave, spin = number * math.pi / LENGTH_M, speed_rpm * math.pi / 30.0
    shear, inertia = segment.shear_stiffness_n, segment.rotary_inertia_kgm
    sliding = [-segment.mass_kg_per_m, 0.0, shear * wave**2]
    turning = [-inertia, 2.0 * spin * inertia, segment.bending_stiffness_nm2 * wave**2 + shear]
    roots = np.roots(np.polysub(np.polymul(sliding, turning), [(shear * wave) ** 2])).real / (2.0 * math.pi)
    return float(-roots[roots < 0.0].max()), float(roots[roots > 0.0].min())


@pytest.mark.parametrize("speed_rpm", [0.0, 12_000.0, 60_000.0])
def test_whirls_of_a_pinned_shaft(pinned: Chain, speed_rpm: float) -> None:
    against, along = whirl_frequencies(pinned, speed_rpm, 3)
    (segment,) = pinned.segments
    expected = np.array([of_the_quartic(segment, speed_rpm, number) for number in (1, 2, 3)])
    assert against == pytest.approx(expected[:, 0], rel=1e-7)
    assert along == pytest.approx(expected[:, 1], rel=1e-7)
    if speed_rpm:
        assert np.all(along > against)


def test_a_shaft_that_tilts_freely_has_no_whirls(pinned: Chain) -> None:
    """On one bearing without rotational stiffness its precession was told as the first whirl with the rotation."""
    for supports in ((), pinned.supports[:1]):
        with pytest.raises(ValueError, match="precessions, no whirls"):
            whirl_frequencies(replace(pinned, supports=supports), 12_000.0, 3)


def test_where_the_search_ends_both_whirls_are_as_many(pinned: Chain) -> None:
    """Two lists of different lengths ended the command in a traceback."""
    assert len({len(each) for each in whirl_frequencies(pinned, 400_000.0, 200)}) == 1


def test_a_shaft_that_stands_responds_as_each_axis(spindle: SpindleAssembly) -> None:
    stiffer = with_stiffer_bearings(spindle, 1.3)
    found = rotating_receptance(spindle, stiffer, 1e-9, FREQUENCY_HZ)
    for axis, assembly in enumerate((spindle, stiffer)):
        assert found[:, axis, axis] == pytest.approx(own_receptance(assembly), rel=1e-8)
    assert np.abs(found[:, 0, 1]).max() < 1e-9 * np.abs(found[:, 0, 0]).max()


def with_stiffer_bearings(assembly: SpindleAssembly, factor: float) -> SpindleAssembly:
    supports = tuple(
        replace(each, properties=replace(each.properties, kt_n_per_m=factor * each.properties.kt_n_per_m))
        for each in assembly.shaft.supports
    )
    return replace(assembly, shaft=replace(assembly.shaft, supports=supports))


def own_receptance(assembly: SpindleAssembly) -> FloatArray:
    told = read_spindle(Path("simulated_machine"))
    return response(replace(told, shaft=assembly.shaft), "tool", FREQUENCY_HZ)  # type: ignore[return-value]


def test_each_axis_answers_the_other_with_the_opposite_sign(spindle: SpindleAssembly) -> None:
    found = rotating_receptance(spindle, spindle, 12_000.0, FREQUENCY_HZ)
    other_way = rotating_receptance(spindle, spindle, -12_000.0, FREQUENCY_HZ)
    assert found[:, 0, 0] == pytest.approx(found[:, 1, 1], rel=1e-9)
    assert found[:, 0, 1] == pytest.approx(-found[:, 1, 0], rel=1e-6)
    assert found[:, 0, 1] == pytest.approx(other_way[:, 1, 0], rel=1e-6)
    assert np.abs(found[:, 0, 1]).max() > 0.01 * np.abs(found[:, 0, 0]).max()


def test_both_whirls_are_peaks_of_the_response(spindle: SpindleAssembly) -> None:
    """One circular force meets one whirl: in its sense the response peaks at the other frequency than against it."""
    light = spinning(spindle.whole(), 0.0)
    against, along = whirl_frequencies(light, 12_000.0, 3)
    lines_hz = np.linspace(0.99 * against[2], 1.01 * along[2], 400)
    found = rotating_receptance(spindle, spindle, 12_000.0, lines_hz)
    with_m3 = np.abs(found[:, 0, 0] + 1j * found[:, 0, 1])
    against_m3 = np.abs(found[:, 0, 0] - 1j * found[:, 0, 1])
    apart_hz = abs(lines_hz[np.argmax(with_m3)] - lines_hz[np.argmax(against_m3)])
    assert apart_hz == pytest.approx(along[2] - against[2], rel=0.05)
