"""An axis of 500 mm whose scale expands: finite volumes of heat along its length, and what a probe reads along it.

Shares no formula with the estimator, which knows lagged temperatures and straight lines: friction where the axis
travels, conduction, the air of a hall, a motor at the fixed end, and a column behind it all that grows with its own
lag. The scale's expansion is summed over the volumes up to the position.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from config.recordings.recording_map import RecordingMap
from drivers.files.recording_csv import read_recording
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.training.train_family import train_family

LENGTH_MM, VOLUMES = 500.0, 20
EXPANSION_UM_PER_M_K = 11.5
CONDUCTIVITY_W_PER_M_K, AREA_M2, PERIMETER_M = 45.0, 0.0008, 0.12
HEAT_CAPACITY_J_PER_M_K = 3.0e3
FILM_W_PER_M2_K = 14.0
PROBED_MM = (20.0, 135.0, 250.0, 365.0, 480.0, 365.0, 250.0, 135.0)
"""Positions of the axis in turn, one a minute: there and back."""
SENSORS_MM = (15.0, 160.0, 330.0, 485.0)
NOISE_UM, LSB_K = 0.3, 0.0625
PIVOT_MM = 250.0
MAP = RecordingMap.model_validate(
    {
        "time": "t",
        "temperatures": ["t[0-9]"],
        "displacements": ["Z1"],
        "slopes": {"Z1": {"position": "Z_mm", "pivot_mm": PIVOT_MM}},
    }
)
TRAINED, CHOSEN, JUDGED = (11, 12, 13, 14, 15, 16), (21, 22), (31, 32, 33)
"""Seeds of days that models are trained on, of days by which physics and family were chosen, of days that judge."""
SENSORS = ("t1", "t2", "t3", "t4", "t5", "t6")


class ExpandingAxis:
    """Some days of the axis, minute by minute; the seed chooses hall, duty and where the axis travels."""

    def __init__(self, seed: int, days: float) -> None:
        rng = np.random.default_rng(seed)
        self.minutes = int(days * 1440)
        minute = np.arange(self.minutes)
        hall = (
            21.0
            + rng.uniform(1.0, 2.5) * np.sin(2 * np.pi * (minute / 1440.0 + rng.uniform()))
            + 0.3 * np.cumsum(rng.normal(0.0, 0.05, self.minutes))
        )
        self.position_mm = np.array(PROBED_MM)[minute % len(PROBED_MM)]
        duty = np.zeros(self.minutes)
        centre, reach = np.full(self.minutes, 250.0), np.full(self.minutes, 250.0)
        at = 0
        while at < self.minutes:
            stop = at + int(rng.uniform(40, 240))
            duty[at:stop] = rng.choice([0.0, 0.3, 0.6, 1.0])
            centre[at:stop], reach[at:stop] = rng.uniform(200.0, 300.0), rng.uniform(160.0, 260.0)
            at = stop
        self._march(hall, duty, centre, reach)
        degc = np.column_stack([*self._scale_at(np.array(SENSORS_MM)).T, hall, self._column_degc])
        degc = degc + rng.normal(0.0, 0.03, degc.shape)
        self.degc: FloatArray = np.round(degc / LSB_K) * LSB_K
        rows = np.arange(self.minutes)
        self.measured_um: FloatArray = self.error_um[rows, np.searchsorted(np.unique(PROBED_MM), self.position_mm)]
        self.measured_um = self.measured_um + rng.normal(0.0, NOISE_UM, self.minutes)

    def _march(self, hall: FloatArray, duty: FloatArray, centre: FloatArray, reach: FloatArray) -> None:
        dx_m = LENGTH_MM * 1e-3 / VOLUMES
        place_mm = (np.arange(VOLUMES) + 0.5) * LENGTH_MM / VOLUMES
        scale, motor, column, step_s = np.full(VOLUMES, hall[0]), hall[0], hall[0], 20.0
        self._scale_degc = np.empty((self.minutes, VOLUMES))
        self._column_degc = np.empty(self.minutes)
        self.error_um: FloatArray = np.empty((self.minutes, len(np.unique(PROBED_MM))))
        """Of the positions in ascending order, shape (minutes, positions) [um]."""
        for minute in range(self.minutes):
            travelled = np.abs(place_mm - centre[minute]) <= reach[minute]
            friction_w = 10.0 * duty[minute] * travelled / max(int(travelled.sum()), 1)
            for _ in range(3):
                flow_w = -CONDUCTIVITY_W_PER_M_K * AREA_M2 * np.diff(scale) / dx_m
                gain_w = friction_w - FILM_W_PER_M2_K * PERIMETER_M * dx_m * (scale - hall[minute])
                gain_w[:-1] -= flow_w
                gain_w[1:] += flow_w
                gain_w[0] += 0.35 * (motor - scale[0])
                scale = scale + gain_w * step_s / (HEAT_CAPACITY_J_PER_M_K * dx_m)
                motor += (9.0 * duty[minute] - 0.9 * (motor - hall[minute])) * step_s / 1500.0
                column += (0.8 * hall[minute] + 0.2 * motor - column) * step_s / 9000.0
            self._scale_degc[minute], self._column_degc[minute] = scale, column
            grown = np.cumsum(EXPANSION_UM_PER_M_K * (scale - 20.0) * dx_m)
            along = np.interp(np.unique(PROBED_MM), np.append(0.0, place_mm + 0.5 * dx_m * 1e3), np.append(0.0, grown))
            self.error_um[minute] = along + 0.4 * EXPANSION_UM_PER_M_K * (column - 20.0)

    def _scale_at(self, places_mm: FloatArray) -> FloatArray:
        return self._scale_degc[:, (places_mm / LENGTH_MM * VOLUMES).astype(int)]

    def write(self, path: Path) -> Path:
        """Write the recording: time, six temperatures, position, what the probe reads there."""
        table = np.column_stack([60.0 * np.arange(self.minutes), self.degc, self.position_mm, self.measured_um])
        header = ",".join(["t", *SENSORS, "Z_mm", "Z1"])
        np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
        return path


def recorded(folder: Path, seeds: Sequence[int] = TRAINED) -> list[Recording]:
    """Return days of the axis as they come from a file."""
    return [read_recording(ExpandingAxis(seed, 1.0).write(folder / f"day{seed}.csv"), MAP) for seed in seeds]


def left_um(recordings: list[Recording], family: str, seeds: Sequence[int] = JUDGED) -> tuple[float, float]:
    """Return what offset alone, and offset with slope, leave on other days, over all positions (RMS, um)."""
    model = train_family(recordings, family, sample_s=60.0, created="2026-11-23T00:00:00").model
    alone, whole = [], []
    along_m = (np.unique(PROBED_MM) - PIVOT_MM) * 1e-3
    for seed in seeds:
        day = ExpandingAxis(seed, 1.0)
        used = [SENSORS.index(name) for name in model.sensor_names]
        first = 300
        told = model.recorded_um(np.arange(day.minutes, dtype=np.float64), day.degc[:, used], None, first)
        error = day.error_um[first:] - day.error_um[first]
        alone.append(error - told[:, :1])
        whole.append(error - told[:, :1] - told[:, 1:] * along_m)
    rms = [float(np.sqrt(np.mean(np.square(parts)))) for parts in (alone, whole)]
    return rms[0], rms[1]
