"""What happens to the frames of sensors, with some chance in it; each kind says when it has passed."""

from dataclasses import dataclass

import numpy as np
from control_rig import SENSOR_IDS
from twin_loop import CHAIN, Disturbance, Frames, TwinLoop


@dataclass(frozen=True, slots=True, kw_only=True)
class BadInput:
    """One history of bad input."""

    disturbance: Disturbance
    passed: int
    """The moment from which on everything is as it should be, but for what stays another."""
    pauses: tuple[int, ...] = ()


def _place(sensor: int) -> tuple[str, int]:
    """Return line and ID on the wire of a sensor."""
    for line, chain in CHAIN.items():
        if sensor in chain:
            return line, chain.index(sensor) + 1
    raise ValueError(sensor)


def _at(frames: Frames, wire_id: int, checked: bool) -> int | None:
    head = b":%03X" % wire_id if checked else b"%02X" % wire_id
    return next((k for k, frame in enumerate(frames) if frame.startswith(head)), None)


def _flipped(frame: bytes, bit: int) -> bytes:
    data = bytearray(frame)
    data[bit // 8] ^= 1 << (bit % 8)
    return bytes(data)


def _said(loop: TwinLoop, frames: Frames, sensor: int, change: int) -> Frames:
    """Let a node say another value than it measures, with the right check."""
    wire_id = _place(sensor)[1]
    place = _at(frames, wire_id, loop.profile != "bare")
    if place is None:
        return frames
    text = frames[place]
    begin = 2 if loop.profile == "bare" else 5
    code = int(text[begin : begin + 3], 16)
    return [*frames[:place], loop.frame(wire_id, code + change), *frames[place + 1 :]]


def _without(loop: TwinLoop, frames: Frames, sensor: int) -> Frames:
    place = _at(frames, _place(sensor)[1], loop.profile != "bare")
    return frames if place is None else frames[:place] + frames[place + 1 :]


def silence(rng: np.random.Generator) -> BadInput:
    """Some sensors say nothing for minutes."""
    gone, length = rng.choice(len(SENSOR_IDS), int(rng.integers(1, 3)), replace=False), int(rng.integers(9, 30))

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        for sensor in gone:
            if moment < length and _place(sensor)[0] == line:
                frames = _without(loop, frames, sensor)
        return frames

    return BadInput(disturbance=disturb, passed=length)


def line_lost(rng: np.random.Generator) -> BadInput:
    """A line is lost for minutes."""
    lost, length = str(rng.choice(list(CHAIN))), int(rng.integers(9, 36))
    return BadInput(
        disturbance=lambda _loop, moment, line, frames, _rng: [] if moment < length and line == lost else frames,
        passed=length,
    )


def corrupt_after_silence(rng: np.random.Generator) -> BadInput:
    """A sensor is silent, and its first frames are wrong: one, three or twelve equal ones."""
    sensor, length, count = int(rng.integers(len(SENSOR_IDS))), int(rng.integers(9, 20)), int(rng.choice([1, 3, 12]))
    change = int(rng.choice([-1, 1]) * 2 ** rng.integers(3, 8))

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if _place(sensor)[0] != line or moment >= length + count:
            return frames
        return _without(loop, frames, sensor) if moment < length else _said(loop, frames, sensor, change)

    return BadInput(disturbance=disturb, passed=length + count)


def corrupt_after_restart(rng: np.random.Generator) -> BadInput:
    """The first frames of a sensor after a restart are wrong and equal."""
    sensor, count = int(rng.integers(len(SENSOR_IDS))), int(rng.integers(1, 13))
    change = int(rng.choice([-1, 1]) * 2 ** rng.integers(3, 8))

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        wrong = 3 <= moment < 3 + count and _place(sensor)[0] == line
        return _said(loop, frames, sensor, change) if wrong else frames

    return BadInput(disturbance=disturb, passed=3 + count, pauses=(3,))


def bit_flips(rng: np.random.Generator) -> BadInput:
    """One frame in ten has one flipped bit, for minutes."""
    length = int(rng.integers(6, 60))

    def disturb(_loop: TwinLoop, moment: int, _line: str, frames: Frames, rng: np.random.Generator) -> Frames:
        if moment >= length:
            return frames
        return [_flipped(f, int(rng.integers(8 * len(f)))) if rng.random() < 0.1 else f for f in frames]

    return BadInput(disturbance=disturb, passed=length)


def replugged(rng: np.random.Generator) -> BadInput:
    """A node is replaced by one with an offset, which stays."""
    sensor, length = int(rng.integers(len(SENSOR_IDS))), int(rng.integers(9, 30))
    change = int(rng.choice([-1, 1]) * rng.integers(10, 128))

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if _place(sensor)[0] != line:
            return frames
        return _without(loop, frames, sensor) if moment < length else _said(loop, frames, sensor, change)

    return BadInput(disturbance=disturb, passed=length)


def line_back_elsewhere(rng: np.random.Generator) -> BadInput:
    """A line is away for minutes, and all its nodes come back with one offset, which stays."""
    lost, length = str(rng.choice(list(CHAIN))), int(rng.integers(9, 36))
    change = int(rng.choice([-1, 1]) * rng.integers(32, 128))

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if line != lost or moment < length:
            return [] if line == lost else frames
        for sensor in CHAIN[lost]:
            frames = _said(loop, frames, sensor, change)
        return frames

    return BadInput(disturbance=disturb, passed=length)


def stuck(rng: np.random.Generator) -> BadInput:
    """A node repeats its value for minutes."""
    sensor, length = int(rng.integers(len(SENSOR_IDS))), int(rng.integers(9, 60))
    kept: list[bytes] = []

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        place = _at(frames, _place(sensor)[1], loop.profile != "bare")
        if _place(sensor)[0] != line or moment >= length or place is None:
            return frames
        kept.append(frames[place])
        return [*frames[:place], kept[0], *frames[place + 1 :]]

    return BadInput(disturbance=disturb, passed=length)


def resets(rng: np.random.Generator) -> BadInput:
    """Some nodes of a line read zero for a while."""
    line_reset, length = str(rng.choice(list(CHAIN))), int(rng.integers(1, 15))
    count = int(rng.integers(1, len(CHAIN[line_reset]) + 1))

    def disturb(loop: TwinLoop, moment: int, line: str, frames: Frames, _rng: np.random.Generator) -> Frames:
        if line != line_reset or moment >= length:
            return frames
        return [
            loop.frame(wire_id, 0) if wire_id <= count else frames[-wire_id] for wire_id in range(len(frames), 0, -1)
        ]

    return BadInput(disturbance=disturb, passed=length)


KINDS = {
    kind.__name__: kind
    for kind in (
        silence,
        line_lost,
        corrupt_after_silence,
        corrupt_after_restart,
        bit_flips,
        replugged,
        line_back_elsewhere,
        stuck,
        resets,
    )
}
