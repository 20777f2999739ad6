"""Heat sources of the simulated machine and the heat flows that are not linear in temperature.

Laws (n: spindle speed over 12000 1/min, all heat in watts):

- bearing friction P = P12 n^1.5 (1 + k_p (T_shaft - T_housing)) exp(-k_v (T_bearing - 30 degC)):
  speed, preload that grows as the shaft grows into its bearings, and the lubricant's viscosity;
- drag of air, oil mist and rotor, P = P12 n^3;
- motor stator P = P0 + P12 n^3 (excitation at standstill, iron and copper losses);
- natural convection: the linear conductance to the enclosure's air holds at 4 K difference, the
  rest of G dT (|dT|/4 K)^0.25 is added here; a rotating surface adds G_r n^0.7 dT;
- seat between housing and cast metal: conducts better as the housing grows into it.
"""

from dataclasses import dataclass

import numpy as np

from drivers.sim.machine.parameters import AIR_LINKS, NODES
from drivers.sim.nc.program import RATED_SPEED_RPM
from models.records import FloatArray

INDEX: dict[str, int] = {name: index for index, name in enumerate(NODES)}
"""Position of each node in the vector of temperatures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """What the machine does during one step."""

    spindle_speed_rpm: float
    chiller: bool
    feeding: bool
    powered: bool = True


SOURCES: dict[str, float] = {
    "bearing_front_friction": 17.3,
    "bearing_rear_friction": 15.0,
    "front_drag": 76.6,
    "rotor_drag": 105.0,
    "rear_drag": 20.0,
    "stator": 317.0,
    "stator_standstill": 39.7,
    "feed_motors": 40.0,
    "holding_motors": 45.0,
    "feed_friction": 30.0,
    "enclosure": 365.0,
    "pump": 150.0,
}
"""Heat at full speed or while active [W]: friction and drag of a 26 kW spindle without load, servo motors at
rest and in feed, cabinet and lamps in the enclosure, oil pump; chosen, then tuned to the published behaviour."""
PRELOAD_PER_K = 0.035
"""Growth of bearing friction per kelvin of the shaft over the housing (chosen)."""
VISCOSITY_PER_K = 0.012
"""Fall of bearing friction per kelvin (about that of a light oil; chosen)."""
SEAT_PER_K = 0.06
"""Growth of the seat's conductance per kelvin of the housing over the cast metal (chosen)."""
ROTATING_W_PER_K: dict[str, float] = {"nose": 1.0, "test_bar": 1.0, "tool": 0.8}
"""Added conductance to the air at full speed (chosen; bar of 32 mm by 300 mm, about 35 W/(m2 K))."""
NATURAL_SHARE = 0.5
"""Share of the conductance to air that is natural convection, the rest is radiation (chosen)."""
CHILLER_W_PER_K = 1500.0
"""Proportional band of the chiller: heat withdrawn per kelvin above its set temperature (chosen)."""
CHILLER_LIMIT_W = 3500.0
"""Largest heat that the chiller withdraws (chosen)."""
_HOLDING = {"y_motor": 0.6, "z_motor": 0.2, "x_motor": 0.2}
_FEED_MOTORS = {"y_motor": 0.35, "z_motor": 0.35, "x_motor": 0.3}
_FEED_FRICTION = {
    "x_screw": 0.2,
    "y_screw": 0.2,
    "slider_bottom": 0.2,
    "saddle_front": 0.1,
    "saddle_back": 0.1,
    "ram_bottom": 0.1,
    "a_motor": 0.1,
}
_SEATS = (
    ("housing_rear", "cast_rear_top"),
    ("housing_rear", "cast_middle_top"),
    ("housing_front", "cast_middle_top"),
    ("housing_front", "cast_front_top"),
)
_SEAT_W_PER_K = 3.43
"""What a seat conducts beyond its linear part when the housing is much warmer (tuned) [W/K]."""


def per_node(shares: dict[str, float]) -> FloatArray:
    """Return a number for each node, 0 where none is given."""
    vector = np.zeros(len(NODES))
    for name, share in shares.items():
        vector[INDEX[name]] = share
    return vector


class HeatSources:
    """Evaluates all heat flows that the linear network does not hold."""

    def __init__(self, factors: dict[str, float], chiller_set_degc: float) -> None:
        watts = {name: watt * factors.get(name, 1.0) for name, watt in SOURCES.items()}
        self._watts = watts
        self._set_degc = chiller_set_degc
        self._powered = (
            per_node(_HOLDING) * watts["holding_motors"]
            + per_node({"stator": watts["stator_standstill"]})
            + per_node({"air_low": 0.4, "air_high": 0.6}) * watts["enclosure"]
        )
        self._feeding = (
            per_node(_FEED_MOTORS) * watts["feed_motors"] + per_node(_FEED_FRICTION) * watts["feed_friction"]
        )
        self._cubic = per_node(
            {
                "shaft_front": 0.75 * watts["front_drag"],
                "bearing_front": 0.25 * watts["front_drag"],
                "shaft_rotor": watts["rotor_drag"],
                "shaft_rear": watts["rear_drag"],
                "stator": watts["stator"],
            }
        )
        self._surface = np.array([INDEX[name] for name in AIR_LINKS])
        self._natural = np.array([w_per_k for w_per_k, _ in AIR_LINKS.values()]) * NATURAL_SHARE
        self._low_share = np.array([low for _, low in AIR_LINKS.values()])
        self._rotating = np.array([ROTATING_W_PER_K.get(name, 0.0) for name in AIR_LINKS])

    def watts(self, degc: FloatArray, drive: Drive) -> FloatArray:
        """Return the heat into each node [W] at the temperatures `degc` [degC]."""
        speed = drive.spindle_speed_rpm / RATED_SPEED_RPM
        heat = np.zeros_like(degc)
        if drive.powered:
            heat += self._powered
        if drive.feeding:
            heat += self._feeding
        if speed > 0:
            heat += self._cubic * speed**3
            self._add_friction(heat, degc, speed)
        if drive.chiller:
            above_k = degc[INDEX["oil"]] - self._set_degc
            heat[INDEX["oil"]] += self._watts["pump"] - min(max(CHILLER_W_PER_K * above_k, 0.0), CHILLER_LIMIT_W)
        self._add_convection(heat, degc, speed)
        self._add_seats(heat, degc)
        return heat

    def _add_friction(self, heat: FloatArray, degc: FloatArray, speed: float) -> None:
        for bearing, shaft, housing in (
            ("bearing_front", "shaft_front", "housing_front"),
            ("bearing_rear", "shaft_rear", "housing_rear"),
        ):
            preload = 1.0 + PRELOAD_PER_K * max(float(degc[INDEX[shaft]] - degc[INDEX[housing]]), 0.0)
            viscosity = float(np.exp(-VISCOSITY_PER_K * (degc[INDEX[bearing]] - 30.0)))
            friction_w = self._watts[f"{bearing}_friction"] * speed**1.5 * preload * viscosity
            heat[INDEX[bearing]] += 0.6 * friction_w
            heat[INDEX[shaft]] += 0.4 * friction_w

    def _add_convection(self, heat: FloatArray, degc: FloatArray, speed: float) -> None:
        low, high = INDEX["air_low"], INDEX["air_high"]
        air_degc = self._low_share * degc[low] + (1.0 - self._low_share) * degc[high]
        over_k = degc[self._surface] - air_degc
        conductance = self._natural * (np.sqrt(np.sqrt(np.abs(over_k) / 4.0)) - 1.0)
        if speed > 0:
            conductance = conductance + self._rotating * speed**0.7
        flow = conductance * over_k
        heat[self._surface] -= flow
        heat[low] += flow @ self._low_share
        heat[high] += flow @ (1.0 - self._low_share)

    @staticmethod
    def _add_seats(heat: FloatArray, degc: FloatArray) -> None:
        for housing, cast in _SEATS:
            over_k = float(degc[INDEX[housing]] - degc[INDEX[cast]])
            flow = _SEAT_W_PER_K * float(np.tanh(SEAT_PER_K * over_k)) * over_k
            heat[INDEX[housing]] -= flow
            heat[INDEX[cast]] += flow
