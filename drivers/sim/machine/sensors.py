"""The simulated machine's sensors: where they sit, from node temperatures to register codes, from shape to readings."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.heat import INDEX
from drivers.sim.machine.parameters import NODES
from models.records import FloatArray
from models.units import MLX90615_K_PER_LSB, TMP102_DEGC_PER_LSB, ZERO_CELSIUS_K

CodeVector = npt.NDArray[np.int64]

NOISE_PERIOD_S = 10.0
"""A sensor converts once in a LATSIS cycle: within one such slot its noise stays the same [s]."""
TMP102_NOISE_K = 0.02
MLX90615_NOISE_K = 0.03
"""Standard deviations of the noise of one conversion [K] (chosen, about a third of a step and one step)."""
OFFSET_LIMIT_K = 0.5
"""Accuracy of both devices in their data sheets: no sensor is further off [K]."""
CONTACT_LAG_S = (20.0, 60.0)
"""Range of the lag through silicone and board [s]; the published step response needs minutes to settle."""
INFRARED_LAG_S = 2.0
SURFACE_AIR_SHARE = (0.02, 0.10)
"""Range of the share of the air around it that a glued sensor reads (chosen)."""
DISPLACEMENT_NOISE_UM = 0.1
DISPLACEMENT_STEP_UM = 0.1
"""Noise (chosen) and published resolution of the displacement measurement [um]."""


Path = tuple[str, ...]

LABELS: dict[str, dict[str, float]] = {
    "A": {"housing_rear": 0.9, "housing_front": 0.1},
    "B": {"housing_front": 0.85, "housing_rear": 0.15},
    "C": {"cast_rear_top": 0.45, "cast_rear_bottom": 0.45, "housing_rear": 0.1},
    "D": {"cast_middle_top": 0.5, "cast_middle_bottom": 0.5},
    "E": {"cast_front_top": 0.45, "cast_front_bottom": 0.45, "housing_front": 0.1},
    "F": {"front_cover": 0.9, "cast_front_top": 0.1},
    "IR": {"nose": 1.0},
}
"""Shares of the nodes that a labelled sensor reads; Room follows from its part."""

_CAST: Path = (
    "cast_rear_bottom",
    "cast_middle_bottom",
    "cast_front_bottom",
    "cast_front_top",
    "cast_middle_top",
    "cast_rear_top",
)

PARTS: dict[tuple[str, str], Path] = {
    ("Ambient", ""): ("air_low", "air_high"),
    ("Spindle unit", "Ram with Z-axis linear guide rail"): ("ram_bottom", "ram_top"),
    ("Spindle unit", "Cast metal"): _CAST,
    ("Spindle unit", "Housing"): ("housing_rear", "housing_front"),
    ("Spindle unit", "Front cover of the spindle"): ("front_cover", "cast_front_bottom"),
    ("Spindle unit", "Spindle nose"): ("nose",),
    ("Spindle unit", ""): _CAST,
    ("X-axis slider", "Z-axis motor coupling cover"): ("z_coupling",),
    ("X-axis slider", "Z-axis motor"): ("z_motor", "z_coupling"),
    ("X-axis slider", "Right side"): ("slider_right", "slider_bottom"),
    ("X-axis slider", "Left side"): ("slider_left", "slider_bottom"),
    ("X-axis slider", "X-axis linear guide"): ("saddle_left", "slider_left", "slider_right", "saddle_right"),
    ("X-axis slider", "Z-axis linear guide"): ("slider_left", "ram_bottom", "slider_right"),
    ("X-axis slider", "X-axis ball-screw nut"): ("x_screw", "slider_bottom"),
    ("X-axis slider", ""): ("slider_bottom", "slider_left", "slider_right"),
    ("Saddle", "Back"): ("saddle_back", "saddle_right"),
    ("Saddle", "Left side"): ("saddle_left", "saddle_back"),
    ("Saddle", "Right side"): ("saddle_right", "saddle_back"),
    ("Saddle", "X-axis linear guide rail"): ("saddle_left", "saddle_front", "saddle_right"),
    ("Saddle", "X-axis motor coupling cover"): ("x_coupling",),
    ("Saddle", "X-axis motor"): ("x_motor", "x_coupling"),
    ("Saddle", "Front"): ("saddle_front", "saddle_left"),
    ("Saddle", "Counter side X-axis ball-screw stand"): ("x_screw", "saddle_right"),
    ("Saddle", "Bottom inside"): ("saddle_front", "saddle_back"),
    ("Saddle", "Y-axis linear guide"): ("saddle_back", "column_front"),
    ("Saddle", "Y-axis ball-screw nut"): ("y_screw", "saddle_back"),
    ("Saddle", ""): ("saddle_back",),
    ("Bed", "Front"): ("bed_front",),
    ("Bed", "Left side"): ("bed_left", "bed_front"),
    ("Bed", "Right side"): ("bed_right", "bed_front"),
    ("Bed", ""): ("bed_front", "bed_left", "bed_right"),
    ("Trunnion table", "A-axis motor"): ("a_motor",),
    ("Trunnion table", "Counter side A-axis motor"): ("a_counter",),
    ("Trunnion table", ""): ("a_motor", "a_counter"),
    ("Column", "Left"): ("column_left", "column_front"),
    ("Column", "Right"): ("column_right", "column_front"),
    ("Column", "Front"): ("column_front", "column_left", "column_right"),
    ("Column", "Top"): ("column_top", "column_left"),
    ("Column", "Y-axis linear guide"): ("column_left", "column_front", "column_right"),
    ("Column", "Y-axis motor coupling cover"): ("y_coupling", "column_top"),
    ("Column", "Y-axis motor"): ("y_motor", "y_coupling"),
    ("Column", "Counter side Y-axis ball-screw stand"): ("y_screw", "column_front"),
    ("Column", ""): ("column_front",),
    ("Cooling circuit of chiller", "Joint for oil coming"): ("chiller_return",),
    ("Cooling circuit of chiller", ""): ("oil",),
}
"""Path of nodes by component and beginning of the part's name; the longest match counts."""

COMPONENTS = frozenset(component for component, _ in PARTS)

_MIXTURES: dict[str, dict[str, float]] = {"chiller_return": {"oil": 0.7, "stator": 0.2, "housing_rear": 0.1}}
"""Places that are no node: the oil on its way back has taken up the stator's heat."""


def sensor_shares(sensors: Sequence[SensorConfig]) -> FloatArray:
    """Return the share of each node in what each sensor touches, shape (sensors, nodes), rows sum to 1."""
    by_path: dict[Path, list[int]] = defaultdict(list)
    shares = np.zeros((len(sensors), len(NODES)))
    for row, sensor in enumerate(sensors):
        if sensor.label in LABELS:
            for name, share in LABELS[sensor.label].items():
                shares[row, INDEX[name]] = share
        else:
            by_path[_path(sensor)].append(row)
    for path, rows in by_path.items():
        for row, position in zip(rows, np.linspace(0.0, len(path) - 1.0, len(rows) + 2)[1:-1], strict=True):
            shares[row] = _point(path, float(position))
    return shares


def _path(sensor: SensorConfig) -> Path:
    matches = [key for key in PARTS if key[0] == sensor.component and sensor.part.startswith(key[1])]
    if not matches:
        known = sorted({component for component, _ in PARTS})
        raise ValueError(
            f"sensor {sensor.id}: the simulated machine has no component {sensor.component!r}; it has {known}"
        )
    return PARTS[max(matches, key=lambda key: len(key[1]))]


def _point(path: Path, position: float) -> FloatArray:
    """Return node shares at `position` (0: first node, 1: second ..) along a path."""
    row = np.zeros(len(NODES))
    first = min(int(position), len(path) - 1)
    second = min(first + 1, len(path) - 1)
    for name, share in ((path[first], 1.0 - (position - first)), (path[second], position - first)):
        for node, part in _MIXTURES.get(name, {name: 1.0}).items():
            row[INDEX[node]] += part * share
    return row


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationJump:
    """Apparent displacement of the test bar that comes and goes with rotation, not with heat."""

    um: dict[str, float]
    """Jump per channel [um]; channels that are not named do not jump."""

    def at(self, channel: str, spindle_speed_rpm: float) -> float:
        """Return the jump [um], complete from about 2000 1/min."""
        return self.um.get(channel, 0.0) * float(np.tanh(spindle_speed_rpm / 1000.0))


class SensorArray:
    """All temperature sensors of one machine. Offsets and places belong to the machine, not to the day."""

    def __init__(self, sensors: Sequence[SensorConfig], *, machine_seed: int, noise_seed: int) -> None:
        rng = np.random.default_rng([machine_seed, 302])
        count = len(sensors)
        self._row = {sensor.id: row for row, sensor in enumerate(sensors)}
        self._rows: dict[tuple[int, ...], npt.NDArray[np.intp]] = {}
        self.ids = tuple(self._row)
        self._infrared = np.array([sensor.device == "MLX90615" for sensor in sensors], dtype=bool)
        self.offset_k = rng.uniform(-OFFSET_LIMIT_K, OFFSET_LIMIT_K, count)
        self.lag_s = np.where(self._infrared, INFRARED_LAG_S, rng.uniform(*CONTACT_LAG_S, count))
        self._noise_k = np.where(self._infrared, MLX90615_NOISE_K, TMP102_NOISE_K)
        self._noise_seed = (machine_seed, noise_seed)
        air = rng.uniform(*SURFACE_AIR_SHARE, count)[:, None]
        self._shares = (1.0 - air) * sensor_shares(sensors)
        self._shares[:, INDEX["air_low"]] += 0.5 * air[:, 0]
        self._shares[:, INDEX["air_high"]] += 0.5 * air[:, 0]
        self._slot: tuple[int, FloatArray] | None = None

    def settled(self, node_degc: FloatArray) -> FloatArray:
        """Return the sensors' temperatures [degC] after the nodes have long been at `node_degc`."""
        settled: FloatArray = self._shares @ node_degc
        return settled

    def advance(self, sensor_degc: FloatArray, node_degc: FloatArray, duration_s: float) -> FloatArray:
        """Return the sensors' temperatures [degC] after they have followed the nodes for `duration_s` [s]."""
        gain = -np.expm1(-duration_s / self.lag_s)
        followed: FloatArray = sensor_degc + gain * (self._shares @ node_degc - sensor_degc)
        return followed

    def codes(self, sensor_degc: FloatArray, time_s: float) -> CodeVector:
        """Return the register contents in the order of the sensor list."""
        reading = sensor_degc + self.offset_k + self._noise(time_s)
        contact = np.clip(np.rint(reading / TMP102_DEGC_PER_LSB), -2048, 2047).astype(np.int64) & 0xFFF
        infrared = np.clip(np.rint((reading + ZERO_CELSIUS_K) / MLX90615_K_PER_LSB), 0, 0x7FFF).astype(np.int64)
        return np.where(self._infrared, infrared, contact)

    def pick(self, codes: CodeVector, sensor_ids: Sequence[int]) -> list[int]:
        """Return the codes of the sensors asked for; raises KeyError for an unknown sensor."""
        asked = tuple(sensor_ids)
        if asked not in self._rows:
            self._rows[asked] = np.array([self._row[sensor_id] for sensor_id in asked], dtype=np.intp)
        picked: list[int] = codes[self._rows[asked]].tolist()
        return picked

    def degc(self, codes: CodeVector) -> FloatArray:
        """Return what a reader of the registers understands [degC]."""
        signed = np.where(codes >= 2048, codes - 4096, codes)
        return np.where(
            self._infrared, codes * MLX90615_K_PER_LSB - ZERO_CELSIUS_K, signed * TMP102_DEGC_PER_LSB
        ).astype(np.float64)

    def _noise(self, time_s: float) -> FloatArray:
        slot = int(time_s // NOISE_PERIOD_S)
        if self._slot is None or self._slot[0] != slot:
            rng = np.random.default_rng([*self._noise_seed, slot])
            self._slot = (slot, self._noise_k * rng.standard_normal(self._noise_k.size))
        return self._slot[1]


def displacement_reading_um(true_um: FloatArray, time_s: float, seed: int) -> FloatArray:
    """Return what the A/D logger stores for the true displacements [um]."""
    rng = np.random.default_rng([seed, 6, int(time_s // NOISE_PERIOD_S)])
    noisy = true_um + DISPLACEMENT_NOISE_UM * rng.standard_normal(true_um.size)
    rounded: FloatArray = np.rint(noisy / DISPLACEMENT_STEP_UM) * DISPLACEMENT_STEP_UM
    return rounded
