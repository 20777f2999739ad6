"""A small fleet on disk: sisters of the simulated machine with a few of its sensors, and the map of whose is what."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from config.schema.temperatures import SensorConfig
from daemon.simulation.simulated_model import CHANNELS, published_sensors, training_programmes
from drivers.files.recording_csv import write_recording
from drivers.sim.machine.day import SPREAD, Day, Start
from drivers.sim.machine.recording import record
from models.recordings.dataset import Recording

EVERY_S = 60.0


def on_sister(day: Day, machine: int, spread: float = SPREAD) -> Day:
    """Return a day as it is on a sister machine.

    Every capacity, conductance, heat source and coefficient of the structure of a sister departs from nominal by a
    factor of its own, always the same for the same machine; what differs from day to day comes on top.

    Parameters
    ----------
    day
        A day of the machine of the parameters.
    machine
        Number of the sister, 0 or more; 0 is the machine of the parameters itself.
    spread
        Largest relative departure of a sister's physics from nominal.

    """
    if machine == 0:
        return day
    rng = np.random.default_rng([machine, 211])

    def other(factors: Mapping[str, float]) -> dict[str, float]:
        """Return the day's factors times the sister's."""
        own = 1.0 + spread * rng.uniform(-1.0, 1.0, len(factors))
        return {name: factor * mine for (name, factor), mine in zip(factors.items(), own.tolist(), strict=True)}

    return replace(
        day,
        capacity_factors=other(day.capacity_factors),
        conductance_factors=other(day.conductance_factors),
        heat_factors=other(day.heat_factors),
        structure_factors=other(day.structure_factors),
    )


def few_sensors(count: int = 16) -> list[SensorConfig]:
    """Return some sensors of the published machine, on most of its components."""
    every = published_sensors()
    return [every[at] for at in np.linspace(0, len(every) - 1, count).round().astype(int)]


def sister_recordings(
    machine: int,
    count: int,
    sensors: list[SensorConfig],
    *,
    hours: float = 4.0,
    first: int = 0,
    start: Start | None = "cold",
) -> list[Recording]:
    """Return recordings of a sister, each of another day and programme."""
    programmes, found = training_programmes(), []
    for number in range(first, first + count):
        day = on_sister(Day.draw(1000 * machine + number + 1, start=start), machine)
        program = programmes[(number + 3 * machine) % len(programmes)]
        header, rows = record(day, program, sensors, hours=hours, sample_s=EVERY_S, machine_seed=machine)
        column = {name: at for at, name in enumerate(header)}
        names = tuple(f"T{sensor.id}" for sensor in sensors)
        found.append(
            Recording(
                name=f"day{number + 1:02}.csv",
                time_s=rows[:, column["t"]].copy(),
                speed_rpm=rows[:, column["rpm"]].copy(),
                temperature_names=names,
                temperatures_degc=rows[:, [column[name] for name in names]],
                displacement_names=CHANNELS,
                displacements_um=rows[:, [column[name] for name in CHANNELS]],
            )
        )
    return found


def write_sister(
    folder: Path, machine: int, count: int, sensors: list[SensorConfig], *, hours: float = 4.0
) -> list[Path]:
    """Write recordings of a sister."""
    place, paths = folder / f"m{machine}", []
    place.mkdir(exist_ok=True)
    for one in sister_recordings(machine, count, sensors, hours=hours):
        assert one.speed_rpm is not None
        columns = {"time_s": (one.time_s, 0), "spindle_speed_rpm": (one.speed_rpm, 0)}
        columns |= {
            name: (values, 2) for name, values in zip(one.displacement_names, one.displacements_um.T, strict=True)
        }
        columns |= {
            name: (values, 3) for name, values in zip(one.temperature_names, one.temperatures_degc.T, strict=True)
        }
        paths.append(place / one.name)
        write_recording(paths[-1], {"machine": f"sister {machine}"}, columns)
    return paths


def write_configuration(path: Path, sensors: list[SensorConfig]) -> Path:
    """Write the configuration of a machine with these sensors: what is not of its temperatures is as the sample's."""
    from config.sample import sample_configuration

    content = yaml.safe_load(sample_configuration())
    ids = [sensor.id for sensor in sensors]
    content["temperatures"] = {
        "lines": [{"name": "all", "port": "/dev/ttyUSB0", "profile": "checked", "chain": ids}],
        "sensors": [
            {"id": each.id, "component": each.component, "part": each.part}
            | ({"label": each.label} if each.label else {})
            for each in sensors
        ],
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path
