"""The machine of a warm-up whose cold modes a case gives, and whose dynamics follow a law of their own.

What its user knows was fitted on impact tests of other days: modes regressed on temperatures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from config.loader import load_configuration
from config.machine.stability_case import StabilityCase
from config.machines import shipped_file
from config.schema.temperatures import SensorConfig
from daemon.workbench.stability.case_files import modal_response_of
from drivers.sim.machine.day import Day
from drivers.sim.spindle.warming_spindle import VibrationModes, WarmingModes, WarmingSpindle, impact_response
from models.errors import StabilityError
from models.records import FloatArray
from models.spindle_speed.modal_regression import (
    AXES,
    INTERVAL_S,
    MEAN_S,
    ModalEstimator,
    ModalRegression,
    ModalSample,
    SignalHistory,
)
from models.spindle_speed.tool_point import ToolPointEstimator
from models.stability.frf_modal_fit import fit_modes
from models.stability.response import Mode

SIGNALS = ("IR", "A", "F", "Room")
"""Labels of the sensors that explain the dynamics, those of the dissertation."""
CAMPAIGN_DAYS = 6
CAMPAIGN_SPEEDS_RPM = (12000.0, 6000.0, 9000.0)
CAMPAIGN_STRETCHES_MIN = (30, 20, 30, 25)
"""A stretch at each of the speeds in turn, and one standing."""
IMPACT_EVERY_MIN = 2
LINE_HZ = 1.5625
"""Between the lines of the measured responses [Hz]."""
LEAST_GAIN_SHARE = 0.05
"""A velocity term of a mode above this share of its displacement term is no real mode's."""


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


class CaseMachine:
    """A machine with the modes of a case, warmed by a law of its own."""

    def __init__(self, case: StabilityCase, range_rpm: tuple[float, float], machine_seed: int, day_seed: int) -> None:
        """Run impact tests on other days, and fit the user's model; raises StabilityError."""
        self.sensors: Sequence[SensorConfig] = load_configuration(shipped_file("cfrpmt.yaml")).temperatures.sensors
        self.day = Day.draw(day_seed, start="cold")
        self._modes = WarmingModes(cold_modes(case, range_rpm), machine_seed)
        self._labels = {name: [i for i, each in enumerate(self.sensors) if each.label == name] for name in SIGNALS}
        self._regression = ModalRegression(impact_tests(self._modes, self.sensors, self._labels, machine_seed))
        cold = self._modes.cold
        self.softer_axis = "x" if _softest(cold, 0) >= _softest(cold, 1) else "y"

    def at(self, node_degc: FloatArray) -> VibrationModes:
        """Return the true modes at the temperatures of all nodes [degC]."""
        return self._modes.at(node_degc)

    def estimator(self) -> ToolPointEstimator:
        """Return a new estimator of the tool point, as the user has fitted it."""
        return ModalEstimator(self._regression, self._labels)


def cold_modes(case: StabilityCase, range_rpm: tuple[float, float]) -> VibrationModes:
    """Return the modes of a case as those of the cold machine.

    Raises StabilityError when a mode is not real, or one axis acts on the other: the simulated cut knows neither.
    """
    response, _ = modal_response_of(case, *range_rpm)
    if response.xy or response.yx:
        raise StabilityError("the simulated machine has no cross receptance; leave xy and yx out")
    found: list[tuple[int, Mode]] = [(0, mode) for mode in response.xx] + [(1, mode) for mode in response.yy]
    for _, mode in found:
        gain = mode.displacement_gain_per_kg
        if gain <= 0.0 or abs(mode.velocity_gain_s_per_kg) * mode.angular_rad_s > LEAST_GAIN_SHARE * gain:
            raise StabilityError(
                f"the mode at {mode.frequency_hz:.1f} Hz is not real, and the simulated machine has real modes only; "
                "give modes with mass_kg or stiffness_n_per_m"
            )
    return VibrationModes(
        axis=tuple(axis for axis, _ in found),
        frequency_hz=np.array([mode.frequency_hz for _, mode in found]),
        damping_ratio=np.array([mode.damping_ratio for _, mode in found]),
        stiffness_n_per_m=np.array([mode.angular_rad_s**2 / mode.displacement_gain_per_kg for _, mode in found]),
    )


def impact_tests(
    machine: WarmingModes, sensors: Sequence[SensorConfig], labels: Mapping[str, Sequence[int]], machine_seed: int
) -> list[ModalSample]:
    """Return the modes fitted to impact tests over warm-up and idle on days of the machine's past."""
    top_hz = 1.4 * float(machine.cold.frequency_hz.max())
    frequency_hz = np.arange(LINE_HZ * round(0.3 * float(machine.cold.frequency_hz.min()) / LINE_HZ), top_hz, LINE_HZ)
    samples = []
    for number in range(CAMPAIGN_DAYS):
        rng = np.random.default_rng([machine_seed, number, 72])
        day = Day.draw(100_000 * (machine_seed + 1) + number, start="cold")
        spindle, history = WarmingSpindle(day, sensors, machine_seed=machine_seed), SignalHistory(labels)
        for minute, speed_rpm in enumerate(_campaign()):
            for _ in range(round(60.0 / CYCLE_S)):
                spindle.turn(CYCLE_S, speed_rpm, feeding=speed_rpm > 0.0)
                history.add(spindle.time_s, spindle.readings_degc())
            signals = history.now(spindle.time_s)
            if signals is None or minute % IMPACT_EVERY_MIN:
                continue
            true = machine.at(spindle.node_degc)
            modes = {
                name: _fitted(true, axis, frequency_hz, rng) for axis, name in enumerate(AXES) if axis in true.axis
            }
            samples.append(ModalSample(degc=signals[0], difference_k=signals[1], modes=modes))
    return samples


def _campaign() -> list[float]:
    """Return the spindle speed of every minute of a day of impact tests [1/min]."""
    minutes = [0.0] * round(STANDING_S / 60.0 + 1.0)
    for stretch, speed_rpm in zip(CAMPAIGN_STRETCHES_MIN, (*CAMPAIGN_SPEEDS_RPM, 0.0), strict=True):
        minutes += [speed_rpm] * stretch
    return minutes


def _fitted(true: VibrationModes, axis: int, frequency_hz: FloatArray, rng: np.random.Generator) -> tuple[Mode, ...]:
    measured = impact_response(true, axis, frequency_hz, rng)
    fit = fit_modes(frequency_hz, measured.astype(np.complex128), pairs=true.axis.count(axis))
    return tuple(replace(mode, velocity_gain_s_per_kg=0.0) for mode in fit.modes)


def _softest(modes: VibrationModes, axis: int) -> float:
    """Return the largest receptance at a resonance of an axis [m/N], 0 for a rigid one."""
    here = np.array(modes.axis) == axis
    return float(np.max(1.0 / (2.0 * modes.damping_ratio * modes.stiffness_n_per_m)[here], initial=0.0))
