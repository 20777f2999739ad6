"""Recordings of whole simulated days, for training and for tests."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.body import MachineBody
from drivers.sim.machine.day import Day
from drivers.sim.machine.plant import MAX_STEP_S
from drivers.sim.machine.sensors import RotationJump
from drivers.sim.machine.structure import CHANNELS
from drivers.sim.machine.travel import AxisTravel
from drivers.sim.nc.program import PartProgram
from models.records import FloatArray


def record(
    day: Day,
    program: PartProgram,
    sensors: Sequence[SensorConfig],
    *,
    hours: float,
    sample_s: float = MAX_STEP_S,
    machine_seed: int = 1,
    rotation_jump: RotationJump | None = None,
    travels: Mapping[str, AxisTravel] | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[tuple[str, ...], FloatArray]:
    """Run a day up to `hours` and return column names and values every `sample_s`.

    Columns: t [s], rpm (actual spindle speed), the displacement channels as the A/D logger reads them [um], T1, T2 ..
    by sensor number, as decoded from the registers [degC], and X_mm, Y_mm, Z_mm of axes with `travels`.
    """
    if sample_s < MAX_STEP_S:
        raise ValueError(f"sample_s is {sample_s}; the sensors convert once in {MAX_STEP_S} s")
    body = MachineBody(day, program, sensors, machine_seed=machine_seed, rotation_jump=rotation_jump, travels=travels)
    axes = [f"{axis.upper()}_mm" for axis in body.travel.positions_mm(0.0)]
    header = ("t", "rpm", *CHANNELS, *(f"T{sensor_id}" for sensor_id in body.sensors.ids), *axes)
    sensors_end = len(header) - len(axes)
    count = int(hours * 3600.0 / sample_s) + 1
    rows = np.empty((count, len(header)))
    for index in range(count):
        body.advance(index * sample_s, leaving=_ignore, entered=_ignore)
        rows[index, 0] = body.time_s
        rows[index, 1] = body.spindle_speed_rpm
        rows[index, 2 : 2 + len(CHANNELS)] = list(body.displacement_um().values())
        rows[index, 2 + len(CHANNELS) : sensors_end] = body.sensors.degc(body.register_codes())
        rows[index, sensors_end:] = list(body.travel.positions_mm(body.time_s).values())
        if progress and index % 360 == 0:
            progress(index / count)
    return header, rows


def _ignore(*_: object) -> None:
    """Nothing watches a recording."""
