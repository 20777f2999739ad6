"""How much of the project the daemon that runs day and night holds in memory, its drivers included."""

import json
import subprocess
import sys

from config.machines import shipped_file

MODULES, LINES = 178, 28_300
"""What it is; to come down to 150 modules and 20 000 lines."""
COUNT = """
import json, pathlib, sys
from daemon.cli import main
command = main.get_command(None, "run")
import daemon.app, daemon.cli.operate.run
from config.loader import load_configuration
from drivers.registry import import_drivers
import_drivers(load_configuration(pathlib.Path(sys.argv[1])))
own = ("daemon", "drivers", "models", "config")
files = [m.__file__ for n, m in sys.modules.items() if n.split(".")[0] in own and getattr(m, "__file__", None)]
foreign = [name for name in sys.argv[2:] if sys.modules.get(name)]
print(json.dumps([len(files), sum(len(pathlib.Path(file).read_text("utf-8").splitlines()) for file in files), foreign]))
"""
UNUSED = ("rich", "scipy", "sklearn", "matplotlib", "plotly", "pyarrow", "daemon.spindle_speed.task")


def loaded(program: str, *names: str) -> tuple[int, int, list[str]]:
    """Return modules, lines and which of some libraries are there."""
    machine = str(shipped_file("cfrpmt.yaml"))
    done = subprocess.run(
        [sys.executable, "-P", "-c", program, machine, *names], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    modules, lines, foreign = json.loads(done.stdout)
    return modules, lines, foreign


def test_the_resident_daemon_stays_small_and_loads_no_library_that_it_does_not_use() -> None:
    modules, lines, foreign = loaded(COUNT, *UNUSED)
    print(f"resident: {modules} modules, {lines} lines")
    assert foreign == []
    assert modules <= MODULES
    assert lines <= LINES


def test_other_commands_still_find_the_library_of_the_terminal() -> None:
    program = COUNT.replace('"run"', '"monitor"').replace("own =", "import rich.console\nown =")
    assert loaded(program, "rich")[2] == ["rich"]
