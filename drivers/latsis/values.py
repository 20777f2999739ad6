"""Register codes of a LATSIS line's sensors -> degC with quality and reason. No I/O, no clock."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.contract import FatalDriverError
from drivers.latsis.frames import Frame
from models.quality import ACCEPTED, GOOD, Quality, Reason
from models.records import CodeArray, FloatArray
from models.units import MLX90615_K_PER_LSB, TMP102_DEGC_PER_LSB, degc_from_kelvin

RESET_PLAUSIBLE_DEGC = 2.0
"""A TMP102 that was last within this distance of 0 degC may really read 000h."""
RESET_BURST_SENSORS = 3
"""So many implausible 000h in one cycle are a burst: then no 000h of that cycle counts."""
NAMED_SENSORS = 20
"""How many sensors one sentence names before it counts the rest."""

# Plain numbers: looking a member up in an enumeration costs more than decoding a value.
_NOT_RECEIVED = int(Reason.NOT_RECEIVED)
_DUPLICATE_ID = int(Reason.DUPLICATE_ID)
_RESET = int(Reason.RESET)
_DEVICE_ERROR = int(Reason.DEVICE_ERROR)
_UNREADABLE = int(Reason.UNREADABLE)

Decoded = tuple[float, int]
"""Temperature [degC], NaN where there is none, and code of the `Reason`."""


def decode_tmp102(code: int, *, extended_mode: bool = False) -> Decoded:
    """Return the temperature [degC] of a TMP102 register: two's complement of 12 bit (13 in extended mode)."""
    bits = 13 if extended_mode else 12
    if code >= 1 << bits:
        return math.nan, _UNREADABLE
    signed = code - (1 << bits) if code >> (bits - 1) else code
    return signed * TMP102_DEGC_PER_LSB, ACCEPTED


def decode_mlx90615(code: int) -> Decoded:
    """Return the temperature [degC] of an MLX90615 register; bit 15 is its error flag."""
    if code & 0x8000:
        return math.nan, _DEVICE_ERROR
    return degc_from_kelvin(code * MLX90615_K_PER_LSB), ACCEPTED


@dataclass(frozen=True, slots=True, kw_only=True)
class ChainValues:
    """The values of one pass in chain order, and what went wrong in words."""

    degc: FloatArray
    quality: CodeArray
    reason: CodeArray
    missing: frozenset[int]
    """IDs on the wire that did not arrive."""
    duplicate: frozenset[int]
    """IDs on the wire that came twice or took another's place."""
    faults: tuple[str, ...]


class ChainDecoder:
    """Decodes the frames of one line; keeps the last good value of each sensor for the reset rule.

    A TMP102 reads exactly 000h from a reset of its node to its first conversion: refused (`Reason.RESET`) unless the
    last good value was within 2 degC of 0 degC and the cycle holds no burst of them.
    """

    def __init__(self, line: LineConfig, sensors: Sequence[SensorConfig]) -> None:
        known = {sensor.id: sensor for sensor in sensors}
        if missing := [i for i in line.sensor_ids if i not in known]:
            raise FatalDriverError(f"line {line.name}: its chain names sensors that are not listed: {missing}")
        self.sensor_ids = line.sensor_ids
        self.lowest = line.id_offset + 1
        self.highest = line.id_offset + len(line.sensor_ids)
        self.wire_ids = range(self.lowest, self.highest + 1)
        self._extended_mode = line.extended_mode
        self._infrared = [known[i].device == "MLX90615" for i in line.sensor_ids]
        positive = 0x1000 if self._extended_mode else 0x800
        of_tmp102, of_mlx90615 = (
            (positive, TMP102_DEGC_PER_LSB, 0.0),
            (0x8000, MLX90615_K_PER_LSB, degc_from_kelvin(0.0)),
        )
        self._usual_scale = [
            (wire_id, *(of_mlx90615 if infrared else of_tmp102))
            for wire_id, infrared in zip(self.wire_ids, self._infrared, strict=True)
        ]
        """ID on the wire, end of the codes above zero, step and zero of each sensor [degC]."""
        self._last_good_degc = [math.nan] * len(line.sensor_ids)

    @property
    def value_digits(self) -> dict[int, int]:
        """Digits of VAL by ID on the wire."""
        contact = 4 if self._extended_mode else 3
        return {i: 4 if infrared else contact for i, infrared in zip(self.wire_ids, self._infrared, strict=True)}

    def name(self, wire_id: int) -> str:
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
        count = len(self.sensor_ids)
        return self._values([math.nan] * count, [int(Reason.QUARANTINED)] * count, [])

    def decode(self, frames: Mapping[int, Frame], dropped: Collection[int]) -> ChainValues:
        """Decode the frames by ID; the IDs in `dropped` came twice or took another's place."""
        if not dropped and (usual := self._usual(frames)) is not None:
            return usual
        degc: list[float] = []
        reasons: list[int] = []
        for wire_id, infrared in zip(self.wire_ids, self._infrared, strict=True):
            frame = frames.get(wire_id)
            if wire_id in dropped:
                value, reason = math.nan, _DUPLICATE_ID
            elif frame is None:
                value, reason = math.nan, _NOT_RECEIVED
            elif frame.status:
                value, reason = math.nan, _DEVICE_ERROR
            elif infrared:
                value, reason = decode_mlx90615(frame.code)
            else:
                value, reason = decode_tmp102(frame.code, extended_mode=self._extended_mode)
            degc.append(value)
            reasons.append(reason)
        faults = self._reject_resets(degc, reasons)
        faults += self._device_faults(reasons, frames)
        if any(reasons):
            for index, reason in enumerate(reasons):
                if reason == ACCEPTED:
                    self._last_good_degc[index] = degc[index]
        else:
            self._last_good_degc = degc
        return self._values(degc, reasons, faults)

    def _usual(self, frames: Mapping[int, Frame]) -> ChainValues | None:
        """Decode a pass in which every sensor sends a code above zero and no error; None for any other."""
        degc: list[float] = []
        for wire_id, end, step_degc, zero_degc in self._usual_scale:
            frame = frames.get(wire_id)
            if frame is None or frame.status or not 0 < frame.code < end:
                return None
            degc.append(frame.code * step_degc + zero_degc)
        self._last_good_degc = degc
        return ChainValues(
            degc=np.array(degc),
            quality=np.full(len(degc), GOOD, dtype=np.uint8),
            reason=np.full(len(degc), ACCEPTED, dtype=np.uint8),
            missing=frozenset(),
            duplicate=frozenset(),
            faults=(),
        )

    def _reject_resets(self, degc: list[float], reasons: list[int]) -> list[str]:
        if 0.0 not in degc:
            return []
        zeros = [i for i, value in enumerate(degc) if value == 0.0 and not self._infrared[i]]
        # A sensor without a previous value (NaN) is not within the distance either.
        implausible = [i for i in zeros if not abs(self._last_good_degc[i]) <= RESET_PLAUSIBLE_DEGC]
        burst = len(implausible) >= RESET_BURST_SENSORS
        rejected = zeros if burst else implausible
        for index in rejected:
            degc[index], reasons[index] = math.nan, _RESET
        if not rejected:
            return []
        names = self.names([self.lowest + index for index in rejected])
        kind = f"burst of node resets, {len(rejected)} sensors read" if burst else "node reset, reads"
        return [f"{kind} 000h before the first conversion: {names}"]

    def _device_faults(self, reasons: list[int], frames: Mapping[int, Frame]) -> list[str]:
        faults = []
        for kind, what in ((_DEVICE_ERROR, "reports an error"), (_UNREADABLE, "sent a code beyond its register")):
            for wire_id in self._ids(reasons, kind):
                frame = frames[wire_id]
                faults.append(
                    f"{self.name(wire_id)} {what}: code {frame.code:04X}h, "
                    f"status {frame.status:02X}h, at byte {frame.offset}"
                )
        return faults

    def _ids(self, reasons: list[int], kind: int) -> list[int]:
        if kind not in reasons:
            return []
        return [wire_id for wire_id, reason in zip(self.wire_ids, reasons, strict=True) if reason == kind]

    def _values(self, degc: list[float], reasons: list[int], faults: list[str]) -> ChainValues:
        reason = np.array(reasons, dtype=np.uint8)
        quality = np.full(len(reasons), Quality.MISSING, dtype=np.uint8)
        quality[reason == ACCEPTED] = Quality.GOOD
        return ChainValues(
            degc=np.array(degc, dtype=np.float64),
            quality=quality,
            reason=reason,
            missing=frozenset(self._ids(reasons, _NOT_RECEIVED)),
            duplicate=frozenset(self._ids(reasons, _DUPLICATE_ID)),
            faults=tuple(faults),
        )
