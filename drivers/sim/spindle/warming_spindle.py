"""The simulated machine while it mills through its warm-up: heat by the commanded speed, modes by the temperatures.

Unlike `MachineBody`, whose program is fixed, the spindle turns as it is told, so that a tuned speed warms the machine
differently. Its modes are those of the finite elements with the bearings of the moment (`WarmingBeams`), or given ones
that follow a law (`WarmingModes`). The law is made up, belongs to the machine and not to the day, and is that of no
estimator: a bearing's interference grows with the shaft's temperature over its housing's and settles; stiffness and
damping follow it with factors drawn per mode.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.day import Day
from drivers.sim.machine.heat import INDEX, Drive
from drivers.sim.machine.plant import MAX_STEP_S, Plant
from drivers.sim.machine.sensors import SensorArray
from drivers.sim.spindle.spindle_beam import MountedTool, SpindleBeam
from drivers.sim.spindle.spindle_bearings import bearings, nominal_bearings
from models.records import FloatArray

STIFFENING = (0.16, 0.32)
"""Range of the share by which a mode's stiffness grows until the interference settles (chosen)."""
DAMPING_FALL = (0.0, 0.25)
"""Range of the share by which its damping falls meanwhile (chosen: thinner oil)."""
SETTLING_K = 6.0
"""Shaft over housing, with a share of the bearing's own warmth, at which 63 % of it is reached (chosen) [K]."""
WARMTH_SHARE = 0.25
MODES_PER_AXIS = 6
"""Modes of the finite elements that a cut feels, up to some 4.5 kHz; the others are stiff."""
REFERENCE_DEGC = 20.0
NOISE = 0.01
"""Of a measured response, relative to each value and to the peak."""
"""Where the modes are those of the cold machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VibrationModes:
    """Modes of the tool point, one entry per mode; axis 0 is X, 1 is Y."""

    axis: tuple[int, ...]
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    stiffness_n_per_m: FloatArray
    lead_s: FloatArray | None = None
    """The tool point moves by a mode's coordinate and by its speed times this; None: 0."""


class WarmingModes:
    """Modes that follow the machine's temperatures."""

    def __init__(self, cold: VibrationModes, machine_seed: int) -> None:
        """Draw how each mode of this machine changes."""
        rng = np.random.default_rng([machine_seed, 515])
        count = len(cold.axis)
        self.cold = cold
        self._stiffening = rng.uniform(*STIFFENING, count)
        self._damping_fall = rng.uniform(*DAMPING_FALL, count)
        self._front_share = rng.uniform(0.55, 0.95, count)

    def at(self, node_degc: FloatArray) -> VibrationModes:
        """Return the modes at the temperatures of all nodes [degC]."""
        front, rear = (_interference(node_degc, end) for end in ("front", "rear"))
        tightened = self._front_share * front + (1.0 - self._front_share) * rear
        stiffer = 1.0 + self._stiffening * tightened
        return VibrationModes(
            axis=self.cold.axis,
            frequency_hz=self.cold.frequency_hz * np.sqrt(stiffer),
            damping_ratio=self.cold.damping_ratio * (1.0 - self._damping_fall * tightened),
            stiffness_n_per_m=self.cold.stiffness_n_per_m * stiffer,
        )


class WarmingBeams:
    """Damped modes of the finite elements with the bearings at the machine's temperatures, along X and Y."""

    def __init__(self, tool: MountedTool) -> None:
        """Assemble spindle, holder and tool along both axes."""
        self._beams = {axis: SpindleBeam(nominal_bearings(axis), with_tool=True, tool=tool) for axis in ("x", "y")}

    def at(self, node_degc: FloatArray) -> VibrationModes:
        """Return the lowest modes of both axes at the temperatures of all nodes [degC].

        A damped mode r / (s - p) + conjugate is a coordinate q with q'' - 2 Re(p) q' + |p|^2 q = F, of which the tool
        point sees -2 Re(r conj(p)) q + 2 Re(r) q'.
        """
        poles, gains, speeds = [], [], []
        for axis, beam in self._beams.items():
            modes = beam.modes(bearings(node_degc, axis))
            pole, residue = modes.poles[:MODES_PER_AXIS], modes.residues[:MODES_PER_AXIS]
            poles.append(pole)
            gains.append(-2.0 * (residue * pole.conj()).real)
            speeds.append(2.0 * residue.real)
        pole, gain, speed = np.concatenate(poles), np.concatenate(gains), np.concatenate(speeds)
        natural = np.abs(pole)
        return VibrationModes(
            axis=(0,) * len(poles[0]) + (1,) * len(poles[1]),
            frequency_hz=natural / (2.0 * np.pi),
            damping_ratio=-pole.real / natural,
            stiffness_n_per_m=natural**2 / gain,
            lead_s=speed / gain,
        )


def _interference(node_degc: FloatArray, end: str) -> float:
    """Return how much of the interference that heat can bring a bearing has now, at most 1."""
    shaft, housing, bearing = (float(node_degc[INDEX[f"{part}_{end}"]]) for part in ("shaft", "housing", "bearing"))
    over_k = (shaft - housing) + WARMTH_SHARE * (bearing - REFERENCE_DEGC)
    return float(1.0 - np.exp(-over_k / SETTLING_K))


class WarmingSpindle:
    """Heat and sensors of the machine on one day; the spindle turns as it is told."""

    def __init__(self, day: Day, sensors: Sequence[SensorConfig], *, machine_seed: int = 1) -> None:
        self.time_s = 0.0
        self._plant = Plant(day)
        self.node_degc = self._plant.cold()
        self._array = SensorArray(sensors, machine_seed=machine_seed, noise_seed=day.seed)
        self._sensor_degc = self._array.settled(self.node_degc)

    def turn(self, duration_s: float, speed_rpm: float, *, feeding: bool) -> None:
        """Let the spindle turn at a speed [1/min] for a time [s], the chiller running."""
        drive = Drive(spindle_speed_rpm=speed_rpm, chiller=True, feeding=feeding)
        until_s = self.time_s + duration_s
        while (left_s := until_s - self.time_s) > 1e-6:
            step_s = min(left_s, MAX_STEP_S)
            self.node_degc = self._plant.advance(self.node_degc, time_s=self.time_s, duration_s=step_s, drive=drive)
            self._sensor_degc = self._array.advance(self._sensor_degc, self.node_degc, step_s)
            self.time_s += step_s

    def readings_degc(self) -> FloatArray:
        """Return what the sensors read now, in the order of their list [degC]."""
        return self._array.degc(self._array.codes(self._sensor_degc, self.time_s))


def impact_response(modes: VibrationModes, axis: int, frequency_hz: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a measured receptance [m/N] along an axis, complex."""
    ratio = frequency_hz[:, None] / modes.frequency_hz
    terms = 1.0 / (modes.stiffness_n_per_m * (1.0 - ratio**2 + 2j * modes.damping_ratio * ratio))
    true = terms[:, np.array(modes.axis) == axis].sum(axis=1)
    size = NOISE * (np.abs(true) + 0.1 * np.abs(true).max())
    measured: FloatArray = true + size * (rng.standard_normal(len(true)) + 1j * rng.standard_normal(len(true)))
    return measured
