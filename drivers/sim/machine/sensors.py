"""The simulated machine's sensors: from node temperatures to register codes, from shape to readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.heat import INDEX
from drivers.sim.machine.sensor_places import sensor_shares
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
