"""The dissertation's regression models Y2, Z2 and Z1+TL of its measurement campaign (equations 3-1 to 3-5).

Y2, Z2 and Z1 are displacement increments over one minute as linear functions of the increments of the
temperatures. TL is the length Z1 - Z2 of the test bar as a function of the air (Room), the infrared
sensors at the nose (IR) and the spindle speed; Z1+TL estimates Z2 as Z1 minus TL. Displacements are freed
of the jumps at spindle on/off for training only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.recordings.blocks import contiguous_runs
from models.recordings.dataset import DatasetError, Recording
from models.recordings.jumps import remove_jumps_at_switching
from models.records import FloatArray
from models.thermal.training.increments import Factor, factorise, increments

MODELS = ("Y2", "Z2", "Z1+TL")
OUTPUTS = ("Y2", "Z2", "Z1")
"""Displacements that all temperature sensors estimate."""
SPEED_NAME = "speed"
SPEED_UNIT_RPM = 1000.0
"""Unit of the spindle speed among the inputs of TL [1/min], so that it weighs about as a temperature."""
JUMP_THRESHOLD_UM = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedSet:
    """One data set, prepared for training and for tests."""

    number: int
    speed_rpm: float
    """Highest spindle speed [1/min]."""
    recording: Recording
    """Raw, one row per minute; the first row is the reference."""
    factor: Factor
    """Of the increments of all temperatures and of Y2, Z2, Z1, cleansed."""
    length_inputs: FloatArray
    """Inputs of TL, shape (rows, n_inputs)."""
    length_factor: Factor
    """Of the increments of the inputs of TL and of Z1 - Z2, cleansed."""

    @property
    def elapsed_min(self) -> FloatArray:
        """Time since the reference [min], shape (rows,)."""
        elapsed: FloatArray = (self.recording.time_s - self.recording.time_s[0]) / 60.0
        return elapsed

    @property
    def rotating(self) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
        """Where the spindle turns, shape (rows,); the reference is left out."""
        assert self.recording.speed_rpm is not None
        turning = self.recording.speed_rpm > 0.0
        turning[0] = False
        return turning

    def error_um(self, channel: str) -> FloatArray:
        """Return the raw displacement since the reference [um], shape (rows,)."""
        values = channel_um(self.recording, channel)
        since: FloatArray = values - values[0]
        return since

    @property
    def change_k(self) -> FloatArray:
        """Temperatures since the reference [K], shape (rows, n_sensors)."""
        change: FloatArray = self.recording.temperatures_degc - self.recording.temperatures_degc[0]
        return change


def channel_um(recording: Recording, channel: str) -> FloatArray:
    """Return a displacement channel [um], shape (rows,); raises DatasetError when there is none of that name."""
    if channel not in recording.displacement_names:
        raise DatasetError(
            f"{recording.name}: there is no displacement {channel}; there are {', '.join(recording.displacement_names)}"
        )
    values: FloatArray = recording.displacements_um[:, recording.displacement_names.index(channel)]
    return values


def prepare(number: int, recording: Recording, length_sensors: Sequence[str]) -> PublishedSet:
    """Prepare a data set.

    Result: with the triangular factors of its increments. Raises DatasetError when speed, a channel or a temperature is
    missing, or a value is.

    `number`: its number in the programme. `recording`: one row per minute, with spindle speed and Y2, Z1, Z2; the first
    row is the reference. `length_sensors`: names of the temperatures that TL takes (Room and IR).
    """
    if recording.speed_rpm is None:
        raise DatasetError(f"{recording.name}: has no spindle speed, which the model of the test bar's length takes")
    if lacking := [name for name in length_sensors if name not in recording.temperature_names]:
        raise DatasetError(f"{recording.name}: there is no temperature {', '.join(lacking)}")
    outputs = np.column_stack([channel_um(recording, channel) for channel in OUTPUTS])
    if not (np.isfinite(outputs).all() and np.isfinite(recording.temperatures_degc).all()):
        raise DatasetError(
            f"{recording.name}: values are missing; the published models take complete data sets, so fill the gaps "
            "or leave the column out"
        )
    cleansed = remove_jumps_at_switching(outputs, recording.speed_rpm, JUMP_THRESHOLD_UM)
    places = [recording.temperature_names.index(name) for name in length_sensors]
    length_inputs = np.column_stack(
        [recording.temperatures_degc[:, places], recording.speed_rpm[:, None] / SPEED_UNIT_RPM]
    )
    trained = replace(recording, displacement_names=OUTPUTS, displacements_um=cleansed)
    length = replace(
        recording,
        temperature_names=(*length_sensors, SPEED_NAME),
        temperatures_degc=length_inputs,
        displacement_names=("TL",),
        displacements_um=(cleansed[:, 2] - cleansed[:, 1])[:, None],
    )
    return PublishedSet(
        number=number,
        speed_rpm=float(recording.speed_rpm.max()),
        recording=recording,
        factor=_factor(trained),
        length_inputs=length_inputs,
        length_factor=_factor(length),
    )


def _factor(recording: Recording) -> Factor:
    """Return the factor of the increments over a minute, none of which crosses a gap."""
    runs = contiguous_runs(recording.time_s, 60.0)
    stretches = [(recording.temperatures_degc[a:b], recording.displacements_um[a:b]) for a, b in runs]
    return factorise(increments(stretches, 1.0, 60.0))
