"""Finds and builds spindle files."""

from pathlib import Path

from config.machine.spindle import Rotary, load_spindle, shipped_spindles, spindle_folder
from config.machine.spindle_chain import Spindle, build_spindle
from config.problems import ConfigurationError, Problem


def found_file(given: Path) -> Path:
    """Return the file that is meant: a path, or the name of a spindle that ships with Toolpoint."""
    if given.exists():
        return given
    shipped = spindle_folder() / f"{given.name}.yaml"
    if given.parent == Path() and shipped.is_file():
        return shipped
    sentence = f"there is no such file; spindles that ship are {', '.join(shipped_spindles())}"
    raise ConfigurationError([Problem(file=str(given), line=1, column=1, key="", sentence=sentence)])


def read_spindle(given: Path, rotary: Rotary | None = None) -> Spindle:
    """Return the spindle of a file or of a shipped name.

    Raises
    ------
    ConfigurationError
        With everything that is wrong, each with file, line, column and key.

    """
    path = found_file(given)
    return build_spindle(load_spindle(path), path, rotary)
