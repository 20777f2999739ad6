"""What the simulated spindle truly does over a day: one mode of its tool point, followed by its shape."""

from collections.abc import Iterator, Sequence

import numpy as np

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.body import MachineBody
from drivers.sim.machine.day import Day
from drivers.sim.nc.program import PartProgram
from drivers.sim.spindle.impact_campaign import move
from drivers.sim.spindle.spindle_beam import DampedModes, SpindleBeam
from drivers.sim.spindle.spindle_bearings import bearings, nominal_bearings
from models.records import FloatArray


class TrueResonance:
    """One mode of the simulated tool point along an axis, followed by its shape."""

    def __init__(self, axis: str, band_hz: tuple[float, float] = (300.0, 1200.0)) -> None:
        """Choose the mode that responds most within a band at the nominal bearings."""
        self.axis = axis
        self._beam = SpindleBeam(nominal_bearings(axis), with_tool=True)
        modes = self._beam.modes(nominal_bearings(axis))
        inside = (modes.resonance_hz > band_hz[0]) & (modes.resonance_hz < band_hz[1])
        height = np.where(inside, np.abs(modes.residues / modes.poles.real), 0.0)
        self._shape = modes.shapes[:, int(np.argmax(height))]

    def modes(self, node_degc: FloatArray) -> DampedModes:
        """Return all damped modes at the temperatures of all nodes [degC]."""
        return self._beam.modes(bearings(node_degc, self.axis))

    def at(self, node_degc: FloatArray) -> float:
        """Return the frequency at which the mode responds most [Hz], and follow it."""
        modes = self.modes(node_degc)
        shapes, before = modes.shapes, self._shape
        likeness = np.abs(before.conj() @ shapes) ** 2 / np.sum(np.abs(shapes) ** 2, axis=0)
        index = int(np.argmax(likeness))
        self._shape = shapes[:, index]
        return float(modes.resonance_hz[index])


def watched_day(
    day: Day, program: PartProgram, sensors: Sequence[SensorConfig], *, hours: float, sample_s: float
) -> Iterator[tuple[float, FloatArray, MachineBody]]:
    """Yield time [s], sensor readings [degC] and the body, `sample_s` apart, while the machine runs a program."""
    body = MachineBody(day, program, sensors)
    for time_s in np.arange(0.0, hours * 3600.0, sample_s).tolist():
        move(body, time_s)
        yield time_s, body.sensors.degc(body.register_codes()), body
