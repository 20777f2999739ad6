"""The plants of the zoo: networks of lumped heat nodes, worked by programmes of their own, in shops of their own.

Written for the zoo alone. It imports nothing of the product: neither the demo's simulator nor an estimator shares a
formula with it. All runs of a machine are integrated side by side, explicitly, in steps that its fastest node allows.

- Conduction between nodes, convection to the air inside or to the shop, with a film that grows with the cube root of
  the difference and, on what turns, with the speed.
- Bearings lose heat by the lubricant's torque, with (viscosity times speed) to the power 2/3 and a viscosity that
  falls as they warm, and by a torque that does not depend on speed. Motors lose iron heat with speed and copper heat
  with the square of a load that nobody records. Screws rub while the axes move, which nobody records either.
- A coolant tank with a chiller between two temperatures, a pump that turns with the machine, cutting fluid over bed and
  table while cutting, doors that are opened.
- A shop with a season, a day, a heating that works in shifts, a gate that is opened, and slow noise.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ZERO_DEGC = 20.0
"""Displacements count from this temperature."""

KINDS = {
    # capacity [kJ/K], time constant of a link to a heavier node [s], of convection [s]
    "quick": ((1.5, 5.0), (150.0, 800.0), (1200.0, 4000.0)),
    "middle": ((8.0, 30.0), (700.0, 3600.0), (2400.0, 10000.0)),
    "slow": ((60.0, 300.0), (3000.0, 14400.0), (7200.0, 21600.0)),
}
LAYOUTS: dict[str, tuple[dict[str, str], str]] = {
    "bench": (
        {
            "front": "quick",
            "rear": "quick",
            "shaft": "quick",
            "motor": "middle",
            "housing": "middle",
            "flange": "middle",
            "stand": "slow",
        },
        "front-shaft rear-shaft front-housing rear-housing motor-housing motor-shaft housing-flange flange-stand",
    ),
    "motor spindle": (
        {
            "front": "quick",
            "rear": "quick",
            "shaft": "quick",
            "rotor": "quick",
            "motor": "quick",
            "jacket": "middle",
            "nose": "quick",
            "flange": "middle",
            "head": "slow",
        },
        "front-shaft rear-shaft rotor-shaft rotor-motor motor-jacket front-jacket rear-jacket front-nose nose-shaft "
        "jacket-flange flange-head nose-flange",
    ),
    "mill": (
        {
            "front": "quick",
            "rear": "quick",
            "shaft": "quick",
            "motor": "middle",
            "housing": "middle",
            "head": "middle",
            "column top": "slow",
            "column": "slow",
            "column foot": "slow",
            "bed": "slow",
            "bed end": "slow",
            "table": "middle",
            "nut": "quick",
            "screw": "middle",
        },
        "front-shaft rear-shaft front-housing rear-housing motor-rear motor-head housing-head head-column~top "
        "column~top-column column-column~foot column~foot-bed bed-bed~end bed-table nut-screw nut-table screw-bed~end",
    ),
    "lathe": (
        {
            "front": "quick",
            "rear": "quick",
            "shaft": "middle",
            "chuck": "middle",
            "motor": "middle",
            "headstock": "slow",
            "bed left": "slow",
            "bed": "slow",
            "bed right": "slow",
            "slide": "middle",
            "turret": "middle",
            "nut": "quick",
            "screw": "middle",
        },
        "front-shaft rear-shaft shaft-chuck front-headstock rear-headstock motor-headstock headstock-bed~left "
        "bed~left-bed bed-bed~right bed-slide slide-turret nut-slide nut-screw screw-bed~right",
    ),
    "portal": (
        {
            "front": "quick",
            "rear": "quick",
            "shaft": "quick",
            "motor": "middle",
            "ram": "middle",
            "ram top": "middle",
            "beam left": "slow",
            "beam": "slow",
            "beam right": "slow",
            "column left": "slow",
            "column right": "slow",
            "bed": "slow",
            "table": "slow",
            "nut": "quick",
            "screw": "middle",
        },
        "front-shaft rear-shaft front-ram rear-ram motor-ram~top ram-ram~top ram-beam beam-beam~left beam-beam~right "
        "beam~left-column~left beam~right-column~right column~left-bed column~right-bed bed-table nut-screw nut-beam "
        "screw-beam~left",
    ),
}
"""Nodes and their kinds, and which of them touch."""
SOURCES = {"front": "bearing", "rear": "bearing", "motor": "motor", "rotor": "motor", "nut": "feed"}
COOLED = ("jacket", "housing", "motor", "headstock", "ram")
WASHED = ("table", "bed", "chuck", "turret", "slide")
INSIDE = ("front", "shaft", "chuck", "table", "nose", "turret", "slide", "nut", "ram", "flange")
TURNING = ("shaft", "nose", "chuck", "rotor")


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number, evenly spread in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Days:
    """What happens in each run: shape (n_steps, n_runs), on the grid of the integration."""

    step_s: float
    speed: Array
    """Spindle speed over the highest one."""
    load: Array
    feeding: Array
    door: Array
    washing: Array
    pump: Array
    shop_degc: Array
    heat_factor: Array
    """Of the bearings, shape (n_runs,): other than 1 after a change of preload or grease."""
    chiller_set_k: Array
    """Added to what the chiller is set to, shape (n_runs,)."""
    flow_factor: Array
    """Of the coolant's flow, shape (n_runs,)."""


@dataclass(slots=True, kw_only=True)
class Plant:
    """One machine."""

    nodes: list[str]
    capacity: Array
    """[J/K]"""
    conductance: Array
    """Between nodes [W/K], symmetric."""
    convection: Array
    """To the air around [W/K] at 4 K difference."""
    inside: NDArray[np.bool_]
    turning: Array
    """Added convection at the highest speed [W/K]."""
    sources: dict[int, tuple[str, float]]
    """Node -> kind and heat at the highest speed [W]."""
    cooling: Array
    """To the coolant while it flows [W/K]; zeros: no coolant."""
    washing: Array
    """To the cutting fluid [W/K]; zeros: dry."""
    tracks_shop: bool
    """The chiller follows the shop's temperature; else it keeps one of its own."""
    hysteresis_k: float
    pace: float = 1.0
    tank: int = field(init=False)
    air: int = field(init=False)

    def __post_init__(self) -> None:
        self.tank, self.air = len(self.nodes), len(self.nodes) + 1

    def step_s(self) -> float:
        """Return a step that the fastest node allows [s]."""
        rates = (self.conductance.sum(axis=1) + 2.0 * self.convection + self.turning + self.cooling + self.washing) / (
            self.capacity
        )
        return float(np.clip(0.4 / rates.max(), 2.0, 12.0))

    def temperatures(self, days: Days) -> Array:
        """Return temperatures [degC], shape (n_steps, n_runs, n_nodes + 3): nodes, coolant, air inside, shop."""
        steps, runs = days.speed.shape
        size, dt = len(self.nodes), days.step_s
        laplace = np.diag(self.conductance.sum(axis=1)) - self.conductance
        tank_j, air_w, air_j = 120e3, 25.0, 12e3
        nodes = np.tile(days.shop_degc[0][:, None], (1, size))
        tank, air = days.shop_degc[0].copy(), days.shop_degc[0].copy()
        chilling = np.zeros(runs, dtype=np.bool_)
        found = np.empty((steps, runs, size + 3))
        has_coolant = bool(self.cooling.any())
        chiller_w = 1.6 * sum(power for _, power in self.sources.values())
        inside_w = np.where(self.inside, self.convection, 0.0)
        for step in range(steps):
            shop, speed = days.shop_degc[step], days.speed[step]
            found[step, :, :size], found[step, :, self.tank], found[step, :, self.air] = nodes, tank, air
            found[step, :, -1] = shop
            around = np.where(self.inside, air[:, None], shop[:, None])
            gap = nodes - around
            film = self.convection * np.cbrt(np.abs(gap) / 4.0 + 0.05) + self.turning * np.sqrt(speed)[:, None]
            flow = -nodes @ laplace - film * gap
            for node, (kind, power) in self.sources.items():
                flow[:, node] += self._heat(kind, power, nodes[:, node], days, step)
            wet = days.washing[step][:, None] * self.washing * (nodes - shop[:, None])
            flow -= wet
            to_air = (film * gap * self.inside).sum(axis=1) if inside_w.any() else 0.0
            if has_coolant:
                cooled = (days.pump[step] * days.flow_factor)[:, None] * self.cooling * (nodes - tank[:, None])
                flow -= cooled
                wanted = (shop if self.tracks_shop else 22.0) + days.chiller_set_k
                chilling = np.where(tank > wanted + self.hysteresis_k, True, chilling)
                chilling = np.where(tank < wanted - self.hysteresis_k, False, chilling)
                chilling &= days.pump[step] > 0.0
                tank = tank + dt / tank_j * (cooled.sum(axis=1) - chilling * chiller_w - 8.0 * (tank - shop))
            exchange = air_w * (1.0 + 12.0 * days.door[step])
            air = air + dt / air_j * np.clip(to_air - exchange * (air - shop), -4e3, 4e3)
            nodes = nodes + dt / self.capacity * flow
        return found

    def _heat(self, kind: str, power: float, degc: Array, days: Days, step: int) -> Array:
        speed = days.speed[step]
        if kind == "feed":
            return power * days.feeding[step]
        if kind == "motor":
            return power * (0.55 * speed**1.3 + 0.45 * days.load[step] ** 2 * (speed > 0.0))
        viscosity = np.exp(-0.03 * (degc - ZERO_DEGC))
        return power * days.heat_factor * speed * (0.75 * np.cbrt(viscosity * speed) ** 2 + 0.25)


def make_plant(rng: np.random.Generator, layout: str, *, coolant: bool, wet: bool, pace: float, warm_k: float) -> Plant:
    """Return a machine of a layout; `pace` stretches its time constants, `warm_k` is how warm its sources get."""
    kinds, touching = LAYOUTS[layout]
    nodes = list(kinds)
    place = {name: index for index, name in enumerate(nodes)}
    capacity = np.array([1e3 * between(rng, *KINDS[kind][0]) for kind in kinds.values()])
    conductance = np.zeros((len(nodes), len(nodes)))
    for pair in touching.split():
        one, other = (place[name.replace("~", " ")] for name in pair.split("-"))
        lighter = min(one, other, key=lambda node: capacity[node])
        tau_s = pace * between(rng, *KINDS[kinds[nodes[lighter]]][1])
        conductance[one, other] = conductance[other, one] = capacity[lighter] / tau_s
    convection = np.array(
        [c / (pace * between(rng, *KINDS[kind][2])) for c, kind in zip(capacity, kinds.values(), strict=True)]
    )
    cooling = np.array([c / (pace * between(rng, 500.0, 2500.0)) if name in COOLED and coolant else 0.0
                        for name, c in zip(nodes, capacity, strict=True)])  # fmt: skip
    washing = np.array([c / (pace * between(rng, 1500.0, 7000.0)) if name in WASHED and wet else 0.0
                        for name, c in zip(nodes, capacity, strict=True)])  # fmt: skip
    turning = np.array([0.6 * g if name in TURNING else 0.0 for name, g in zip(nodes, convection, strict=True)])
    steady = np.linalg.inv(np.diag(conductance.sum(axis=1) + convection + cooling + 0.5 * turning) - conductance)
    sources = {
        place[name]: (
            kind,
            warm_k * rng.uniform(0.5, 1.0) * (0.4 if kind == "feed" else 1.0) / steady[place[name]][place[name]],
        )
        for name, kind in SOURCES.items()
        if name in place
    }
    return Plant(
        nodes=nodes,
        capacity=capacity,
        conductance=conductance,
        convection=convection,
        inside=np.array([name in INSIDE for name in nodes]),
        turning=turning,
        sources=sources,
        cooling=cooling,
        washing=washing,
        tracks_shop=bool(rng.random() < 0.5),
        hysteresis_k=float(rng.uniform(0.3, 1.5)),
        pace=pace,
    )


def shop_degc(rng: np.random.Generator, hours: Array, day: int, *, shifts: bool, swing_k: float) -> Array:
    """Return the shop's temperature over the hours since midnight of a day of the year, shape as `hours`."""
    season = 21.0 + 4.0 * np.sin(2.0 * np.pi * (day - 110) / 365.0)
    daily = swing_k * np.sin(2.0 * np.pi * (hours - 9.5) / 24.0) + rng.normal(0.0, 0.8)
    found = season + daily
    step_h = float(hours[1] - hours[0])
    if shifts:
        heated = ((hours % 24.0 > 5.5) & (hours % 24.0 < 22.0)).astype(np.float64)
        found = found + swing_k * lagged(heated, step_h, 1.2)
    noise = rng.normal(0.0, 1.0, len(hours))
    found = found + 0.3 * lagged(noise, step_h, 0.6) * np.sqrt(2.0 * 0.6 / step_h)
    gate = np.zeros(len(hours))
    for begin in rng.uniform(hours[0], hours[-1], rng.poisson((hours[-1] - hours[0]) / 6.0)):
        gate[(hours >= begin) & (hours < begin + rng.uniform(0.05, 0.3))] = 1.0
    return np.asarray(found - rng.uniform(1.0, 4.0) * lagged(gate, step_h, 0.25))


def lagged(values: Array, step: float, tau: float) -> Array:
    """Return a first-order lag along the first axis, at rest before it begins."""
    share = -np.expm1(-step / np.maximum(tau, 1e-9))
    found = np.empty_like(values)
    state = values[0]
    for row in range(len(values)):
        state = state + share * (values[row] - state)
        found[row] = state
    return found
