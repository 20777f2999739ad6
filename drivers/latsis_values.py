"""Register codes of a LATSIS line's sensors -> degC with quality and reason. No I/O, no clock."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.contract import FatalDriverError
from drivers.latsis_frames import Frame
from models.quality import Quality, Reason
from models.records import CodeArray, FloatArray
from models.units import MLX90615_K_PER_LSB, TMP102_DEGC_PER_LSB, degc_from_kelvin

RESET_PLAUSIBLE_DEGC = 2.0
"""A TMP102 that was last within this distance of 0 degC may really read 000h."""
RESET_BURST_SENSORS = 3
"""So many implausible 000h in one cycle are a burst: then no 000h of that cycle is believed."""
NAMED_SENSORS = 20
"""How many sensors one sentence names before it counts the rest."""

Decoded = tuple[float, Reason]


def decode_tmp102(code: int, *, extended_mode: bool = False) -> Decoded:
    """Return the temperature [degC] of a TMP102 register: two's complement of 12 bit (13 in extended mode)."""
    bits = 13 if extended_mode else 12
    if code >= 1 << bits:
        return math.nan, Reason.UNREADABLE
    signed = code - (1 << bits) if code >> (bits - 1) else code
    return signed * TMP102_DEGC_PER_LSB, Reason.NONE


def decode_mlx90615(code: int) -> Decoded:
    """Return the temperature [degC] of an MLX90615 register; bit 15 is its error flag."""
    if code & 0x8000:
        return math.nan, Reason.DEVICE_ERROR
    return degc_from_kelvin(code * MLX90615_K_PER_LSB), Reason.NONE


@dataclass(frozen=True, slots=True, kw_only=True)
class ChainValues:
    """The values of one pass in chain order, and what went wrong in words."""

    degc: FloatArray
    quality: CodeArray
    reason: CodeArray
    faults: tuple[str, ...]


class ChainDecoder:
    """Decodes the frames of one line; remembers the last good value of each sensor for the reset rule.

    A TMP102 reads exactly 000h from a reset of its node to its first conversion. Such a value is refused
    (`Reason.RESET`) unless the sensor's previous good value was within 2 degC of 0 degC and the cycle
    holds no burst of them. A sensor without a previous value is refused as well: its next other code counts.
    """

    def __init__(self, line: LineConfig, sensors: Sequence[SensorConfig]) -> None:
        known = {sensor.id: sensor for sensor in sensors}
        if missing := [i for i in line.sensor_ids if i not in known]:
            raise FatalDriverError(f"line {line.name}: its chain names sensors that are not listed: {missing}")
        self.line = line
        self.sensor_ids = line.sensor_ids
        self.lowest = line.id_offset + 1
        self.highest = line.id_offset + len(line.sensor_ids)
        self._infrared = [known[i].device == "MLX90615" for i in line.sensor_ids]
        self._last_good_degc = [math.nan] * len(line.sensor_ids)

    @property
    def value_digits(self) -> dict[int, int]:
        """Digits of VAL by ID on the wire."""
        contact = 4 if self.line.extended_mode else 3
        return {self.lowest + index: 4 if infrared else contact for index, infrared in enumerate(self._infrared)}

    def name(self, wire_id: int) -> str:
        """Return the sensor under an ID of the wire in words."""
        if self.lowest <= wire_id <= self.highest:
            return f"sensor {self.sensor_ids[wire_id - self.lowest]} (ID {wire_id:03X}h)"
        return f"no sensor of this line (ID {wire_id:03X}h)"

    def names(self, wire_ids: Collection[int]) -> str:
        """Return several sensors in words, at most `NAMED_SENSORS` by name."""
        listed = sorted(wire_ids, reverse=True)
        text = ", ".join(self.name(wire_id) for wire_id in listed[:NAMED_SENSORS])
        return text if len(listed) <= NAMED_SENSORS else f"{text} and {len(listed) - NAMED_SENSORS} more"

    def withheld(self) -> ChainValues:
        """Return values that are assigned to no sensor because the line's numbering is not trusted."""
        return self._values([(math.nan, Reason.QUARANTINED)] * len(self.sensor_ids), [])

    def decode(self, frames: Mapping[int, Frame], dropped: Collection[int]) -> ChainValues:
        """Decode the frames by ID; the IDs in `dropped` came twice or took another's place."""
        decoded: list[Decoded] = []
        zeros: list[int] = []
        for index in range(len(self.sensor_ids)):
            wire_id = self.lowest + index
            frame = frames.get(wire_id)
            if wire_id in dropped:
                decoded.append((math.nan, Reason.DUPLICATE_ID))
            elif frame is None:
                decoded.append((math.nan, Reason.NOT_RECEIVED))
            else:
                decoded.append(self._decode_frame(index, frame))
                if decoded[-1] == (0.0, Reason.NONE) and not self._infrared[index]:
                    zeros.append(index)
        faults = self._reject_resets(decoded, zeros)
        faults += self._device_faults(decoded, frames)
        for index, (degc, reason) in enumerate(decoded):
            if reason is Reason.NONE:
                self._last_good_degc[index] = degc
        return self._values(decoded, faults)

    def _decode_frame(self, index: int, frame: Frame) -> Decoded:
        if frame.status:
            return math.nan, Reason.DEVICE_ERROR
        if self._infrared[index]:
            return decode_mlx90615(frame.code)
        return decode_tmp102(frame.code, extended_mode=self.line.extended_mode)

    def _reject_resets(self, decoded: list[Decoded], zeros: list[int]) -> list[str]:
        # A sensor without a previous value (NaN) is not within the distance either.
        implausible = [i for i in zeros if not abs(self._last_good_degc[i]) <= RESET_PLAUSIBLE_DEGC]
        burst = len(implausible) >= RESET_BURST_SENSORS
        rejected = zeros if burst else implausible
        for index in rejected:
            decoded[index] = (math.nan, Reason.RESET)
        if not rejected:
            return []
        names = self.names([self.lowest + index for index in rejected])
        kind = f"burst of node resets, {len(rejected)} sensors read" if burst else "node reset, reads"
        return [f"{kind} 000h before the first conversion: {names}"]

    def _device_faults(self, decoded: list[Decoded], frames: Mapping[int, Frame]) -> list[str]:
        faults = []
        for index, (_, reason) in enumerate(decoded):
            if reason in {Reason.DEVICE_ERROR, Reason.UNREADABLE}:
                frame = frames[self.lowest + index]
                what = "reports an error" if reason is Reason.DEVICE_ERROR else "sent a code beyond its register"
                faults.append(
                    f"{self.name(frame.wire_id)} {what}: code {frame.code:04X}h, "
                    f"status {frame.status:02X}h, at byte {frame.offset}"
                )
        return faults

    @staticmethod
    def _values(decoded: Sequence[Decoded], faults: list[str]) -> ChainValues:
        reason = np.array([int(reason) for _, reason in decoded], dtype=np.uint8)
        return ChainValues(
            degc=np.array([degc for degc, _ in decoded], dtype=np.float64),
            quality=np.where(reason == Reason.NONE, Quality.GOOD, Quality.MISSING).astype(np.uint8),
            reason=reason,
            faults=tuple(faults),
        )
