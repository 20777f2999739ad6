"""What is asked of a FANUC control over FOCAS2, what its answers mean, and what its refusals mean; without I/O."""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from config.schema.cnc import AxisPositionConfig
from config.schema.cnc_drivers import FocasConfig
from drivers.contract import Capability, FatalDriverError, LinkError, position_mm
from drivers.focas.codec import (
    Answer,
    Ask,
    FocasFormatError,
    Function,
    encode_value,
    parse_integers,
    parse_values,
    runs_of,
)

MACROS_PER_BLOCK = 5
"""A control answers so many macro variables to one block that reads them."""
WORK_OFFSET, ADDITIONAL_OFFSET = 4014, 4130
"""System variables: modal G of the work offset; P of G54.1."""
MACHINE_COORDINATES, ALL_AXES = 1, -1
"""Arguments of the block that reads axis positions."""
BYTES_PER_AXIS = 8
BUSY = -1
NO_FUNCTION, NO_OPTION = 1, 6
REFUSALS: Mapping[int, str] = {
    BUSY: "it is busy; try again",
    NO_FUNCTION: "it does not have this function, or not in this state",
    2: "the length does not fit",
    3: "it has no such number",
    4: "the attribute does not fit",
    5: "it does not take this value",
    NO_OPTION: "an option is missing (custom macro, Ethernet): ask the machine's builder for it",
    7: "it is write-protected: turn the key of the memory protection, or free the variable by parameter",
    8: "its memory is full",
    9: "a parameter forbids it",
    10: "its buffer is full; try again",
    11: "the path does not exist: check cnc.focas.path",
    12: "it is in another mode",
    13: "it rejects it: end the editing of programs, background editing too",
    14: "its data server answers with an error",
    15: "an alarm is active: clear it",
    16: "it stands still in this state",
    17: "a password protects it",
}
"""Error of a block -> what the control means by it."""
AGAIN = frozenset({BUSY, 10})
"""Errors after which trying again may help."""


def refusal(error: int) -> str:
    """Return what the control means by the error of a block."""
    return f"{REFUSALS.get(error, 'a reason that is not known here')} (error {error})"


def unreadable(what: str, error: int) -> LinkError | FatalDriverError:
    """Return the error to raise where something cannot be read."""
    text = f"the CNC does not let {what} be read: {refusal(error)}"
    return LinkError(text) if error in AGAIN else FatalDriverError(text)


@dataclass(frozen=True, slots=True)
class SystemInfo:
    """What a control says of itself."""

    text: str
    """Type, machine type, series and version."""
    is_31i: bool
    """Whether it is of the 30i family, whose diagnosis has a function of its own."""

    @classmethod
    def parse(cls, answer: Answer) -> "SystemInfo":
        """Return what the answer says; raises FocasFormatError, LinkError or FatalDriverError."""
        if answer.error:
            raise unreadable("its type", answer.error)
        if len(answer.data) != 18:
            raise FocasFormatError(f"the system's description has 18 bytes, not {len(answer.data)}")
        parts = struct.unpack(">4x2s2s4s4s2x", answer.data)
        words = [part.decode("ascii", "replace").strip("\0 ") for part in parts]
        return cls("-".join(word for word in words if word), words[0] in ("30", "31", "32", "35"))


def macro_asks(numbers: Sequence[int]) -> list[tuple[range, Ask]]:
    """Return the blocks that read macro variables, each with the numbers that it reads."""
    runs = runs_of(numbers, MACROS_PER_BLOCK)
    return [(run, Ask(Function.READ_MACRO, (run.start, run[-1]))) for run in runs]


def macro_values(asked: Sequence[tuple[range, Ask]], answers: Sequence[Answer]) -> dict[int, float | None]:
    """Return macro variables by number, None where vacant; raises what `unreadable` returns, FocasFormatError."""
    values: dict[int, float | None] = {}
    for (run, _), answer in zip(asked, answers, strict=True):
        if answer.error:
            last = f" to #{run[-1]}" if len(run) > 1 else ""
            raise unreadable(f"macro variable #{run.start}{last}", answer.error)
        values.update(zip(run, parse_values(answer.data, len(run), run.start), strict=True))
    return values


def write_asks(group: Sequence[tuple[int, float]], *, doubles: bool) -> list[tuple[range, Ask]]:
    """Return the blocks that write a group; without `doubles` one by one, as older controls take them."""
    values = dict(group)
    asks = []
    for run in runs_of(list(values), len(values) if doubles else 1):
        if doubles:
            extra = struct.pack(f">{len(run)}d", *(values[number] for number in run))
            asks.append((run, Ask(Function.WRITE_MACROS, (run.start, 0, 0, 0), extra)))
        else:
            extra = encode_value(values[run.start])
            asks.append((run, Ask(Function.WRITE_MACRO, (run.start, run.start, 0, 0), extra)))
    return asks


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """What a control says of itself in one poll, macro variables apart."""

    mode: int
    run: int
    alarm: bool
    program: int
    sequence_number: int
    spindle_speed_rpm: float
    motor_temperature_degc: float
    positions_mm: dict[str, float]


class StateRequest:
    """The blocks that read the state; what the control does not have is left out once it has said so."""

    def __init__(
        self, config: FocasConfig, system: SystemInfo, axes: Mapping[str, AxisPositionConfig] | None = None
    ) -> None:
        self._diagnosis = config.motor_temperature_diagnosis
        self._is_31i = system.is_31i
        self._axes = axes or {}
        self.cannot: dict[str, str] = {}
        """Measurements that the control does not give, with the reason."""
        if self._diagnosis is None:
            self.cannot["motor_temperature"] = (
                "cnc.focas.motor_temperature_diagnosis names no number of a diagnosis that shows it"
            )

    def asks(self) -> list[Ask]:
        asks = [Ask(Function.STATUS), Ask(Function.PROGRAM_NUMBER), Ask(Function.SEQUENCE_NUMBER)]
        if "spindle_speed" not in self.cannot:
            asks.append(Ask(Function.SPINDLE_SPEED))
        if "motor_temperature" not in self.cannot:
            number = self._diagnosis or 0
            function = Function.DIAGNOSIS_31I if self._is_31i else Function.DIAGNOSIS
            asks.append(Ask(function, (number, number, 1)))
        if self._axes and Capability.AXIS_POSITION not in self.cannot:
            asks.append(Ask(Function.AXIS_POSITION, (MACHINE_COORDINATES, ALL_AXES)))
        return asks

    def parse(self, asks: Sequence[Ask], answers: Sequence[Answer]) -> State:
        """Return the state; raises FocasFormatError, LinkError or FatalDriverError."""
        found = {ask.function: answer for ask, answer in zip(asks, answers, strict=True)}
        for what, function in (
            ("its status", Function.STATUS),
            ("the program's number", Function.PROGRAM_NUMBER),
            ("the sequence number", Function.SEQUENCE_NUMBER),
        ):
            if found[function].error:
                raise unreadable(what, found[function].error)
        mode, run, _, _, emergency, alarm, _ = parse_integers(found[Function.STATUS].data, "7h")
        running, main = parse_integers(found[Function.PROGRAM_NUMBER].data, "ii")
        (sequence_number,) = parse_integers(found[Function.SEQUENCE_NUMBER].data, "i")
        speed = self._measured("spindle_speed", found.get(Function.SPINDLE_SPEED))
        motor = self._measured(
            "motor_temperature", found.get(Function.DIAGNOSIS_31I if self._is_31i else Function.DIAGNOSIS)
        )
        return State(
            mode=mode,
            run=run,
            alarm=bool(alarm or emergency),
            program=main or running,
            sequence_number=sequence_number,
            spindle_speed_rpm=math.nan if speed is None else _value(speed),
            motor_temperature_degc=math.nan if motor is None else self._temperature(motor),
            positions_mm=self._positions_mm(found.get(Function.AXIS_POSITION)),
        )

    def _positions_mm(self, answer: Answer | None) -> dict[str, float]:
        """Return the position of each axis [mm], NaN where there is none."""
        data = self._measured(Capability.AXIS_POSITION, answer) or b""
        count, last = len(data) // BYTES_PER_AXIS, max((axis.place for axis in self._axes.values()), default=0)
        values = parse_values(data[: last * BYTES_PER_AXIS], min(count, last))  # places without an axis hold anything
        if data and (beyond := [name for name, axis in self._axes.items() if axis.place > count]):
            self.cannot[Capability.AXIS_POSITION] = f"{beyond[0]}: the control has {count} axes"
        return {
            name: position_mm(axis, values[axis.place - 1] if axis.place <= len(values) else None)
            for name, axis in self._axes.items()
        }

    def _measured(self, name: str, answer: Answer | None) -> bytes | None:
        """Return the bytes of a measurement, None where the control does not have it."""
        if answer is None:
            return None
        if answer.error in AGAIN:
            return None
        if answer.error:
            self.cannot[name] = f"the control says: {refusal(answer.error)}"
            return None
        return answer.data

    def _temperature(self, data: bytes) -> float:
        """Return the diagnosis' value of the first spindle; it names its own number."""
        number, _, kind = parse_integers(data[:8], "ihh")
        if number != self._diagnosis:
            raise FocasFormatError(f"diagnosis {self._diagnosis} was asked for and {number} answered")
        if self._is_31i:
            return _value(data[8:16])
        (value,) = parse_integers(data[8:12], "i")
        return float(value & 0xFF if kind in (0, 4) else value)


def _value(data: bytes) -> float:
    (value,) = parse_values(data, 1)
    return math.nan if value is None else value
