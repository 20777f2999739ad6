"""Each hardship a few times on real wires; `make hardships` plays them at length."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.wires, pytest.mark.slow]
RUN = Path(__file__).parents[1] / "hardships/run.py"
SEED = "1"
"""A verdict on a change is to be one that can be had again; `make hardships` draws new moments every time."""
OF_PROCESS = ("descriptors", "stopped", "swapped")
OF_STORE = ("power cut, unsynced", "damaged", "switched off", "read-only")
OF_CALENDAR = ("calendar",)
"""The others have tests of their own: kills, a second daemon, a CNC that is silent, a full disk, half-sent requests, a
line that brings too much, a busy computer."""


@pytest.mark.parametrize(
    "parts",
    [OF_STORE, OF_PROCESS, OF_CALENDAR],
    ids=["store", "process", "calendar"],
)
def test_nothing_acknowledged_is_lost_and_what_must_hold_holds(parts: tuple[str, ...]) -> None:
    only = [word for part in parts for word in ("--only", part)]
    done = subprocess.run(
        [sys.executable, "-P", str(RUN), "--quick", "--seed", SEED, "--json", "-", *only],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout, done.stderr
    rows: dict[str, dict[str, Any]] = json.loads(done.stdout)["rows"]
    assert all(any(part in name for name in rows) for part in parts), sorted(rows)
    assert not {name: row["violations"] for name, row in rows.items() if row["violations"]}, done.stderr
    assert done.returncode == 0, done.stderr
    for name, row in rows.items():
        assert row["skipped"] or (row["runs"] > 0 and sum(row["checks"].values()) > 0), name
        assert row["lost"] == 0


def test_a_violation_ends_with_status_one_and_is_named() -> None:
    """As on a machine, which is not asked: the row is violated whatever it is."""
    program = (
        "import contextlib, sys; sys.argv = ['run.py', '--quick', '--only', 'two daemons'];"
        f"sys.path[:0] = [{str(RUN.parent)!r}, {str(RUN.parents[1] / 'support')!r}];"
        "import process_rows;"
        "process_rows.second_daemon = lambda rig, row, count: row.check('this holds', False);"
        "import run; run.machine = lambda own_clock: contextlib.nullcontext();"
        "sys.exit(run.main())"
    )
    here = {**os.environ, "TOOLPOINT_HARDSHIPS_OWN_MOUNTS": "1"}  # a new process would not know the program above
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, env=here)
    assert done.returncode == 1
    assert "not so: this holds" in done.stderr
