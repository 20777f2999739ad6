"""The machine of a warm-up: its true behaviour on one day, and what a user has measured of it."""

from collections.abc import Sequence
from typing import Protocol

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.day import Day
from drivers.sim.spindle.warming_spindle import VibrationModes
from models.records import FloatArray
from models.spindle_speed.modal_regression import INTERVAL_S, MEAN_S
from models.spindle_speed.tool_point import ToolPointEstimator

CYCLE_S = 10.0
"""A reading of all sensors [s]."""
STANDING_S = INTERVAL_S + MEAN_S
"""The machine stands so long before it mills, so that the changes of temperature are known [s]."""


class MillingMachine(Protocol):
    """A simulated machine with its tool."""

    @property
    def sensors(self) -> Sequence[SensorConfig]:
        """The temperature sensors, in the order of the readings."""

    @property
    def day(self) -> Day: ...

    @property
    def softer_axis(self) -> str:
        """The axis that responds more at its resonance."""

    def at(self, node_degc: FloatArray) -> VibrationModes:
        """Return the true modes at the temperatures of all nodes [degC]."""

    def estimator(self) -> ToolPointEstimator:
        """Return a new estimator of the tool point, as the user has fitted it; it has had no temperature yet."""
