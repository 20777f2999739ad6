"""What the state of a Haas control is, from the words and variables that it answers with; without I/O."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from config.schema.cnc import AxisPositionConfig
from config.schema.cnc_drivers import HaasConfig
from drivers.contract import Capability, position_mm
from drivers.haas.codec import Answer
from models.records import CncMode, CncRun

TIED_OFFSET = 154
"""G154 takes its offset from a word P; #4116 holds the latest P of any block, such as G04's."""
MACHINE_POSITION = 5020
"""#5021 .. hold the machine positions of axis 1 .., in the unit of the control."""
MOST_AXES = 6
UNIT_CODE, INCH, METRIC = 4006, 20, 21
"""System variable with the modal G20 or G21, which agrees with the control's setting 9."""
MODES: Mapping[str, CncMode] = {
    "MEM": CncMode.MEMORY,
    "MDI": CncMode.MDI,
    "EDIT": CncMode.EDIT,
    "LIST PROG": CncMode.EDIT,
    "JOG": CncMode.JOG,
    "HANDLE JOG": CncMode.HANDLE,
}
RUNS: Mapping[str, CncRun] = {
    "BUSY": CncRun.START,
    "IDLE": CncRun.RESET,
    "FEED HOLD": CncRun.HOLD,
    "SINGLE BLOCK": CncRun.HOLD,
    "ALARM ON": CncRun.STOP,
}
"""State in the answer to ?Q500 -> run state; anything else is unknown, which counts as cutting."""
NO_MOTOR_TEMPERATURE = "a Haas control does not tell the spindle motor's temperature by machine data collection"
_PROGRAM = re.compile(r"O(\d{1,5})")


def mode_of(answer: Answer) -> CncMode:
    """Return the operating mode that ?Q104 tells."""
    return MODES.get(answer.fields[1].strip("()"), CncMode.UNKNOWN)


@dataclass(frozen=True, slots=True)
class ProgramState:
    """What ?Q500 tells."""

    run: CncRun
    alarm: bool
    program: int | None
    """The O number; None while the control says its state alone."""

    @classmethod
    def of(cls, answer: Answer) -> "ProgramState":
        words = [field for field in answer.fields[1:] if field != "STATUS"] or [""]
        named = _PROGRAM.fullmatch(words[0])
        state = words[0] if answer.fields[0] == "STATUS" else "".join(words[1:2])
        return cls(RUNS.get(state, CncRun.UNKNOWN), state == "ALARM ON", int(named[1]) if named else None)


class StateVariables:
    """The system variables of the state; what the control leaves vacant at first is left out, and said."""

    def __init__(self, config: HaasConfig, axes: Mapping[str, AxisPositionConfig] | None = None) -> None:
        self._axes = axes or {}
        self._asked = {name: MACHINE_POSITION + axis.place for name, axis in self._axes.items()}
        if max((axis.place for axis in self._axes.values()), default=0) > MOST_AXES:
            self._asked = {}
        self.sequence_number, self.program = config.sequence_number_macro, config.program_macro
        self.tool, self.speed, self.offset = config.tool_macro, config.spindle_speed_macro, config.work_offset_macro
        self.cannot: dict[str, str] = {Capability.MOTOR_TEMPERATURE: NO_MOTOR_TEMPERATURE}
        """Capabilities that this control does not have, with the reason."""
        self._optional = {
            Capability.SEQUENCE_NUMBER: self.sequence_number,
            Capability.PROGRAM: self.program,
            Capability.SPINDLE_SPEED: self.speed,
        }

    @property
    def numbers(self) -> tuple[int, ...]:
        optional = [number for name, number in self._optional.items() if name not in self.cannot]
        axes = (*self._asked.values(), UNIT_CODE) if self._asked else ()
        return (*self.marks, *(number for number in optional if number == self.speed), *axes)

    @property
    def marks(self) -> tuple[int, ...]:
        """Those that tell where the program is."""
        optional = [number for name, number in self._optional.items() if name not in self.cannot]
        return (self.offset, self.tool, *(number for number in optional if number != self.speed))

    def judge(self, values: Mapping[int, float | None]) -> None:
        """Leave out, from the first values, what is vacant."""
        for name, number in self._optional.items():
            if values[number] is None:
                self.cannot[name] = f"system variable #{number} is vacant"
        if self._axes and not self._asked:
            self.cannot[Capability.AXIS_POSITION] = f"a Haas control tells the positions of {MOST_AXES} axes"
        elif self._axes and values.get(UNIT_CODE) not in (INCH, METRIC):
            said = f"its unit is not known: system variable #{UNIT_CODE} is neither {INCH} nor {METRIC}"
            self.cannot[Capability.AXIS_POSITION] = said
        elif vacant := [number for number in self._asked.values() if values[number] is None]:
            self.cannot[Capability.AXIS_POSITION] = f"system variable #{vacant[0]} is vacant"

    def positions_mm(self, values: Mapping[int, float | None]) -> dict[str, float]:
        """Return the position of each axis [mm], NaN where the control tells neither it nor its unit."""
        unit = values.get(UNIT_CODE)
        return {
            name: position_mm(axis, values.get(self._asked.get(name, 0)), inch=unit == INCH)
            if unit in (INCH, METRIC)
            else math.nan
            for name, axis in self._axes.items()
        }

    def speed_rpm(self, values: Mapping[int, float | None]) -> float:
        """Return the spindle speed [1/min], NaN where it is not told."""
        value = values.get(self.speed)
        return math.nan if value is None else value

    def work_offset(self, values: Mapping[int, float | None]) -> int:
        """Return 54 to 59 or 110 to 129; 0 where the control does not say, as of G154, whose P no variable tells."""
        code = values[self.offset] or 0.0
        return int(code) if code.is_integer() and code != TIED_OFFSET else 0
