"""What the interpreters of the simulated control share: one program at a time, with sub-programs, block by block."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar

MOST_BLOCKS = 20_000
"""A program that runs so many blocks without a dwell never ends."""


class NcError(Exception):
    """A statement that an interpreter does not know, or that a control would refuse; names program and line."""

    def __init__(self, problem: str, *, where: str = "") -> None:
        self.problem = problem
        self.where = where
        super().__init__(f"{where}: {problem}" if where else problem)


class Block(Protocol):
    @property
    def action(self) -> Callable[[Any], int | None]:
        """What it does with its interpreter; returns the index of the block to go on with, None for the next."""


class Program(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def blocks(self) -> Sequence[Block]: ...

    def where(self, index: int) -> str:
        """Return program, line and text of a block."""


class Level(Protocol):
    """One program that is under way, and its next block."""

    @property
    def program(self) -> Program: ...

    index: int


L = TypeVar("L", bound=Level)


class BlockInterpreter(ABC, Generic[L]):
    """One control that runs one program at a time, with its sub-programs."""

    end_word: str
    """Ends a program."""

    def __init__(self) -> None:
        self.dwell_s = 0.0
        """What the latest block waits for [s]."""
        self._levels: list[L] = []

    @property
    def running(self) -> bool:
        return bool(self._levels)

    @abstractmethod
    def _begin(self, number: int, arguments: dict[str, float]) -> None:
        """Call the program of a number."""

    def start(self, number: int, **arguments: float) -> None:
        """Begin a program, with arguments by letter; raises NcError while another one runs."""
        if self._levels:
            raise NcError(f"{self._levels[0].program.name} is still running")
        self._begin(number, arguments)

    def run(self, number: int, **arguments: float) -> None:
        """Run a program to its end, dwells taking no time."""
        self.start(number, **arguments)
        self.finish()

    def finish(self) -> None:
        """Go on to the end of what runs, dwells taking no time; raises NcError when it has none."""
        self._go_on(to_dwell=False)

    def wait(self) -> float | None:
        """Go on to the next dwell; return its length [s], None at the end of the program."""
        return self._go_on(to_dwell=True)

    def _go_on(self, *, to_dwell: bool) -> float | None:
        for _ in range(MOST_BLOCKS):
            if not self._levels:
                return None
            self.step()
            if to_dwell and self.dwell_s > 0.0:
                return self.dwell_s
        raise NcError(f"no end after {MOST_BLOCKS} blocks", where=self.where())

    def step(self) -> None:
        level = self._levels[-1]
        index = level.index
        if index >= len(level.program.blocks):
            raise NcError(f"the program ends without {self.end_word}", where=level.program.name)
        level.index = index + 1
        self.dwell_s = 0.0
        try:
            target = level.program.blocks[index].action(self)
        except (NcError, OverflowError) as error:
            problem = error.problem if isinstance(error, NcError) else "a number is out of range"
            self.reset()
            raise NcError(problem, where=level.program.where(index)) from error
        if target is not None:
            level.index = target

    def reset(self) -> None:
        """Do what the RESET key does: the program ends where it is."""
        self._levels.clear()
        self.dwell_s = 0.0

    def where(self) -> str:
        """Return the block that comes next, '' when nothing runs."""
        if not self._levels:
            return ""
        program, index = self._levels[-1].program, self._levels[-1].index
        return program.where(min(index, len(program.blocks) - 1))
