"""How much of the project the daemon that runs day and night holds in memory, its drivers included."""

import json
import subprocess
import sys

from config.machines import shipped_file

MODULES, LINES = 180, 29_200
"""What it is; to come down to 150 modules and 20 000 lines."""
COUNT = """
import json, pathlib, sys
import daemon.app, daemon.cli, daemon.cli.operate.run
from config.loader import load_configuration
from drivers.registry import import_drivers
import_drivers(load_configuration(pathlib.Path(sys.argv[1])))
own = ("daemon", "drivers", "models", "config")
files = [m.__file__ for n, m in sys.modules.items() if n.split(".")[0] in own and getattr(m, "__file__", None)]
for library in ("matplotlib", "plotly"):
    assert library not in sys.modules, f"{library} is for reports"
print(json.dumps([len(files), sum(len(pathlib.Path(file).read_text("utf-8").splitlines()) for file in files)]))
"""


def test_the_resident_daemon_stays_small() -> None:
    machine = str(shipped_file("cfrpmt.yaml"))
    done = subprocess.run([sys.executable, "-P", "-c", COUNT, machine], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    modules, lines = json.loads(done.stdout)
    print(f"resident: {modules} modules, {lines} lines")
    assert modules <= MODULES
    assert lines <= LINES


FOREIGN = """
import json, pathlib, sys
from daemon.cli import main
command = main.get_command(None, "run")
from config.loader import load_configuration
from drivers.registry import import_drivers
import_drivers(load_configuration(pathlib.Path(sys.argv[1])))
print(json.dumps([name for name in sys.argv[2:] if sys.modules.get(name)]))
"""


def test_the_command_loads_no_library_that_the_daemon_does_not_use() -> None:
    machine = str(shipped_file("cfrpmt.yaml"))
    unused = ("rich", "scipy", "sklearn", "matplotlib", "plotly", "pyarrow", "daemon.spindle_speed.task")
    command = [sys.executable, "-P", "-c", FOREIGN, machine, *unused]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == []
    with_rich = FOREIGN.replace('"run"', '"monitor"').replace("print(", "import rich.console\nprint(")
    done = subprocess.run([*command[:3], with_rich, machine, "rich"], capture_output=True, text=True, check=False)
    assert json.loads(done.stdout) == ["rich"], "other commands still find it"
