"""What a fleet teaches a sister, and what learning it costs: simulated machines with 20 % other physics, 302 sensors.

    python tests/benchmarks/bench_fleet.py --half judging  # nothing was chosen on these; 3 min of processor time
    python tests/benchmarks/bench_fleet.py --cost           # a growing fleet, one and two workers

A fleet of twelve machines of ten recordings each. Eight sisters, which are not of it, have ten recordings to learn from
and ten that are held out, of ten hours each, one row a minute. What could be chosen was chosen on the tuning half.
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from sisters import sister_recordings, write_sister

from config.machines import shipped_file
from config.recordings.machine_map import MachineFiles
from daemon.simulation.simulated_model import CHANNELS, published_sensors
from daemon.workbench.thermal.fleet import fleet_executor, train_fleet
from models.recordings.dataset import Recording
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.training.fleet.combination import own_ridge, relative, taken_over, weighed
from models.thermal.training.fleet.fleet import (
    in_places,
    left_out_machines,
    machine_sample,
    machine_summary,
    machine_type,
    reduced_rows,
)
from models.thermal.training.fleet.machine_type import MachineType
from models.thermal.training.fleet.places import Part, matching, places_of_type
from models.thermal.training.fleet.prior import prior_recipe
from models.thermal.training.fleet.products import Products, products_of, space_of, summed
from models.thermal.training.train_family import train_family

HOURS = 10.0
EACH = 10
FLEET = range(1, 13)
HALVES = {"tuning": range(21, 29), "judging": range(31, 39)}
SENSORS = published_sensors()
PARTS = tuple(Part(component=one.component, part=one.part, label=one.label or "") for one in SENSORS)
NAMED = {f"T{one.id}": part for one, part in zip(SENSORS, PARTS, strict=True)}


def days(machine: int, *, held_out: bool = False) -> list[Recording]:
    return sister_recordings(machine, EACH, SENSORS, hours=HOURS, first=500 if held_out else 0, start=None)


def learned() -> MachineType:
    places = places_of_type([PARTS] * 2)
    read = {one: days(one) for one in FLEET}
    samples = [machine_sample(str(one), read[one], PARTS, places, CHANNELS, 60.0) for one in list(FLEET)[::2]]
    space = space_of(samples)
    summaries = [machine_summary(str(one), read[one], PARTS, places, CHANNELS, space, tested=True) for one in FLEET]
    return machine_type("mill", "2026-01-01", places, CHANNELS, space, summaries, left_out_machines(summaries))


def products(of_type: MachineType, recordings: list[Recording]) -> list[Products]:
    table, found = matching(of_type.parts, PARTS, "sister"), []
    for recording in in_places(recordings, table, CHANNELS, 60.0):
        inputs, reduced, rows = reduced_rows([recording], of_type.space)
        found.append(products_of(inputs, reduced, rows))
    return found


def quality(half: str) -> None:
    of_type = learned()
    on_line(of_type, HALVES[half][0])
    print(f"fleet of {len(FLEET)} machines; {half} half: sisters {HALVES[half][0]} to {HALVES[half][-1]}", flush=True)
    figures: dict[tuple[str, int], list[float]] = {}
    for machine in HALVES[half]:
        read, unseen = products(of_type, days(machine)), summed(products(of_type, days(machine, held_out=True)))
        for count in (0, 1, 2, 3, 5, EACH):
            own = weighed(read[:count])
            figures.setdefault(("with the fleet", count), []).append(
                1.0 - relative(unseen, taken_over(own, of_type.models).weights)
            )
            if own:
                figures.setdefault(("alone", count), []).append(1.0 - relative(unseen, own_ridge(own).weights))
    for (name, count), shares in figures.items():
        print(f"{name:15} {count:2} recordings: {np.mean(shares):6.1%} of the RMSE gone, worst {min(shares):6.1%}")


def on_line(of_type: MachineType, machine: int) -> None:
    """Make a model as `thermal train --prior` does, of one recording, and ask it as the daemon does."""
    began, recordings = time.process_time(), days(machine)[:1]
    trained = train_family(recordings, prior_recipe(of_type, NAMED, str(machine)), sample_s=60.0, created="2026-01-01")
    print(f"thermal train --prior with one recording: {time.process_time() - began:.1f} s of processor time")
    text = trained.model.to_json()
    print(
        f"type {len(of_type.to_json()) / 1e6:.1f} MB, model {len(text) / 1e6:.1f} MB; refused: {trained.trust.refused}"
    )
    degc = recordings[0].temperatures_degc
    online = trained.model.runtime(Machine(components={one.id: one.component for one in SENSORS}))
    online.on_sample(0.0, degc[0], 0.0)
    online.set_reference(OnlineReference(time_min=0.0, now_min=0.0, degc=degc[0]))
    nobody, began = np.zeros(degc.shape[1], dtype=np.bool_), time.process_time()
    for at in range(500):
        online.on_sample(float(at), degc[at], 6000.0)
        online.estimate(float(at), degc[at], nobody)
    print(f"on line: {(time.process_time() - began) / 500 * 1e3:.2f} ms of processor time per sample and estimate")


def cost(sizes: list[int]) -> None:
    """Train fleets of copies of two machines of 40 h each; print what each machine costs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        configuration = shipped_file("cfrpmt.yaml")
        for machine in (1, 2):
            write_sister(folder, machine, 4, SENSORS, hours=HOURS)
        machines = []
        for copy in range(max(sizes)):
            place = folder / f"copy{copy}"
            shutil.copytree(folder / f"m{1 + copy % 2}", place)
            paths = tuple(sorted(place.glob("*.csv")))
            machines.append(MachineFiles(name=f"copy{copy}", recordings=paths, configuration=configuration, map=None))
        for workers, size in [(1, size) for size in sizes] + [(2, sizes[-1])]:
            began, cpu = time.monotonic(), os.times()
            with fleet_executor(workers, None) as executor:
                train_fleet(machines[:size], "mill", None, executor)
            used, wall = os.times(), time.monotonic() - began
            own_s = used.user + used.system - cpu.user - cpu.system
            all_s = own_s + used.children_user + used.children_system - cpu.children_user - cpu.children_system
            print(
                f"{size:3} machines, {workers} workers: {wall:6.1f} s, {all_s:6.1f} s of processor time "
                f"({own_s:.1f} s in the process that leads), {all_s / size:.2f} s per machine",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=HALVES)
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--sizes", default="8,32,96", help="machines of the fleets whose cost is measured")
    wanted = parser.parse_args()
    if wanted.half:
        quality(wanted.half)
    if wanted.cost:
        cost([int(size) for size in wanted.sizes.split(",")])
