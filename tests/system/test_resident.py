"""How much of the project the daemon that runs day and night holds in memory."""

import json
import subprocess
import sys

MODULES, LINES = 206, 27_300
"""The limits; to come down to 150 modules and 20 000 lines."""
COUNT = """
import json, pathlib, sys
import daemon.app, daemon.cli, daemon.cli.operate.run
own = ("daemon", "drivers", "models", "config")
files = [m.__file__ for n, m in sys.modules.items() if n.split(".")[0] in own and getattr(m, "__file__", None)]
print(json.dumps([len(files), sum(len(pathlib.Path(file).read_text("utf-8").splitlines()) for file in files)]))
"""


def test_the_resident_daemon_stays_small() -> None:
    done = subprocess.run([sys.executable, "-P", "-c", COUNT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    modules, lines = json.loads(done.stdout)
    print(f"resident: {modules} modules, {lines} lines")
    assert modules <= MODULES
    assert lines <= LINES
