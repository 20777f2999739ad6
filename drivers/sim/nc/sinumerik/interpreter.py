"""Runs compiled SINUMERIK programs block by block."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.sim.nc.sinumerik.control import SinumerikControl, SinumerikError
from drivers.sim.nc.sinumerik.expressions import Value
from drivers.sim.nc.sinumerik.program import SinumerikProgram

DEEPEST_CALL = 8
MOST_BLOCKS = 20_000
"""A program that runs so many blocks without a dwell never ends."""
FIRST_ALARM = 65_000
"""Numbers of the user's alarms are counted from here."""


@dataclass(slots=True)
class _Level:
    program: SinumerikProgram
    index: int = 0
    local: dict[str, Value] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    given: list[bool] = field(default_factory=list)


class SinumerikInterpreter:
    """One channel that runs one program at a time, with its sub-programs."""

    def __init__(self, programs: Mapping[str, SinumerikProgram], control: SinumerikControl) -> None:
        self.programs = programs
        self.control = control
        self.dwell_s = 0.0
        """What the latest block waits for [s]."""
        self._levels: list[_Level] = []

    @property
    def running(self) -> bool:
        """A program is under way."""
        return bool(self._levels)

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
        """Which parameters the call has given."""
        return self._levels[-1].given

    def start(self, number: int, **arguments: float) -> None:
        """Begin program TP<number>, with arguments by the letters of its parameters."""
        if self._levels:
            raise SinumerikError(f"{self._levels[0].program.name} is still running")
        self.call(f"TP{number}", **arguments)

    def run(self, number: int, **arguments: float) -> None:
        """Run a program to its end, dwells taking no time."""
        self.start(number, **arguments)
        self.finish()

    def finish(self) -> None:
        """Go on to the end of what runs; raises SinumerikError when it has none."""
        for _ in range(MOST_BLOCKS):
            if not self._levels:
                return
            self.step()
        raise SinumerikError(f"no end after {MOST_BLOCKS} blocks", where=self.where())

    def wait(self) -> float | None:
        """Go on to the next dwell; return its length [s], None at the end of the program."""
        for _ in range(MOST_BLOCKS):
            if not self._levels:
                return None
            self.step()
            if self.dwell_s > 0.0:
                return self.dwell_s
        raise SinumerikError(f"no end after {MOST_BLOCKS} blocks", where=self.where())

    def step(self) -> None:
        """Run one block."""
        level = self._levels[-1]
        index = level.index
        if index >= len(level.program.blocks):
            raise SinumerikError("the program ends without M17", where=level.program.name)
        level.index = index + 1
        self.dwell_s = 0.0
        try:
            target = level.program.blocks[index].action(self)
        except (SinumerikError, OverflowError) as error:
            problem = error.problem if isinstance(error, SinumerikError) else "a number is out of range"
            where = level.program.where(index)
            self.reset()
            raise SinumerikError(problem, where=where) from error
        if target is not None:
            level.index = target

    def reset(self) -> None:
        """Do what the RESET key does: the program ends where it is; static synchronised actions stay."""
        self._levels.clear()
        self.dwell_s = 0.0

    def where(self) -> str:
        """Return the block that comes next, '' when nothing runs."""
        return self._levels[-1].program.where(self._levels[-1].index) if self._levels else ""

    # --- what blocks do ------------------------------------------------------------------

    def alarm(self, number: int, text: str) -> None:
        """Stop with an alarm (SETAL): the program is over."""
        self.control.alarm = (number - FIRST_ALARM, text)
        self.reset()

    def call(self, name: str, **arguments: float) -> None:
        """Run a program; a parameter that is not given is 0."""
        program = self.programs.get(name)
        if program is None:
            raise SinumerikError(f"there is no program {name}")
        if len(self._levels) >= DEEPEST_CALL:
            raise SinumerikError(f"more than {DEEPEST_CALL} calls within one another")
        values = {f"_{letter}": float(value) for letter, value in arguments.items()}
        if strange := sorted(set(values) - set(program.parameters)):
            raise SinumerikError(f"{name} takes no argument {strange[0]}")
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
