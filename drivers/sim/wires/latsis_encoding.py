"""What the nodes of a simulated LATSIS line put on the wire, byte by byte and when.

frame = [SOF] ID SEP VAL [SEP STAT] ["*" CHK] EOL, hexadecimal in capitals. CHK covers what stands
between SOF and the asterisk: sum8 is the sum of its characters modulo 256, lrc8 the number that
brings that sum to zero, crc8 the remainder of the SMBus polynomial 07h with start value 0.
"""

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from config.schema.temperatures import GrammarConfig, LineConfig
from drivers.sim.faults import Fault, FaultKind, of_kind

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""
TMP102_DEGC_PER_COUNT = 1 / 16
MLX90615_DEGC_PER_COUNT = 1 / 50
KEPT_FRAMES = 20_000
LINE_ENDS = {"CR": "\r", "LF": "\n", "CRLF": "\r\n"}

RegisterCodes = Callable[[Sequence[int]], list[int]]


def encode_frame(grammar: GrammarConfig, wire_id: int, digits: int, value: int, status: int = 0) -> bytes:
    """Return one node's frame; raises ValueError for an ID or value that does not fit its digits."""
    if not 0 <= wire_id < 16**grammar.id_digits or not 0 <= value < 16**digits:
        raise ValueError(f"ID {wire_id:X}h, value {value:X}h do not fit {grammar.id_digits} and {digits} digits")
    parts = [f"{wire_id:0{grammar.id_digits}X}", f"{value:0{digits}X}"]
    if grammar.status:
        parts.append(f"{status:02X}")
    body = grammar.separator.join(parts)
    check = f"*{checksum(grammar.checksum, body.encode()):02X}" if grammar.checksum != "none" else ""
    return f"{grammar.start}{body}{check}{LINE_ENDS[grammar.end]}".encode()


def checksum(kind: str, text: bytes) -> int:
    if kind == "crc8":
        remainder = 0
        for bit in (byte >> shift & 1 for byte in text for shift in range(7, -1, -1)):
            carry = remainder >> 7
            remainder = remainder << 1 & 0xFF
            if carry ^ bit:
                remainder ^= 0x07
        return remainder
    total = 0
    for byte in text:
        total = total + byte & 0xFF
    return total if kind == "sum8" else (256 - total) % 256


@dataclass(slots=True)
class _Pass:
    """One pass over the line: its bytes, when it began, and how many of them have left."""

    number: int
    start_s: float
    data: bytes
    sent: int = 0
    whole: bool = True
    disturbed: bool = False


class LineTransmitter:
    """All nodes of one line. Moved on in time by `advance`; keeps no clock and does no I/O."""

    def __init__(
        self,
        line: LineConfig,
        devices: dict[int, str],
        read: RegisterCodes,
        *,
        phase_s: float = 0.0,
        until_s: float = math.inf,
        faults: Sequence[Fault] = (),
        seed: int = 0,
    ) -> None:
        """Prepare the line; `read` gives registers by sensor ID, passes begin from `phase_s` until `until_s`."""
        self._line = line
        self._mlx90615 = frozenset(i for i in line.sensor_ids if devices[i] == "MLX90615")
        self._read = read
        self._phase_s = phase_s
        self._until_s = until_s
        self._byte_s = BITS_PER_BYTE / line.baud
        self._faults = [f for f in faults if f.target == line.name or f.target in line.sensor_ids]
        self._byte_faults = of_kind(self._faults, FaultKind.NOISE, FaultKind.LOST_BYTES)
        self._cuts = [f for f in of_kind(self._faults, FaultKind.DEAD_LINE) if f.amount == 0]
        self._unplugged = of_kind(self._faults, FaultKind.UNPLUGGED)
        self._random = {f: random.Random(f"{seed} {line.name} {f.kind} {f.at_s}") for f in self._byte_faults}
        self._stuck: dict[Fault, int] = {}
        self._frames: dict[tuple[int, int, int], bytes] = {}
        """Frames that went out before; there are few, because a temperature keeps to its surroundings."""
        self._pass: _Pass | None = None
        self._last_number = -1
        self._near: list[Fault] = []
        self.cycles_sent = 0
        """Passes whose bytes all went out on the wire (whether a reader was there or not)."""
        self.cycles_disturbed = 0
        """Passes that a fault touched."""
        self.last_pass_s: tuple[float, float] | None = None
        """When the latest pass that has gone out began and ended [s]."""
        self.pass_s = self._checked_pass_s()
        """Time that a whole pass takes on the wire [s]."""

    def plugged(self, now_s: float) -> bool:
        return not any(fault.active(now_s) for fault in self._unplugged)

    @property
    def idle(self) -> bool:
        return self._pass is None

    def advance(self, now_s: float) -> bytes:
        """Return the bytes whose last bit has left since the last call."""
        out = bytearray()
        while True:
            if self._pass is None:
                number = self._next_number(now_s)
                if number is None:
                    return bytes(out)
                self._begin(number)
            assert self._pass is not None
            out += self._send(self._pass, now_s)
            if self._pass.sent < len(self._pass.data):
                return bytes(out)
            self._finish(self._pass)

    @property
    def next_start_s(self) -> float:
        """When the next pass begins, and the registers are read [s]; inf when none does."""
        start_s = self._start_s(self._last_number + 1)
        return start_s if start_s < self._until_s else math.inf

    def _start_s(self, number: int) -> float:
        return self._phase_s + number * self._line.cycle_period_s

    def _next_number(self, now_s: float) -> int | None:
        """Return the number of the pass that begins next, None when it has not begun yet."""
        return self._last_number + 1 if self.next_start_s <= now_s else None

    def _begin(self, number: int) -> None:
        start_s = self._start_s(number)
        self._last_number = number
        self._faults = [fault for fault in self._faults if not fault.over(start_s)]
        on_the_way = (*self._byte_faults, *self._cuts, *self._unplugged)
        self._near = [f for f in on_the_way if f.at_s <= start_s + self.pass_s and not f.over(start_s)]
        data, disturbed = self._encode(start_s)
        self._pass = _Pass(number=number, start_s=start_s, data=data, disturbed=disturbed)

    def _finish(self, done: _Pass) -> None:
        self.last_pass_s = (done.start_s, done.start_s + len(done.data) * self._byte_s)
        self.cycles_sent += done.whole
        self.cycles_disturbed += done.disturbed
        self._pass = None

    def _send(self, current: _Pass, now_s: float) -> bytes:
        due = min(len(current.data), max(current.sent, int((now_s - current.start_s) / self._byte_s + 1e-9)))
        data, first, current.sent = current.data[current.sent : due], current.sent, due
        if not self._near:
            return data
        out = bytearray()
        for index, byte in enumerate(data, start=first):
            at_s = current.start_s + (index + 1) * self._byte_s
            if any(fault.active(at_s) and fault not in self._random for fault in self._near):
                current.whole, current.disturbed = False, True
                continue
            arrived = self._through_faults(byte, at_s)
            current.disturbed |= arrived != byte
            if arrived is not None:
                out.append(arrived)
        return bytes(out)

    def _through_faults(self, byte: int, at_s: float) -> int | None:
        for fault in self._near:
            if fault in self._random and fault.active(at_s) and self._random[fault].random() < fault.amount:
                if fault.kind is FaultKind.LOST_BYTES:
                    return None
                byte ^= 1 << self._random[fault].randrange(8)
        return byte

    def _encode(self, now_s: float) -> tuple[bytes, bool]:
        """Return the bytes of a pass that begins now, highest ID first, and whether a fault shaped it."""
        chain = list(self._line.sensor_ids)
        active = [fault for fault in self._faults if fault.active(now_s)]
        for fault in active:
            if fault.kind is FaultKind.RENUMBERED:
                del chain[int(fault.amount) - 1]
        reach = min(
            [int(f.amount) for f in active if f.kind is FaultKind.DEAD_LINE and f.amount > 0], default=len(chain)
        )
        codes = self._read(chain)
        if active:
            codes = [self._faulted(i, code, active, now_s) for i, code in zip(chain, codes, strict=True)]
        sent = self._frames.get
        nodes = zip(range(1, reach + 1), chain, codes, strict=False)
        frames = [sent(node) or self._frame(*node) for node in nodes]
        shaping = [f for f in active if f not in self._byte_faults]
        return b"".join(reversed(frames)), bool(shaping)

    def _faulted(self, sensor_id: int, code: int, active: Sequence[Fault], now_s: float) -> int:
        mlx90615 = sensor_id in self._mlx90615
        for fault in active:
            if fault.kind is FaultKind.RESET_BURST and not mlx90615 and fault.target in (self._line.name, sensor_id):
                return 0
            if fault.target != sensor_id:
                continue
            if fault.kind is FaultKind.STUCK_SENSOR:
                code = self._stuck.setdefault(fault, code)
            elif fault.kind is FaultKind.FLIPPED_BIT:
                code ^= 1 << int(fault.amount)
            elif fault.kind is FaultKind.DRIFTING_SENSOR:
                step_degc = MLX90615_DEGC_PER_COUNT if mlx90615 else TMP102_DEGC_PER_COUNT
                code += round(fault.amount * (now_s - fault.at_s) / 3600 / step_degc)
        return code

    def _frame(self, position: int, sensor_id: int, code: int) -> bytes:
        if len(self._frames) >= KEPT_FRAMES:
            self._frames.clear()
        frame = self._frames[position, sensor_id, code] = self._new_frame(position, sensor_id, code)
        return frame

    def _new_frame(self, position: int, sensor_id: int, code: int) -> bytes:
        digits, bits = self._width(sensor_id)
        if sensor_id not in self._mlx90615 and bits == 13 and code & 0x800:
            code -= 0x1000
        return encode_frame(self._line.frame_grammar, self._line.id_offset + position, digits, code & (1 << bits) - 1)

    def _width(self, sensor_id: int) -> tuple[int, int]:
        """Return digits and bits of a sensor's register."""
        if sensor_id in self._mlx90615:
            return 4, 16
        return (4, 13) if self._line.extended_mode else (3, 12)

    def _checked_pass_s(self) -> float:
        frames = [self._frame(position, i, 0) for position, i in enumerate(self._line.sensor_ids, start=1)]
        needed_s = sum(map(len, frames)) * self._byte_s
        if needed_s > self._line.cycle_period_s:
            raise ValueError(
                f"line {self._line.name} needs {needed_s:.1f} s per cycle at {self._line.baud} baud, "
                f"more than its cycle_period_s of {self._line.cycle_period_s:g} s"
            )
        return needed_s
