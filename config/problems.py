"""What is wrong with a configuration file, and where."""

from collections.abc import Iterable
from dataclasses import dataclass

from models.errors import RefusedInputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One thing that is wrong in a file. Lines and columns count from 1; 0 stands for the file as a whole."""

    file: str
    line: int
    column: int
    key: str
    """Path of the key, such as `cnc.macros.values.y`; empty for the file as a whole."""
    sentence: str
    """What was refused, why, and what the person can do."""

    def __str__(self) -> str:
        """Return `file:line:column: key.path: sentence`, without what is not known."""
        place = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return f"{place}: {self.key}: {self.sentence}" if self.key else f"{place}: {self.sentence}"


class ConfigurationError(RefusedInputError):
    """A configuration file is refused; `problems` holds everything that is wrong, sorted by position."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(sorted(problems, key=lambda problem: (problem.line, problem.column, problem.key)))
        super().__init__("\n".join(str(problem) for problem in self.problems))
