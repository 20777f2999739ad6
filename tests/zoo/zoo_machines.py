"""The machines of the zoo, and their recordings, as the project reads them: one seed makes them all.

Every machine is a row of `ROSTER`. Its half is fixed there: what is chosen (families, lags, rules) is chosen on the
half `tuning`; the half `judging` is looked at when it is done. The three analogues of recordings that failed belong to
`judging`; they were made without those recordings, from what is said about them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from zoo_plant import ZERO_DEGC, Array, Days, Plant, between, lagged, make_plant, shop_degc

from drivers.files.recording_csv import write_recording
from models.recordings.dataset import Recording

SEED = 1
BEFORE_H = 8.0
"""The plant runs so long before each recording [h]: nobody records where the heat in it came from."""
ORDER = 1_000_003


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """What a machine is like, and how it was recorded."""

    number: int
    half: str
    layout: str
    runs: int
    hours: tuple[float, float]
    sample_s: float
    sensors: int
    quantum_k: float
    programme: str
    rpm: float
    error_um: float
    """How far a channel typically moves."""
    traits: frozenset[str]

    @property
    def name(self) -> str:
        """Return the folder's name."""
        return f"m{self.number:02}-{self.layout.replace(' ', '-')}"


# half, layout, runs, hours of a run, sampling [s], sensors, resolution [K], programme, 1/min, um, what is odd
_ROWS = """
tuning  | bench         |  5 |  2-4   |  10 |   8 | 0.1  | steps  |  6000 | 15 |
judging | bench         |  6 |  2-5   |  15 |  10 | 0.1  | steps  |  8000 | 12 |
tuning  | motor spindle |  8 |  1-2   |   5 |  12 | 0.01 | steps  | 24000 | 10 | coolant fast
judging | motor spindle | 10 | 0.7-1.5|   2 |  10 | 0.1  | steps  | 20000 |  9 | coolant fast jump
tuning  | mill          | 10 |  3-6   |  30 |  16 | 0.1  | work   | 10000 | 30 | doors shifts warm
judging | mill          | 12 |  3-6   |  30 |  20 | 0.1  | work   | 12000 | 35 | doors shifts warm wet
tuning  | lathe         | 14 |  5-9   |  60 |  12 | 0.1  | work   |  4000 | 25 | doors shifts warm wet season
judging | lathe         | 12 |  4-9   |  60 |  14 | 0.25 | work   |  4500 | 28 | doors shifts warm wet season
tuning  | portal        |  4 |  8-12  |  60 |  40 | 0.05 | on_off |  6000 | 45 | shifts season
judging | portal        |  5 |  6-10  |  60 |  48 | 0.1  | on_off |  5000 | 40 | shifts season
tuning  | mill          |  6 | 0.7-1.3|  10 |  22 | 0.1  | warmup | 12000 | 20 | rises
judging | mill          |  7 |  1-1.5 |  20 |  18 | 0.1  | warmup | 15000 | 14 | rises nospeed
tuning  | bench         |  3 |  3-4   |   1 |   6 | 0.1  | on_off |  5000 | 12 |
judging | bench         |  3 |  4-5   |   1 |   6 | 0.5  | on_off |  4000 | 18 |
tuning  | motor spindle | 20 | 0.7-1.2|  10 |   9 | 0.1  | warmup | 18000 | 11 | coolant rises hidden
judging | motor spindle | 16 | 0.7-1.5|  10 |  11 | 0.1  | warmup | 22000 | 13 | coolant rises hidden
tuning  | mill          |  5 |  4-7   | 120 | 100 | 0.02 | on_off |  9000 | 30 | coolant
judging | mill          |  6 |  3-6   |  60 | 120 | 0.02 | on_off |  8000 | 30 | coolant
tuning  | portal        |  4 |  5-8   | 300 |  60 | 0.1  | work   |  6000 | 50 | warm season odd
judging | portal        |  8 |  4-7   | 300 |  24 | 0.1  | work   |  6000 | 45 | warm season odd
tuning  | lathe         | 18 |  2-4   |  30 |  10 | 0.1  | work   |  3500 | 20 | nospeed warm wet doors
judging | lathe         | 20 |  2-3   |  30 |   9 | 0.1  | work   |  5000 | 18 | nospeed warm wet doors
tuning  | mill          |  9 |  3-5   |  20 |  14 | 0.1  | steps  | 12000 | 25 | coolant regime=6:flow
judging | mill          | 10 |  3-5   |  20 |  15 | 0.1  | steps  | 10000 | 25 | coolant regime=5:setpoint
tuning  | bench         |  8 |  2-3   |  10 |   8 | 0.05 | steps  |  8000 | 12 | regime=4:preload
judging | motor spindle | 12 |  1-2   |  10 |  10 | 0.1  | steps  | 20000 | 12 | regime=7:preload fast
tuning  | mill          |  7 |  2-4   |  30 |  12 | 0.1  | on_off | 10000 | 20 | reversed=3
judging | bench         |  8 |  2-4   |  15 |   9 | 0.1  | steps  |  6000 | 14 | reversed=5
tuning  | bench         | 12 | 1-2    |  13 |   7 | 0.25 | steps  |  7000 |  8 | hidden odd gaps
judging | lathe         |  9 |  3-6   | 7.3 |   8 | 0.25 | work   |  4000 | 16 | hidden odd gaps warm
tuning  | mill          | 40 | 0.7-1.5|  30 |  14 | 0.1  | work   | 12000 | 15 | warm season doors
judging | mill          | 36 | 0.7-1.5|  30 |  16 | 0.1  | work   | 10000 | 18 | warm season doors
tuning  | motor spindle |  6 |  2-4   |   5 |   8 | 0.01 | on_off | 15000 |  7 | jump nonlinear
judging | motor spindle |  5 |  2-4   |   5 |   9 | 0.02 | on_off | 16000 |  8 | nonlinear
tuning  | mill          |  4 |  4-6   |  60 | 302 | 0.02 | steps  | 12000 | 30 | coolant
judging | portal        |  4 |  5-7   |  60 | 302 | 0.02 | on_off |  6000 | 40 | shifts
tuning  | lathe         |  6 | 10-12  |  60 |  12 | 0.1  | on_off |  4000 | 22 | wet shifts
judging | lathe         |  5 | 10-12  |  60 |  11 | 0.1  | on_off |  4000 | 24 | wet shifts
tuning  | bench         |  4 | 1-1.5  |  10 |   6 | 0.5  | warmup |  6000 | 10 | rises nospeed
judging | bench         |  4 | 1-1.5  |  10 |   6 | 0.5  | warmup |  8000 | 11 | rises
tuning  | mill          |  5 |  3-4   |  10 |  30 | 0.1  | work   | 14000 | 25 | coolant warm gaps lagging
judging | mill          |  5 |  3-4   |  10 |  36 | 0.1  | work   | 12000 | 22 | coolant warm gaps lagging
tuning  | lathe         |  3 |  6-8   |  60 |  16 | 0.1  | steps  |  3000 | 20 |
judging | mill          |  5 | 1.22   |   5 |  22 | 0.1  | warmup | 10000 | 12 | rises analogue
judging | motor spindle | 11 | 1-2.5  |   2 |  12 | 0.1  | steps  | 24000 | 14 | from=18000 coolant fast analogue
judging | lathe         | 18 | 6-9 | 60 | 14 | 0.1 | work | 4000 | 22 | warm wet doors season regime=11:preload analogue
"""


def _machine(number: int, row: str) -> Machine:
    half, layout, runs, hours, sample_s, sensors, quantum, programme, rpm, um, traits = (
        cell.strip() for cell in row.split("|")
    )
    low, _, high = hours.partition("-")
    return Machine(
        number=number,
        half=half,
        layout=layout,
        runs=int(runs),
        hours=(float(low), float(high or low)),
        sample_s=float(sample_s),
        sensors=int(sensors),
        quantum_k=float(quantum),
        programme=programme,
        rpm=float(rpm),
        error_um=float(um),
        traits=frozenset(traits.split()),
    )


ROSTER = tuple(_machine(number, row) for number, row in enumerate(_ROWS.strip().splitlines(), start=1))


def _trait(machine: Machine, key: str) -> str | None:
    found = [trait.partition("=")[2] for trait in machine.traits if trait.startswith(f"{key}=")]
    return found[0] if found else None


def reversed_run(machine: Machine) -> int | None:
    """Return the index of the recording whose first channel was measured the wrong way round; None: there is none."""
    turned = _trait(machine, "reversed")
    return None if turned is None else int(turned)


def recordings(machine: Machine, seed: int = SEED) -> list[Recording]:
    """Return the recordings of a machine, rounded as its files are."""
    rng = np.random.default_rng([seed, ORDER, machine.number])
    plant = make_plant(
        rng,
        machine.layout,
        coolant="coolant" in machine.traits,
        wet="wet" in machine.traits,
        pace=between(rng, 0.3, 0.6) if "fast" in machine.traits else between(rng, 0.7, 1.6),
        warm_k=between(rng, 10.0, 30.0),
    )
    days, lengths_h = _days(rng, machine, plant)
    nodes_degc = plant.temperatures(days)
    first = round(BEFORE_H * 3600.0 / days.step_s)
    seen_degc, names, lags_s = _sensors(rng, machine, plant, nodes_degc, days.step_s)
    moved_um, channels = _distortion(rng, machine, plant, nodes_degc, days, first)
    found = []
    for run, hours in enumerate(lengths_h):
        grid_s = (np.arange(len(days.speed)) - first) * days.step_s
        time_s = _times(rng, machine, hours)
        delayed = zip(lags_s, seen_degc[:, run].T, strict=True)
        degc = np.column_stack([np.interp(time_s - lag, grid_s, column) for lag, column in delayed])
        um = np.column_stack([np.interp(time_s, grid_s, column) for column in moved_um[:, run].T])
        rpm = machine.rpm * days.speed[np.clip(np.searchsorted(grid_s, time_s, "right") - 1, 0, None), run]
        found.append(_measured(rng, machine, run, time_s, degc, um, rpm, names, channels))
    return found


def _days(rng: np.random.Generator, machine: Machine, plant: Plant) -> tuple[Days, list[float]]:
    """Return what happens in each run, and the lengths of the runs [h]."""
    lengths = [float(rng.uniform(*machine.hours)) for _ in range(machine.runs)]
    step_s = plant.step_s()
    steps = int((BEFORE_H + max(lengths)) * 3600.0 / step_s) + 2
    hours = np.arange(steps) * step_s / 3600.0 - BEFORE_H
    season, shifts = "season" in machine.traits, "shifts" in machine.traits
    day = int(rng.integers(1, 330))
    swing_k = float(rng.uniform(0.5, 2.5))
    columns: dict[str, list[Array]] = {
        key: [] for key in ("speed", "load", "feeding", "door", "washing", "pump", "shop")
    }
    for _ in range(machine.runs):
        day += int(rng.integers(5, 40)) if season else int(rng.integers(1, 3))
        begins_h = float(rng.choice([7.0, 7.5, 9.0, 13.5]))
        columns["shop"].append(shop_degc(rng, hours + begins_h, day % 365, shifts=shifts, swing_k=swing_k))
        for key, values in _programme(rng, machine, hours).items():
            columns[key].append(values)
    tables = {key: np.column_stack(values) for key, values in columns.items()}
    regime, kind = (_trait(machine, "regime") or ":").split(":")
    changed = np.arange(machine.runs) >= (int(regime) if regime else machine.runs)
    return (
        Days(
            step_s=step_s,
            speed=tables["speed"],
            load=tables["load"],
            feeding=tables["feeding"],
            door=tables["door"],
            washing=tables["washing"],
            pump=tables["pump"],
            shop_degc=tables["shop"],
            heat_factor=np.where(changed & (kind == "preload"), 1.8, 1.0) * np.exp(rng.normal(0.0, 0.08, machine.runs)),
            chiller_set_k=np.where(changed & (kind == "setpoint"), 4.0, 0.0),
            flow_factor=np.where(changed & (kind == "flow"), 0.25, 1.0) * np.exp(rng.normal(0.0, 0.1, machine.runs)),
        ),
        lengths,
    )


def _programme(rng: np.random.Generator, machine: Machine, hours: Array) -> dict[str, Array]:
    """Return what the machine does over the hours since the recording began; before it, work or nothing."""
    begin = hours[0] + rng.uniform(0.0, 4.0) if "warm" in machine.traits else 0.05
    lowest = float(_trait(machine, "from") or 0.3 * machine.rpm) / machine.rpm
    levels = np.round(rng.uniform(lowest, 1.0, 4), 2)
    speed, load, washing = np.zeros(len(hours)), np.zeros(len(hours)), np.zeros(len(hours))
    at, turn = begin, 0
    while at < hours[-1]:
        last, level = _segment(rng, machine.programme, turn, levels)
        part = (hours >= at) & (hours < at + last)
        speed[part] = level
        if level > 0.0 and machine.programme == "work":
            load[part], washing[part] = rng.uniform(0.0, 1.0), float(rng.random() < 0.7)
        at, turn = at + last, turn + 1
    door = np.zeros(len(hours))
    if "doors" in machine.traits:
        for opened in rng.uniform(hours[0], hours[-1], rng.poisson((hours[-1] - hours[0]) * 1.2)):
            door[(hours >= opened) & (hours < opened + rng.uniform(0.02, 0.3))] = 1.0
        speed = np.where(door > 0.0, 0.0, speed)
    running = (hours >= begin) | (rng.random() < 0.5)
    return {
        "speed": speed,
        "load": load,
        "feeding": ((speed > 0.0) & (machine.programme == "work")).astype(np.float64) * rng.uniform(0.3, 1.0),
        "door": door,
        "washing": washing * (speed > 0.0),
        "pump": np.asarray(running, dtype=np.float64),
    }


def _segment(rng: np.random.Generator, programme: str, turn: int, levels: Array) -> tuple[float, float]:
    """Return the length [h] and the speed of the next stretch of a programme."""
    if programme == "warmup":
        return (rng.uniform(0.6, 0.9), float(levels[0])) if turn % 2 == 0 else (rng.uniform(0.1, 0.4), 0.0)
    if programme == "on_off":
        length = rng.uniform(0.7, 2.0)
        return length, float(levels[turn // 2 % 4]) if turn % 2 == 0 else 0.0
    if programme == "steps":
        return rng.uniform(0.15, 0.8), 0.0 if rng.random() < 0.25 else float(rng.choice(levels))
    if turn % 12 == 11:
        return rng.uniform(0.2, 0.8), 0.0
    return (rng.uniform(0.05, 0.3), float(rng.choice(levels))) if turn % 2 == 0 else (rng.uniform(0.01, 0.06), 0.0)


UNSEEN = {"shaft": 0.9, "rotor": 0.9, "nose": 0.9, "chuck": 0.9, "screw": 0.8, "nut": 0.8, "front": 0.5, "rear": 0.5}
"""How likely a node has no sensor: nobody measures what turns, hardly anybody what rubs."""


def _seen(rng: np.random.Generator, machine: Machine, plant: Plant) -> NDArray[np.intp]:
    """Return the nodes that have a sensor, three at least."""
    usual = 0.5 if "hidden" in machine.traits else 0.15 if machine.sensors >= 40 else 0.3
    unseen = rng.random(len(plant.nodes)) < [UNSEEN.get(name, usual) for name in plant.nodes]
    unseen[rng.permutation([at for at, name in enumerate(plant.nodes) if name not in UNSEEN])[:3]] = False
    return rng.permutation(np.flatnonzero(~unseen))


def _sensors(
    rng: np.random.Generator, machine: Machine, plant: Plant, nodes_degc: Array, step_s: float
) -> tuple[Array, list[str], Array]:
    """Return what the sensors feel, shape (n_steps, n_runs, n_sensors), their names and dead times [s]."""
    seen = _seen(rng, machine, plant)
    spots, names = [], []
    for number in range(machine.sensors):
        spot = np.zeros(nodes_degc.shape[2])
        if number == machine.sensors - 1:
            spot[-1 if rng.random() < 0.7 else plant.air] = 1.0  # one hangs in the air
        elif number == machine.sensors - 2 and plant.cooling.any():
            spot[plant.tank] = 1.0
        else:
            node = int(seen[number % len(seen)]) if number < 2 * len(seen) else int(rng.choice(seen))
            neighbours = np.flatnonzero(plant.conductance[node])
            share = rng.uniform(0.0, 0.4)
            spot[node], spot[int(rng.choice(neighbours))] = 1.0 - share, share
            air = rng.uniform(0.0, 0.25)
            spot *= 1.0 - air
            spot[plant.air if plant.inside[node] else -1] += air
        spots.append(spot * rng.normal(1.0, 0.01))
        names.append(f"T{number + 1}")
    lagging = "lagging" in machine.traits
    tau_s = np.exp(rng.uniform(np.log(60.0 if lagging else 5.0), np.log(400.0 if lagging else 60.0), machine.sensors))
    felt = lagged(nodes_degc @ np.array(spots).T, step_s, tau_s)
    return felt, names, rng.uniform(0.0, min(machine.sample_s, 20.0), machine.sensors)


def _distortion(
    rng: np.random.Generator, machine: Machine, plant: Plant, nodes_degc: Array, days: Days, first: int
) -> tuple[Array, list[str]]:
    """Return how far each channel has moved [um], shape (n_steps, n_runs, n_channels), and the channels' names.

    The bracket of a displacement sensor moves a little by itself, which no temperature tells.
    """
    names = [["Z1"], ["X1", "Y1", "Z1"], ["X1", "X2", "Y1", "Y2", "Z1"]][int(rng.integers(0, 3))]
    size, warm = len(plant.nodes), nodes_degc - ZERO_DEGC
    found = np.empty((*nodes_degc.shape[:2], len(names)))
    for channel in range(len(names)):
        weights = np.zeros(nodes_degc.shape[2])
        count = int(rng.integers(3, min(7, size) + 1))
        weights[rng.permutation(size)[:count]] = rng.normal(0.0, 1.0, count) + rng.choice([-0.6, 0.6])
        turning = [at for at, name in enumerate(plant.nodes) if name in UNSEEN]
        weights[rng.choice(turning)] += rng.uniform(0.5, 2.0)  # what turns grows lengthwise
        spread = (warm[first:] - warm[first]).std(axis=(0, 1))
        weights[:size] /= np.maximum(spread[:size], 0.3 * spread[:size].max())
        moved = warm @ weights
        if "nonlinear" in machine.traits:
            one, other = rng.choice(size, 2, replace=False)
            part = warm[:, :, one] * warm[:, :, other]
            moved = moved + 0.2 * moved[first:].std() / max(part[first:].std(), 1e-9) * part
        scale = machine.error_um * between(rng, 0.5, 1.5) / (moved[first:] - moved[first]).std()
        moved = moved * scale
        if "jump" in machine.traits:
            moved = moved + rng.uniform(-0.3, 0.3) * machine.error_um * days.speed**2
        bracket = lagged(rng.normal(0.0, 1.0, moved.shape), days.step_s, between(rng, 1200.0, 7200.0))
        found[:, :, channel] = moved + machine.error_um * between(rng, 0.01, 0.08) * bracket / bracket.std()
    return found, names


def _times(rng: np.random.Generator, machine: Machine, hours: float) -> Array:
    """Return the times of a recording's rows [s], from 0."""
    time_s = np.arange(0.0, hours * 3600.0, machine.sample_s)
    if "odd" in machine.traits:
        time_s[1:] += rng.uniform(-0.3, 0.3, len(time_s) - 1) * machine.sample_s
    if "gaps" in machine.traits:
        kept = np.ones(len(time_s), dtype=np.bool_)
        for begin in rng.uniform(0.1, 0.9, 3) * time_s[-1]:
            kept &= (time_s < begin) | (time_s > begin + rng.uniform(60.0, 1200.0))
        time_s = time_s[kept]
    return np.round(time_s, 2)


def _measured(
    rng: np.random.Generator,
    machine: Machine,
    run: int,
    time_s: Array,
    degc: Array,
    um: Array,
    rpm: Array,
    names: list[str],
    channels: list[str],
) -> Recording:
    """Return one recording, with what sensors add to it, rounded as its file is."""
    own = np.random.default_rng([machine.number, ORDER])
    offsets_k, noise_k = own.normal(0.0, 0.3, len(names)), between(own, 0.005, 0.08)
    noise_um = between(own, 0.02, 0.3)
    shown = degc + offsets_k + rng.normal(0.0, noise_k, degc.shape)
    if "rises" in machine.traits:
        shown = shown - shown[0]
    shown = np.round(np.round(shown / machine.quantum_k) * machine.quantum_k, 3)
    moved = um + rng.uniform(-50.0, 50.0, len(channels)) - um[0] + rng.normal(0.0, noise_um, um.shape)
    if run == reversed_run(machine):
        moved[:, 0] *= -1.0
    if "gaps" in machine.traits:
        shown[rng.random(shown.shape) < 0.002] = np.nan
    return Recording(
        name=f"run{run + 1:02}.csv",
        time_s=time_s,
        speed_rpm=None if "nospeed" in machine.traits else np.round(rpm, 0),
        temperature_names=tuple(names),
        temperatures_degc=shown,
        displacement_names=tuple(channels),
        displacements_um=np.round(moved, 2),
    )


def write(machine: Machine, folder: Path, seed: int = SEED) -> list[Path]:
    """Write a machine's recordings, and the map of their columns, into a folder of its name; return the recordings."""
    place = folder / machine.name
    place.mkdir(parents=True, exist_ok=True)
    paths = []
    for recording in recordings(machine, seed):
        columns = {"time_s": (recording.time_s, 2)}
        if recording.speed_rpm is not None:
            columns["spindle_speed_rpm"] = (recording.speed_rpm, 0)
        columns |= {n: (v, 3) for n, v in zip(recording.temperature_names, recording.temperatures_degc.T, strict=True)}
        columns |= {n: (v, 2) for n, v in zip(recording.displacement_names, recording.displacements_um.T, strict=True)}
        paths.append(place / recording.name)
        write_recording(paths[-1], {"machine": machine.name, "made by": "tests/zoo"}, columns)
    known = {"time": "time_s", "temperatures": ["T*"], "displacements": ["[XYZ]*"]}
    if "nospeed" not in machine.traits:
        known["speed"] = "spindle_speed_rpm"
    (place / "map.yaml").write_text(yaml.safe_dump(known), encoding="utf-8")
    return paths


def chosen(half: str | None = None, count: int | None = None) -> Iterator[Machine]:
    """Yield the machines of a half, all of them without; at most so many."""
    found = [machine for machine in ROSTER if half in {None, machine.half}]
    yield from found[:count]
