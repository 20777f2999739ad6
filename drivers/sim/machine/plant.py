"""The thermal network of the simulated machine.

The linear part, C dT/dt = -K T + q, is solved exactly over a step with q held constant (K is
symmetric: its eigenvectors, found once per state of the chiller, give the exponential for any
step). The mildly non-linear rest and the heat sources stand in q and are taken at the start of
the step, which is stable for the steps of at most 10 s used here.
"""

import numpy as np

from drivers.sim.machine.day import Ambient, Day
from drivers.sim.machine.heat import INDEX, Drive, HeatSources
from drivers.sim.machine.parameters import AIR_LINKS, LINKS, NODES, OIL_LINKS, OUTSIDE_LINKS, Link
from models.records import FloatArray

MAX_STEP_S = 10.0
"""Longest step of the physics [s]."""


class _Modes:
    """Exact solution of the linear network for one state of the chiller."""

    def __init__(self, conductance: FloatArray, capacity_j_per_k: FloatArray) -> None:
        root = np.sqrt(capacity_j_per_k)
        rates, vectors = np.linalg.eigh(conductance / root[:, None] / root[None, :])
        self._rates_per_s = rates
        self._to_modes = vectors.T * root
        self._heat_to_modes = vectors.T / root
        self._from_modes = vectors / root[:, None]

    def advance(self, degc: FloatArray, heat_w: FloatArray, duration_s: float) -> FloatArray:
        """Return the temperatures [degC] after `duration_s` [s] under constant heat [W]."""
        loss = -np.expm1(-self._rates_per_s * duration_s)
        modes = self._to_modes @ degc
        modes += loss * ((self._heat_to_modes @ heat_w) / self._rates_per_s - modes)
        temperatures: FloatArray = self._from_modes @ modes
        return temperatures


class Plant:
    """Temperatures of one machine on one day; holds no state but its parameters."""

    def __init__(self, day: Day) -> None:
        self.day = day
        self.ambient = Ambient(day.ambient)
        capacity = np.array([node.capacity_kj_per_k * 1000.0 for node in NODES.values()])
        capacity = capacity * np.array([day.capacity_factors[name] for name in NODES])
        factors = day.conductance_factors
        running = (*LINKS, *OIL_LINKS)
        self._modes = {
            False: _Modes(_conductance(LINKS, factors), capacity),
            True: _Modes(_conductance(running, factors), capacity),
        }
        self._heat = HeatSources(day.heat_factors, day.chiller_set_degc)
        self._outside = np.zeros(len(NODES))
        for name, w_per_k in OUTSIDE_LINKS.items():
            self._outside[INDEX[name]] = w_per_k * factors[f"{name}-outside"]

    def advance(self, degc: FloatArray, *, time_s: float, duration_s: float, drive: Drive) -> FloatArray:
        """Return the temperatures [degC] of all nodes `duration_s` (at most 10 s) after `time_s` [s]."""
        if not 0.0 <= duration_s <= MAX_STEP_S + 1e-6:
            raise ValueError(f"a step of {duration_s} s is outside 0..{MAX_STEP_S} s")
        outside_degc = self.ambient.outside_degc(time_s + 0.5 * duration_s)
        heat_w = self._heat.watts(degc, drive) + self._outside * outside_degc
        return self._modes[drive.chiller].advance(degc, heat_w, duration_s)

    def cold(self) -> FloatArray:
        """Return the temperatures [degC] of a machine that stood switched off for days."""
        outside_degc = self.ambient.outside_degc(0.0)
        return outside_degc + np.array([self.day.start_deviation_k[name] for name in NODES])


def _conductance(links: tuple[Link, ...], factors: dict[str, float]) -> FloatArray:
    matrix = np.zeros((len(NODES), len(NODES)))
    for link in links:
        _join(matrix, link.first, link.second, link.w_per_k * factors[f"{link.first}-{link.second}"])
    for name, (w_per_k, low) in AIR_LINKS.items():
        scaled = w_per_k * factors[f"{name}-air"]
        _join(matrix, name, "air_low", scaled * low)
        _join(matrix, name, "air_high", scaled * (1.0 - low))
    for name, w_per_k in OUTSIDE_LINKS.items():
        matrix[INDEX[name], INDEX[name]] += w_per_k * factors[f"{name}-outside"]
    return matrix


def _join(matrix: FloatArray, first: str, second: str, w_per_k: float) -> None:
    i, j = INDEX[first], INDEX[second]
    matrix[i, i] += w_per_k
    matrix[j, j] += w_per_k
    matrix[i, j] -= w_per_k
    matrix[j, i] -= w_per_k
