"""Runs compiled SINUMERIK programs block by block."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.sim.nc.blocks import BlockInterpreter, NcError
from drivers.sim.nc.sinumerik.control import SinumerikControl
from drivers.sim.nc.sinumerik.expressions import Value
from drivers.sim.nc.sinumerik.program import SinumerikProgram

DEEPEST_CALL = 8
FIRST_ALARM = 65_000
"""Numbers of the user's alarms are counted from here."""


@dataclass(slots=True)
class _Level:
    program: SinumerikProgram
    index: int = 0
    local: dict[str, Value] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    given: list[bool] = field(default_factory=list)


class SinumerikInterpreter(BlockInterpreter[_Level]):
    """One channel; static synchronised actions outlast a reset."""

    end_word = "M17"

    def __init__(self, programs: Mapping[str, SinumerikProgram], control: SinumerikControl) -> None:
        super().__init__()
        self.programs = programs
        self.control = control

    @property
    def local(self) -> dict[str, Value]:
        """Variables of the running program."""
        return self._levels[-1].local

    @property
    def kinds(self) -> dict[str, str]:
        """Types of these variables."""
        return self._levels[-1].kinds

    @property
    def given(self) -> list[bool]:
        return self._levels[-1].given

    def _begin(self, number: int, arguments: dict[str, float]) -> None:
        self.call(f"TP{number}", **arguments)

    # --- what blocks do ------------------------------------------------------------------

    def alarm(self, number: int, text: str) -> None:
        """Stop with an alarm (SETAL): the program is over."""
        self.control.alarm = (number - FIRST_ALARM, text)
        self.reset()

    def call(self, name: str, **arguments: float) -> None:
        """Run a program; a parameter that is not given is 0."""
        program = self.programs.get(name)
        if program is None:
            raise NcError(f"there is no program {name}")
        if len(self._levels) >= DEEPEST_CALL:
            raise NcError(f"more than {DEEPEST_CALL} calls within one another")
        values = {f"_{letter}": float(value) for letter, value in arguments.items()}
        if strange := sorted(set(values) - set(program.parameters)):
            raise NcError(f"{name} takes no argument {strange[0]}")
        self._levels.append(
            _Level(
                program,
                local={each: values.get(each, 0.0) for each in program.parameters},
                kinds=dict.fromkeys(program.parameters, "REAL"),
                given=[each in values for each in program.parameters],
            )
        )

    def end(self) -> None:
        """Go back to the program that called."""
        self._levels.pop()
