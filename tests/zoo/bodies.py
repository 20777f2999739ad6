"""Machines as bodies of many cells, of kinds that the zoo of lumped nodes does not have; writes their recordings.

    .venv/bin/python tests/zoo/bodies.py FOLDER [--half choosing|judging] [--only KIND,...]

Heat is conducted between neighbouring cells of a cut through the machine (rings of a spindle, a C-frame), convected at
its faces, and integrated implicitly. What the zoo has not: bearings whose preload follows the difference of their
rings, an oil jacket whose chiller switches, heat across an air gap that depends on speed, distortion as expansion and
bending along the loop from table to tool. No formula of the product or of its simulator is used. Of each kind seeds 1
and 2 serve for choosing, 3 and 4 for judging.
"""

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEEL = (7850.0 * 470.0, 45.0, 11.5)
CAST = (7200.0 * 500.0, 48.0, 10.5)
"""Heat capacity [J/(m^3 K)], conductivity [W/(m K)], expansion [um/(m K)]."""
HALVES = {"choosing": (1, 2), "judging": (3, 4)}


@dataclass(kw_only=True)
class Body:
    """Cells, what joins them, and where heat comes in."""

    capacity: Array
    """[J/K], shape (n,)."""
    links: list[tuple[int, int, float]] = field(default_factory=list)
    """Two cells and what is conducted between them [W/K]."""
    air: Array
    """What is convected at each cell to the shop [W/K]."""
    gap: list[tuple[int, int, float]] = field(default_factory=list)
    """Links across an air gap: nothing at standstill, so much at full speed [W/K]."""
    inner: list[int] = field(default_factory=list)
    outer: list[int] = field(default_factory=list)
    """Rings of each bearing."""
    motor: list[int] = field(default_factory=list)
    jacket: list[int] = field(default_factory=list)
    wet: list[int] = field(default_factory=list)
    """Cells that coolant or an open door reaches."""
    place: dict[str, list[int]] = field(default_factory=dict)
    """Cells of each stretch of the loop, for the distortion."""
    skin: list[int] = field(default_factory=list)
    """Cells that a sensor may sit on."""

    def matrix(self, speed: float, wet: float) -> Array:
        """Return the conductances at a share of full speed, and so much beyond still air on what is wet [W/K]."""
        count = len(self.capacity)
        found = np.zeros((count, count))
        joined = [*self.links, *((i, j, g * speed) for i, j, g in self.gap)]
        for i, j, g in joined:
            found[i, i] += g
            found[j, j] += g
            found[i, j] -= g
            found[j, i] -= g
        air = self.air.copy()
        air[self.wet] *= 1.0 + wet
        found[np.arange(count), np.arange(count)] += air
        return found


def spindle(rng: np.random.Generator, size: float) -> Body:
    """Return rings of a shaft and a housing, 5 by 14, `size` [m] long."""
    layers, slices = 5, 14
    radius = size * np.array([0.03, 0.09, 0.13, 0.20, 0.27, 0.36])
    length = size / slices
    cell = np.arange(layers * slices).reshape(slices, layers)
    volume = np.pi * (radius[1:] ** 2 - radius[:-1] ** 2) * length
    body = Body(capacity=np.tile(volume * STEEL[0], slices), air=np.zeros(layers * slices))
    bearings = (1, 2, slices - 3)
    for z in range(slices):
        for r in range(layers):
            if z + 1 < slices:
                body.links.append((cell[z, r], cell[z + 1, r], STEEL[1] * volume[r] / length**2))
            if r + 1 < layers:
                g = STEEL[1] * 2.0 * np.pi * radius[r + 1] * length / (0.5 * (radius[r + 2] - radius[r]))
                if r != 1:
                    body.links.append((cell[z, r], cell[z, r + 1], g))
                elif z in bearings:
                    body.links.append((cell[z, r], cell[z, r + 1], g * rng.uniform(0.2, 0.6)))
                else:
                    body.gap.append((cell[z, r], cell[z, r + 1], g * rng.uniform(0.02, 0.06)))
        body.air[cell[z, -1]] = rng.uniform(8.0, 20.0) * 2.0 * np.pi * radius[-1] * length
    body.air[cell[0]] += rng.uniform(20.0, 60.0) * volume / length
    body.inner = [int(cell[z, 1]) for z in bearings]
    body.outer = [int(cell[z, 2]) for z in bearings]
    body.motor = [int(cell[z, r]) for z in (6, 7, 8) for r in (1, 2)]
    body.jacket = [int(cell[z, 3]) for z in range(3, 11)]
    body.place = {
        "shaft": cell[:9, :2].ravel().tolist(),
        "housing": cell[:9, 2:].ravel().tolist(),
        "upper": cell[:, 4].tolist(),
        "nose": cell[:3, 2:4].ravel().tolist(),
    }
    body.wet = cell[0].tolist()
    body.skin = [*cell[:, 4].tolist(), *cell[:, 3].tolist(), *body.outer]
    return body


def frame(rng: np.random.Generator, size: float) -> Body:
    """Return a C-frame (bed, column, head) of 16 by 14 cells, `size` [m] high, with a spindle in its head."""
    edge, deep = size / 14.0, 0.25 * size
    mask = np.full((16, 14), -1)
    filled = np.zeros((16, 14), dtype=np.bool_)
    filled[:, :3] = filled[9:13, 3:] = filled[4:9, 9:12] = True  # bed, column, and the head that hangs on it
    mask[filled] = np.arange(filled.sum())
    spin = spindle(rng, 0.3 * size)
    count = int(filled.sum())
    hollow = rng.uniform(0.15, 0.35)
    capacity = np.concatenate([np.full(count, edge * edge * deep * CAST[0] * hollow), spin.capacity])
    body = Body(capacity=capacity, air=np.concatenate([np.zeros(count), spin.air]))
    film = rng.uniform(5.0, 12.0)
    for x in range(16):
        for z in range(14):
            if mask[x, z] < 0:
                continue
            faces = 2.0 * hollow
            for dx, dz in ((1, 0), (0, 1), (-1, 0), (0, -1)):
                a, b = x + dx, z + dz
                if not (0 <= a < 16 and 0 <= b < 14) or mask[a, b] < 0:
                    faces += 1.0
                elif dx + dz > 0:
                    body.links.append((int(mask[x, z]), int(mask[a, b]), CAST[1] * deep * hollow))
            body.air[mask[x, z]] = film * edge * deep * faces
    head, column = mask[4:9, 9:12].ravel().tolist(), mask[9:13, 3:].ravel().tolist()
    for name in ("links", "gap"):
        getattr(body, name).extend((i + count, j + count, g) for i, j, g in getattr(spin, name))
    flange = [cell + count for cell in spin.place["upper"]]
    for i, cell in enumerate(flange):
        body.links.append((cell, head[i % len(head)], rng.uniform(2.0, 6.0)))
    for name in ("inner", "outer", "motor", "jacket"):
        setattr(body, name, [cell + count for cell in getattr(spin, name)])
    bed = mask[:, :3].ravel().tolist()
    body.place = {name: [c + count for c in cells] for name, cells in spin.place.items()}
    body.place |= {"head": head, "bed": bed, "front": mask[9, 3:].tolist()}
    body.place |= {"back": mask[12, 3:].tolist(), "column": column}
    body.wet = bed[: len(bed) // 2]
    body.skin = [*bed, *column, *head, *[c + count for c in spin.skin]]
    return body


@dataclass(frozen=True, kw_only=True)
class Kind:
    """What a kind of machine is recorded like."""

    runs: int
    hours: tuple[float, float]
    sample_s: float
    sensors: tuple[int, int]
    rpm: tuple[float, float]
    """Lowest and highest speed while it turns [1/min]."""
    size: float
    """[m]."""
    full: bool = False
    """A whole machine; else a spindle."""
    dwell_min: tuple[float, float] = (20.0, 60.0)
    """How long a speed lasts."""
    on: float = 0.7
    """Share of the time in which it turns."""
    watts: float = 600.0
    swing_k: float = 1.0
    traits: frozenset[str] = frozenset()
    channels: int = 3


KINDS = {
    "warmup": Kind(
        runs=5, hours=(1.217, 1.217), sample_s=10.0, sensors=(22, 22), rpm=(2000.0, 8000.0), size=0.7,
        dwell_min=(80.0, 80.0), on=1.0, watts=1500.0, traits=frozenset({"rises", "tenth"}),
    ),
    "quick": Kind(
        runs=11, hours=(0.7, 2.5), sample_s=5.0, sensors=(6, 10), rpm=(18000.0, 24000.0), size=0.28,
        dwell_min=(6.0, 25.0), on=0.75, watts=250.0, traits=frozenset({"tenth", "chiller", "pull"}),
    ),
    "lathe": Kind(
        runs=18, hours=(9.0, 23.0), sample_s=60.0, sensors=(10, 18), rpm=(400.0, 3500.0), size=1.6, full=True,
        dwell_min=(5.0, 90.0), on=0.4, watts=150.0, swing_k=5.0,
        traits=frozenset({"tenth", "regime", "doors", "shifts", "stays"}),
    ),
    "mill": Kind(
        runs=7, hours=(4.0, 9.0), sample_s=30.0, sensors=(18, 40), rpm=(1000.0, 12000.0), size=2.0, full=True,
        dwell_min=(10.0, 90.0), on=0.6, watts=500.0, swing_k=2.0, traits=frozenset({"chiller", "doors", "stays"}),
    ),
    "grinder": Kind(
        runs=4, hours=(2.5, 4.0), sample_s=20.0, sensors=(8, 14), rpm=(1500.0, 6000.0), size=0.9,
        dwell_min=(15.0, 60.0), on=0.7, watts=900.0, swing_k=1.5, traits=frozenset({"doors", "nospeed"}), channels=2,
    ),
}  # fmt: skip


def walk(rng: np.random.Generator, steps: int, step_s: float, hours: float) -> Array:
    """Return slow noise of unit deviation and of a correlation time [h]."""
    keep = np.exp(-step_s / (hours * 3600.0))
    found = np.empty(steps)
    now = rng.normal()
    for index, kick in enumerate(rng.normal(0.0, np.sqrt(1.0 - keep**2), steps)):
        now = keep * now + kick
        found[index] = now
    return found


def programme(rng: np.random.Generator, kind: Kind, steps: int, step_s: float) -> Array:
    """Return the speed [1/min] of each step; it stands still at first, for a minute."""
    found = np.zeros(steps)
    at = round(60.0 / step_s)
    while at < steps:
        for turns in (True, False):
            share = 1.0 if turns else (1.0 - kind.on) / max(kind.on, 0.05)
            last = at + max(1, round(60.0 * share * rng.uniform(*kind.dwell_min) / step_s))
            if turns or rng.random() < 0.6:
                found[at:last] = np.round(rng.uniform(*kind.rpm), -1) if turns else 0.0
                at = last
    return found


@dataclass(kw_only=True)
class Run:
    """What happened in one recording."""

    speed_rpm: Array
    shop_degc: Array
    wet: Array
    setpoint_degc: float


def day(rng: np.random.Generator, kind: Kind, number: int, step_s: float, level: float) -> Run:
    """Return what happens in one recording."""
    steps = round(3600.0 * rng.uniform(*kind.hours) / step_s)
    hours = np.arange(steps) * step_s / 3600.0
    start = rng.uniform(5.0, 9.0)
    shop = level + 0.5 * kind.swing_k * np.sin(2.0 * np.pi * (hours + start - 9.0) / 24.0)
    shop += 0.15 * kind.swing_k * walk(rng, steps, step_s, 1.5)
    wet = np.zeros(steps)
    if "shifts" in kind.traits:
        shop += 1.5 * ((hours + start) % 24.0 > 6.0) * ((hours + start) % 24.0 < 22.0)
    if "doors" in kind.traits:
        for _ in range(rng.poisson(0.35 * hours[-1])):
            begin = rng.uniform(0.0, hours[-1])
            inside = (hours > begin) & (hours < begin + rng.uniform(0.05, 0.5))
            shop[inside] -= rng.uniform(0.5, 3.0)
            wet[inside] = rng.choice([0.0, 3.0])
    return Run(
        speed_rpm=programme(rng, kind, steps, step_s),
        shop_degc=shop,
        wet=wet,
        setpoint_degc=22.0 + rng.normal(0.0, 0.3),
    )


class Machine:
    """One machine: its body, and the states that last from run to run."""

    def __init__(self, name: str, seed: int) -> None:
        self.kind, self.name = KINDS[name], f"{name}{seed}"
        self.rng = rng = np.random.default_rng([seed, sum(map(ord, name)), 4711])
        kind = self.kind
        self.body = (frame if kind.full else spindle)(rng, kind.size * rng.uniform(0.85, 1.2))
        self.watts = kind.watts * rng.uniform(0.7, 1.3) / len(self.body.inner)
        self.feedback = rng.uniform(0.01, 0.04)
        """Preload gained by each K of difference of the rings."""
        self.iron = rng.uniform(0.2, 0.6) * kind.watts
        count = int(rng.integers(kind.sensors[0], kind.sensors[1] + 1))
        self.cells = rng.choice(self.body.skin, count - 2, replace=len(self.body.skin) < count - 2)
        self.lag_s = rng.uniform(5.0, 60.0, count)
        self.level = rng.uniform(18.0, 24.0)
        self.step_s = min(kind.sample_s, 30.0)
        expansion = STEEL[2] * kind.size * (0.1 if kind.full else 0.5)
        self.shares = {
            place: rng.normal(0.0, 0.5, kind.channels) * expansion for place in self.body.place if place != "shaft"
        }
        self.shares["shaft"] = np.r_[rng.normal(0.0, 0.1, kind.channels - 1), 0.9] * expansion
        self.pull_um = rng.uniform(2.0, 6.0) * (np.arange(kind.channels) == kind.channels - 1)
        self.inverse: dict[tuple[float, float], Array] = {}

    def solve(self, speed: float, wet: float) -> Array:
        """Return what one implicit step does to temperatures, and to heat over capacity."""
        key = (round(4.0 * speed) / 4.0, wet)
        if key not in self.inverse:
            conducted = self.body.matrix(*key) / self.body.capacity[:, None]
            self.inverse[key] = np.asarray(
                np.linalg.inv(np.eye(len(conducted)) + self.step_s * conducted), dtype=np.float64
            )
        return self.inverse[key]

    def temperatures(self, run: Run, degc: Array) -> Array:
        """Return the temperatures of all cells, step by step; from `degc` on."""
        kind, body, step = self.kind, self.body, self.step_s
        oil, cools, found = run.setpoint_degc, False, np.empty((len(run.speed_rpm), len(degc)))
        air = body.air.copy()
        for index, rpm in enumerate(run.speed_rpm):
            found[index] = degc
            share = rpm / kind.rpm[1]
            heat = np.zeros(len(degc))
            if rpm:
                outer, inner = degc[body.outer], degc[body.inner]
                preload = np.clip(1.0 + self.feedback * (inner - outer) + 0.4 * share**2, 0.4, 3.0)
                oil_film = np.exp(-0.025 * (outer - 30.0)) ** (2.0 / 3.0)
                watts = self.watts * (0.5 * share ** (5.0 / 3.0) * oil_film + 0.5 * share * preload)
                heat[body.inner] += 0.5 * watts
                heat[body.outer] += 0.5 * watts
                heat[body.motor] += self.iron * share**1.5 / len(body.motor)
            if "chiller" in kind.traits:
                taken = 18.0 * (degc[body.jacket] - oil)
                heat[body.jacket] -= taken * (0.2 + 0.8 * (rpm > 0))
                cools = oil > run.setpoint_degc + (-1.0 if cools else 1.0)
                oil += step * (taken.sum() * (0.2 + 0.8 * (rpm > 0)) - cools * 2.5 * kind.watts + 40.0) / 60e3
            air[:] = body.air
            air[body.wet] *= 1.0 + run.wet[index]
            sunk = heat + air * run.shop_degc[index]
            degc = self.solve(share, float(run.wet[index])) @ (degc + step * sunk / body.capacity)
        return found

    def distortion_um(self, cells: Array, rpm: Array) -> Array:
        """Return the displacement of each channel [um] since 20 degC."""
        total = np.zeros((len(cells), self.kind.channels))
        for place, share in self.shares.items():
            total += (cells[:, self.body.place[place]].mean(axis=1) - 20.0)[:, None] * share
        if "pull" in self.kind.traits:
            total -= np.square(rpm / self.kind.rpm[1])[:, None] * self.pull_um
        return total

    def recordings(self) -> list[tuple[list[str], Array]]:
        """Return the columns and rows of each recording."""
        rng, kind = self.rng, self.kind
        found = []
        degc = np.full(len(self.body.capacity), self.level)
        for number in range(kind.runs):
            run = day(rng, kind, number, self.step_s, self.level + 0.3 * kind.swing_k * rng.normal())
            if not ("stays" in kind.traits and number):
                degc = np.full(len(degc), run.shop_degc[0]) + rng.uniform(0.0, 0.3)
            if number == 11 and "regime" in kind.traits:  # another drive belt, other mounts
                self.watts *= 1.4
                self.shares["bed"] = self.shares["bed"] * 0.6
            cells = self.temperatures(run, degc)
            rest = np.exp(-rng.uniform(6.0, 14.0) / 8.0)
            degc = run.shop_degc[-1] + rest * (cells[-1] - run.shop_degc[-1])
            every = round(kind.sample_s / self.step_s)
            found.append(self.measured(run, cells, every))
        return found

    def measured(self, run: Run, cells: Array, every: int) -> tuple[list[str], Array]:
        """Return a recording as its file has it."""
        rng, kind = self.rng, self.kind
        seen = np.column_stack([cells[:, self.cells], run.shop_degc, run.shop_degc + 0.3])
        for column, lag in enumerate(self.lag_s):
            keep = np.exp(-self.step_s / lag)
            now = seen[0, column]
            for index in range(len(seen)):
                now = keep * now + (1.0 - keep) * seen[index, column]
                seen[index, column] = now
        seen += rng.normal(0.0, 0.03, seen.shape)
        if "rises" in kind.traits:
            seen -= seen[0]
        seen = np.round(seen, 1 if "tenth" in kind.traits else 2)
        um = self.distortion_um(cells, run.speed_rpm)
        um += -um[0] + rng.uniform(-30.0, 30.0, um.shape[1]) + rng.normal(0.0, 0.1, um.shape)
        columns = ["time_s", *(f"T{n + 1}" for n in range(seen.shape[1])), *("XYZ"[-kind.channels :])]
        table = np.column_stack([np.arange(len(um)) * self.step_s, seen, np.round(um, 2)])
        if "nospeed" not in kind.traits:
            columns.insert(1, "spindle_speed_rpm")
            table = np.insert(table, 1, run.speed_rpm, axis=1)
        return columns, table[::every]


def write(name: str, seed: int, folder: Path) -> Path:
    """Write the recordings of a machine, and their map, into a folder of its name; return that."""
    machine = Machine(name, seed)
    place = folder / machine.name
    place.mkdir(parents=True, exist_ok=True)
    for number, (columns, table) in enumerate(machine.recordings(), start=1):
        np.savetxt(place / f"run{number:02}.csv", table, "%.10g", ",", header=",".join(columns), comments="")
    speed = "" if "nospeed" in machine.kind.traits else "speed: spindle_speed_rpm\n"
    text = f'time: time_s\n{speed}temperatures: ["T*"]\ndisplacements: ["[XYZ]"]\n'
    (place / "map.yaml").write_text(text, encoding="utf-8")
    return place


def main() -> None:
    """Write the machines that are asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--half", choices=HALVES)
    parser.add_argument("--only", help="these kinds, separated by commas")
    wanted = parser.parse_args()
    for half in [wanted.half] if wanted.half else HALVES:
        for name in wanted.only.split(",") if wanted.only else KINDS:
            for seed in HALVES[half]:
                print(half, write(name, seed, wanted.folder))


if __name__ == "__main__":
    main()
