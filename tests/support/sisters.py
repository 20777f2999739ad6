"""A small fleet on disk: sisters of the simulated machine with a few of its sensors, and the map of whose is what."""

from pathlib import Path

import numpy as np
import yaml

from config.schema.temperatures import SensorConfig
from daemon.simulation.simulated_model import published_sensors, training_programmes
from drivers.files.recording_csv import write_recording
from drivers.sim.machine.day import Day
from drivers.sim.machine.recording import record
from drivers.sim.machine.sister import on_sister

EVERY_MIN = 60.0


def few_sensors(count: int = 16) -> list[SensorConfig]:
    """Return some sensors of the published machine, on most of its components."""
    every = published_sensors()
    return [every[at] for at in np.linspace(0, len(every) - 1, count).round().astype(int)]


def write_sister(
    folder: Path, machine: int, count: int, sensors: list[SensorConfig], *, hours: float = 4.0, first: int = 0
) -> list[Path]:
    """Write recordings of a sister, each of another day and programme."""
    place, programmes, paths = folder / f"m{machine}", training_programmes(), []
    place.mkdir(exist_ok=True)
    for number in range(first, first + count):
        day = on_sister(Day.draw(1000 * machine + number + 1), machine)
        program = programmes[(number + 3 * machine) % len(programmes)]
        header, rows = record(day, program, sensors, hours=hours, sample_s=EVERY_MIN, machine_seed=machine)
        decimals = {"t": 0, "rpm": 0} | dict.fromkeys(header[2:8], 2)
        names = {"t": "time_s", "rpm": "spindle_speed_rpm"}
        columns = {
            names.get(name, name): (rows[:, at], decimals.get(name, 3)) for at, name in enumerate(header) if name != "X"
        }
        paths.append(place / f"day{number + 1:02}.csv")
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
