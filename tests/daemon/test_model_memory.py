"""What a large model adds to the process that loads it."""

import json
import subprocess
import sys
from pathlib import Path

from large_model import large_model

SENSORS = 302
MOST_MIB = 15.0

LOAD = """
import json, resource, sys
import numpy as np
from pathlib import Path
import daemon.app
from daemon.estimation.model_in_use import ModelInUse
from daemon.model_release.loading import read_model
from models.thermal.estimation import Machine

def resident_mib():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20

ids = tuple(range(1, int(sys.argv[2]) + 1))
ones = np.ones((600, 600))
ones @ ones, np.linalg.inv(np.eye(100))  # what linear algebra takes once, whatever it works on
before = resident_mib()
model, why = read_model(Path(sys.argv[1]), ids, ("z",))
assert model is not None, why
in_use = ModelInUse(model, ids, Machine(components=dict.fromkeys(ids, "machine")), lambda *_: ())
print(json.dumps(resident_mib() - before))
"""


def test_a_model_of_hundreds_of_sensors_adds_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    path.write_text(large_model(SENSORS).to_json(), encoding="utf-8")
    command = [sys.executable, "-P", "-c", LOAD, str(path), str(SENSORS)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) < MOST_MIB
