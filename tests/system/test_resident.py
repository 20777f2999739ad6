"""How much of the project the daemon that runs day and night holds in memory, its drivers included."""

import json
import subprocess
import sys

from config.machines import shipped_file

MODULES, LINES = 186, 25_526
"""A little above what it is; to come down to 150 modules and 20 000 lines."""
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
