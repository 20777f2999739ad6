"""How the simulated machine's bearings change with its temperatures: a law of its own (made up, plausible).

A bearing's interference is 1 on the cold machine, grows as the shaft outgrows the housing and, less, as the bearing
itself warms, and settles where the race gives way. Stiffness goes with a power of the interference (Hertz contacts in
series with the housing), damping with interference and the lubricant's viscosity. The published spindle behaves
alike: stiffer when warm (a CFRP shaft grows in radius), with the two machine axes differing.
"""

from collections.abc import Mapping

import numpy as np

from drivers.sim.machine.heat import INDEX
from drivers.sim.spindle.spindle_beam import Spring
from models.records import FloatArray

COLD_DEGC = 20.0
AXIS_STIFFNESS: Mapping[str, float] = {"x": 0.82, "y": 1.0}
"""The housing is held less stiffly along X."""
_FRONT = ("shaft_front", "bearing_front", "housing_front")
_REAR = ("shaft_rear", "bearing_rear", "housing_rear")
_PLACES = (_FRONT, _FRONT, _FRONT, _FRONT, _REAR)
_COLD = (
    Spring(kt=1.5e5, ct=260.0, kr=3.4e6, cr=2.0),
    Spring(kt=1.5e5, ct=300.0, kr=3.1e6, cr=2.0),
    Spring(kt=9.0e7, ct=40.0, kr=2.0e3, cr=1.0),
    Spring(kt=8.4e7, ct=40.0, kr=2.0e3, cr=1.0),
    Spring(kt=4.2e7, ct=420.0, kr=9.0e4, cr=2.0),
)
"""The five bearings of the cold machine along Y, from the nose backwards."""
_GROWTH_PER_K = 0.055
_WARMTH_PER_K = 0.012
_MOST = 3.5
"""Interference towards which a hot bearing settles."""


def bearings(node_degc: FloatArray, axis: str) -> tuple[Spring, ...]:
    """Return the five bearings along an axis at the temperatures of all nodes [degC]."""
    found = []
    for cold, place in zip(_COLD, _PLACES, strict=True):
        shaft, bearing, housing = (float(node_degc[INDEX[name]]) for name in place)
        found.append(_bearing(cold, shaft, bearing, housing, AXIS_STIFFNESS[axis]))
    return tuple(found)


def nominal_bearings(axis: str) -> tuple[Spring, ...]:
    """Return the bearings with shaft and housing at 25 degC and 24 degC."""
    degc = np.full(len(INDEX), 24.0)
    for shaft, bearing, _ in _PLACES:
        degc[INDEX[shaft]] = degc[INDEX[bearing]] = 25.0
    return bearings(degc, axis)


def _bearing(cold: Spring, shaft_degc: float, bearing_degc: float, housing_degc: float, axis: float) -> Spring:
    growth = _GROWTH_PER_K * (shaft_degc - housing_degc) + _WARMTH_PER_K * (bearing_degc - COLD_DEGC)
    interference = _MOST * float(np.exp(-np.log(_MOST) * np.exp(-growth)))
    stiffness, viscosity = axis * interference**0.6, float(np.exp(-0.02 * (bearing_degc - COLD_DEGC)))
    return Spring(
        kt=cold.kt * stiffness,
        ct=cold.ct * axis * interference * viscosity,
        kr=cold.kr * axis * interference**0.25,
        cr=cold.cr * viscosity,
    )
