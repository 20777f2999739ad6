"""What happens to the calendar: it is set by hours and days, and summer time begins and ends."""

import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from account import Row
from process_rows import more
from rig import PATIENCE_S, Rig, at_work

HOUR_S = 3600.0
STEPS_S = (HOUR_S, -HOUR_S, 86400.0, -86400.0, 30 * 86400.0, -30 * 86400.0, -HOUR_S / 2, HOUR_S / 2)
SUMMER_TIME = ((2027, 3, 28, 1), (2027, 10, 31, 1))
"""When summer time begins and ends in central Europe [UTC]."""
LEAD_S = 5.0


def real_time(content: dict[str, Any]) -> None:
    """Let the lines be as fast in real time."""
    at_work(content)
    for line in content["temperatures"]["lines"]:
        line["cycle_period_s"] = 1.0
    content["compensation"]["reference"]["mean_s"] = 6.0


def steppable(rig: Rig, first_s: float) -> None:
    """Start the daemon anew on the computer's own clock, in a process whose calendar can be set."""
    if rig.running.daemon.poll() is None:
        rig.kill()
    at = rig.arguments.index("run")
    rest = rig.arguments[at:]
    if "--simulated-clock" in rest:
        k = rest.index("--simulated-clock")
        del rest[k : k + 2]
    program = Path(__file__).with_name("stepped_clock.py")
    rig.arguments = [sys.executable, "-P", str(program), repr(first_s), *rest]
    rig.spawn()
    rig.connect()


def steps(rig: Rig, row: Row, steps_s: Sequence[float]) -> None:
    """Set the calendar of the daemon's computer by each of these."""
    steppable(rig, 0.0)
    rig.ensure_following()
    for step_s in steps_s:
        offset, after = rig.log_path.stat().st_size, rig.last_write()
        row.runs += 1
        said = rig.status()["history"]["acknowledged"]
        _step(rig, step_s)
        stepped_s = time.monotonic()
        rig.wait("cycles", lambda status, said=said: more(status["history"]["acknowledged"], said), PATIENCE_S)
        status = rig.back(row, stepped_s)
        row.check("the output goes on following", status["output"]["state"] == "ACTIVE", (step_s, status["output"]))
        rig.check_log(row, offset)
        rig.check_writes(row, after, unverified=1, slew=False)
        rig.check_store(row, rig.status()["history"]["acknowledged"])


def _step(rig: Rig, step_s: float) -> None:
    stdin = rig.running.daemon.stdin
    assert stdin is not None
    stdin.write(f"{step_s!r}\n".encode())
    stdin.flush()


def summer_time(rig: Rig, row: Row) -> None:
    """Run through the hours at which local time jumps, where the daemon's time zone has them."""
    rig.environment = {"TZ": "Europe/Berlin"}
    for year, month, day, hour in SUMMER_TIME:
        jump_utc_s = datetime(year, month, day, hour, tzinfo=UTC).timestamp()
        offset = rig.log_path.stat().st_size
        row.runs += 1
        steppable(rig, jump_utc_s - LEAD_S - time.time())
        rig.ensure_following()
        _step(rig, jump_utc_s - LEAD_S - rig.status()["time_utc_s"])
        after = rig.last_write()
        status = rig.wait("the jump", lambda status, at=jump_utc_s: status["time_utc_s"] > at, PATIENCE_S)
        said = status["history"]["acknowledged"]
        jumped_s = time.monotonic()
        rig.wait("cycles", lambda status, said=said: more(status["history"]["acknowledged"], said), PATIENCE_S)
        status = rig.back(row, jumped_s)
        row.check("the output goes on following", status["output"]["state"] == "ACTIVE", status["output"])
        rig.check_log(row, offset)
        rig.check_writes(row, after, unverified=1, slew=False)
        rig.check_store(row, rig.status()["history"]["acknowledged"])
    rig.environment = {}
