"""Runs compiled O-programs block by block."""

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.sim.nc.blocks import BlockInterpreter, NcError
from drivers.sim.nc.custom_macro.control import MacroControl
from drivers.sim.nc.custom_macro.expressions import Frame, whole_number
from drivers.sim.nc.custom_macro.program import ARGUMENTS, MacroProgram

DEEPEST_CALL = 5
EXTERNAL_OFFSET_TYPE, EXTERNAL_OFFSET_NUMBER = 2, 0
"""G10 L2 P0: external work offset."""


@dataclass(slots=True)
class _Level:
    program: MacroProgram
    frame: Frame
    index: int = 0


class Interpreter(BlockInterpreter[_Level]):
    """One control of custom macro B."""

    end_word = "M99"

    def __init__(self, programs: Mapping[int, MacroProgram], control: MacroControl) -> None:
        super().__init__()
        self.programs = programs
        self.control = control
        self.frame = Frame(control)

    def _begin(self, number: int, arguments: dict[str, float]) -> None:
        self._call(number, arguments)

    def reset(self) -> None:
        """Do what the RESET key does: the program ends where it is, local variables become vacant."""
        super().reset()
        self.frame = Frame(self.control)

    # --- what blocks do ------------------------------------------------------------------

    def alarm(self, number: int, text: str) -> None:
        """Stop with an alarm (#3000): the program is over."""
        self.control.alarm = (number, text)
        self.reset()

    def words(self, words: list[tuple[str, float | None]]) -> None:
        """Run a block of address words; a word with a vacant value is ignored."""
        codes = [whole_number(value) for letter, value in words if letter == "G" and value is not None]
        given = {letter: value for letter, value in words if letter != "G" and value is not None}
        for code in codes:
            if code in (90, 91, 20, 21):
                self.control.set_modal(code)
        special = [code for code in codes if code not in (90, 91, 20, 21)]
        if len(special) > 1:
            raise NcError(f"G{special[0]} and G{special[1]} do not go together in one block here")
        if special:
            self._special(special[0], given)
        elif given:
            self._auxiliary(given)

    def _special(self, code: int, given: dict[str, float]) -> None:
        if code == 10:
            self._write_offset(given)
        elif code == 4:
            self._dwell(given)
        elif code == 53:
            if given:
                raise NcError("G53 stands alone here: it only ends the reading ahead")
        elif code == 65:
            self._call(whole_number(given.pop("P", 0.0)), given)
        else:
            raise NcError(f"G{code} is not known here")

    def _auxiliary(self, given: dict[str, float]) -> None:
        if set(given) == {"M"} and given["M"] in self.control.waiting_m_codes:
            return
        if given and set(given) <= {"S", "F"}:
            self.control.spindle_rpm = given.get("S", self.control.spindle_rpm)
            self.control.feed_mm_min = given.get("F", self.control.feed_mm_min)
            return
        if given != {"M": 99.0}:
            raise NcError(f"{' '.join(f'{letter}{value:g}' for letter, value in given.items())} is not known here")
        self._levels.pop()
        self.frame = self._levels[-1].frame if self._levels else Frame(self.control)

    def _dwell(self, given: dict[str, float]) -> None:
        if set(given) == {"P"}:
            self.dwell_s = given["P"] / 1000.0
        elif set(given) == {"X"}:
            self.dwell_s = given["X"]
        else:
            raise NcError("G04 takes P [ms] or X [s]")

    def _write_offset(self, given: dict[str, float]) -> None:
        axes = {letter: value for letter, value in given.items() if letter not in "LP"}
        if given.get("L") != EXTERNAL_OFFSET_TYPE or given.get("P") != EXTERNAL_OFFSET_NUMBER:
            raise NcError("of G10 only L2 P0 is known here, the external work offset")
        for letter, value in axes.items():
            self.control.set_external(letter, value)

    def _call(self, number: int, arguments: Mapping[str, float]) -> None:
        program = self.programs.get(number)
        if program is None:
            raise NcError(f"there is no program O{number}")
        if len(self._levels) >= DEEPEST_CALL:
            raise NcError(f"more than {DEEPEST_CALL} calls within one another")
        frame = Frame(self.control)
        for letter, value in arguments.items():
            if letter not in ARGUMENTS:
                raise NcError(f"G65 takes no argument {letter}")
            frame.local[ARGUMENTS[letter]] = value
        self._levels.append(_Level(program, frame))
        self.frame = frame
