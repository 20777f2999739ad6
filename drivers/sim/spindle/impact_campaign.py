"""Impact tests on the simulated machine's spindle: responses over a day of warm-up and idle.

As in the published campaign the spindle is hit while it stands, between rotations of growing length and then during two
idle periods, with and without the chiller; along both axes, half a minute apart, in turn one or the other first. Five
hits are averaged.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.body import MachineBody
from drivers.sim.machine.day import Day
from drivers.sim.machine.plant import MAX_STEP_S
from drivers.sim.nc.program import MINUTE_S, ROTATION, STANDSTILL, Block, PartProgram
from drivers.sim.spindle.spindle_beam import ComplexVector, SpindleBeam
from drivers.sim.spindle.spindle_bearings import bearings, nominal_bearings
from models.records import FloatArray

AXES = ("x", "y")
SPEED_RPM = 12000.0
HITS = 5
NOISE_SHARE = 0.02
NOISE_FLOOR = 0.002
"""Noise of one hit: relative to the response, and to its largest magnitude (chosen)."""
BEFORE_MIN = 24.0
"""The machine stands cold before it turns first."""
COLD_HITS_MIN = (12.0, 15.0, 18.0, 21.0)
ROTATIONS_MIN = (2.0,) * 5 + (4.0,) * 4 + (10.0,) * 4
STOP_MIN = 2.5
"""Time between two rotations."""
HIT_AFTER_MIN = 0.4
"""After a rotation the spindle is hit so long after the command to stop, and again along the other axis."""
OTHER_AXIS_S = 30.0
HEATING_MIN = (10.0,) * 6
"""Rotations before each of the idle periods, with stops between."""
IDLE_HITS_MIN = (1.0, 4.0, 7.0, 11.0, 15.0, 20.0, 25.0, 31.0, 38.0, 46.0, 55.0, 65.0, 76.0, 90.0)
LAST_MIN = 93.0
INDEX_FILE = "impacts.csv"
RECORDING_FILE = "temperatures.csv"


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignPlan:
    """What the machine does, and when it is hit along the first axis."""

    program: PartProgram
    hits_s: tuple[float, ...]
    duration_s: float


def campaign_plan() -> CampaignPlan:
    """Return warm-up by steps, then an hour of rotation and idle with the chiller, then the same without it."""
    blocks: list[Block] = [_idle(BEFORE_MIN, True)]
    hits = list(COLD_HITS_MIN)
    time_min = BEFORE_MIN
    for rotations, chiller in ((ROTATIONS_MIN, None), (HEATING_MIN, True), (HEATING_MIN, False)):
        for rotation in rotations:
            blocks += [_turning(rotation), _idle(STOP_MIN, True)]
            hits.append(time_min + rotation + HIT_AFTER_MIN)
            time_min += rotation + STOP_MIN
        if chiller is not None:
            blocks.append(_idle(LAST_MIN, chiller))
            hits += [time_min + after for after in IDLE_HITS_MIN]
            time_min += LAST_MIN
    return CampaignPlan(
        program=PartProgram(number=2400, blocks=tuple(blocks)),
        hits_s=tuple(minute * MINUTE_S for minute in hits),
        duration_s=time_min * MINUTE_S,
    )


def _turning(minutes: float) -> Block:
    duration_s = minutes * MINUTE_S
    return Block(sequence_number=ROTATION, kind="spindle", duration_s=duration_s, spindle_speed_rpm=SPEED_RPM)


def _idle(minutes: float, chiller: bool) -> Block:
    return Block(sequence_number=STANDSTILL, kind="idle", duration_s=minutes * MINUTE_S, chiller=chiller)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Impact:
    """One averaged response at the nose."""

    axis: str
    time_s: float
    receptance: ComplexVector
    """[m/N] at the frequencies of the campaign."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImpactCampaign:
    """Responses, and what the sensors read meanwhile."""

    frequency_hz: FloatArray
    impacts: tuple[Impact, ...]
    sensor_ids: tuple[int, ...]
    time_s: FloatArray
    """Shape (n,)."""
    degc: FloatArray
    """Shape (n, sensors)."""

    def write(self, folder: Path) -> None:
        """Write the responses with their index, and the recording of the temperatures, into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        frequencies = self.frequency_hz.tolist()
        with (folder / INDEX_FILE).open("w", encoding="utf-8", newline="") as file:
            index = csv.writer(file, lineterminator="\n")
            index.writerow(("file", "axis", "time"))
            for number, impact in enumerate(self.impacts, start=1):
                name = f"{impact.axis}_{number:03}.csv"
                index.writerow((name, impact.axis, f"{impact.time_s:.1f}"))
                values = impact.receptance.tolist()
                rows = (f"{f:.6f},{v.real:.6e},{v.imag:.6e}\n" for f, v in zip(frequencies, values, strict=True))
                text = "frequency_hz,receptance_re,receptance_im\n" + "".join(rows)
                (folder / name).write_text(text, encoding="utf-8")
        header = ",".join(("t", *(f"T{sensor}" for sensor in self.sensor_ids)))
        np.savetxt(
            folder / RECORDING_FILE, np.column_stack([self.time_s, self.degc]), "%.4f", ",", header=header, comments=""
        )


def run_campaign(
    day: Day,
    sensors: Sequence[SensorConfig],
    frequency_hz: FloatArray,
    *,
    plan: CampaignPlan | None = None,
    machine_seed: int = 1,
) -> ImpactCampaign:
    """Return an impact campaign on one day at these frequencies [Hz]; the sensors are read every 10 s."""
    plan = plan or campaign_plan()
    body = MachineBody(day, plan.program, sensors, machine_seed=machine_seed)
    beams = {axis: SpindleBeam(nominal_bearings(axis), with_tool=False) for axis in AXES}
    due = sorted(
        (hit + OTHER_AXIS_S * ((number + place) % len(AXES)), axis)
        for number, hit in enumerate(plan.hits_s)
        for place, axis in enumerate(AXES)
    )
    rng = np.random.default_rng([machine_seed, day.seed, 71])
    impacts: list[Impact] = []
    times: list[float] = []
    readings: list[FloatArray] = []
    for time_s in np.arange(0.0, plan.duration_s, MAX_STEP_S).tolist():
        move(body, time_s)
        while due and due[0][0] <= time_s:
            _, axis = due.pop(0)
            true = beams[axis].modes(bearings(body.thermal_nodes(), axis)).receptance(frequency_hz)
            impacts.append(Impact(axis=axis, time_s=time_s, receptance=_averaged(true, rng)))
        times.append(time_s)
        readings.append(body.sensors.degc(body.register_codes()))
    return ImpactCampaign(
        frequency_hz=frequency_hz,
        impacts=tuple(impacts),
        sensor_ids=body.sensors.ids,
        time_s=np.array(times),
        degc=np.array(readings),
    )


def _averaged(true: ComplexVector, rng: np.random.Generator) -> ComplexVector:
    size = NOISE_SHARE * np.abs(true) + NOISE_FLOOR * np.abs(true).max()
    noise = rng.standard_normal((HITS, len(true))) + 1j * rng.standard_normal((HITS, len(true)))
    return np.asarray(true + size * np.sqrt(0.5) * noise.mean(axis=0), dtype=np.complex128)


def move(body: MachineBody, to_s: float) -> None:
    """Let the machine run up to a time [s], without taking results."""
    body.advance(to_s, leaving=_ignore, entered=_ignore)


def _ignore(*_: object) -> None:
    """Nothing watches."""
