"""Files that ship with the daemon: machine descriptions and what belongs to them."""

from importlib.resources import files
from pathlib import Path


def shipped_file(name: str) -> Path:
    """Return the path of a file that ships in this package, such as `cfrpmt.yaml`; raises FileNotFoundError."""
    path = Path(str(files("config").joinpath(name)))
    if path.name != name or not path.is_file():
        raise FileNotFoundError(f"no file {name!r} ships with Toolpoint; there are {', '.join(shipped_files())}")
    return path


def shipped_files() -> tuple[str, ...]:
    """Return the names of all data files that ship in this package."""
    entries = (entry.name for entry in files("config").iterdir() if entry.is_file())
    return tuple(sorted(name for name in entries if Path(name).suffix in (".yaml", ".json")))


def machine_names() -> tuple[str, ...]:
    return tuple(Path(name).stem for name in shipped_files() if name.endswith(".yaml"))
