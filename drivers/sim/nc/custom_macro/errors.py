"""What the interpreter refuses."""


class MacroError(Exception):
    """A statement that the interpreter does not know, or that a control would refuse; names program and line."""

    def __init__(self, problem: str, *, where: str = "") -> None:
        self.problem = problem
        self.where = where
        super().__init__(f"{where}: {problem}" if where else problem)
