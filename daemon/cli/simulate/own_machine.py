"""What `toolpoint simulate` does without a clock: a configuration, the simulated machine and the daemon together."""

import math
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from daemon.cli.common import refuse, say, write_json
from daemon.cli.simulate.demo import page_address, simulation_folder
from daemon.simulation.demonstration import result, settle, switch_on, watch
from daemon.simulation.own_machine import prepare
from daemon.simulation.processes import port_from, start_simulation
from models.errors import RefusedInputError

LOOK_S = 1.0
WEB_PORT = 8080
NOT_ENABLED = ("nothing was written", "was switched on", ": None um applied")
"""What a run shows in which nobody switched anything on; the last of a control that gives no macro variables."""
NOT_LESS = " um left of "
"""And where nobody did while it ran, either."""


def beyond_waiting(failures: Sequence[str], *, written: bool) -> list[str]:
    """Return the failures that a run has beside those of waiting to be switched on; `written`: somebody did."""
    expected = NOT_ENABLED if written else (*NOT_ENABLED, NOT_LESS)
    return [failure for failure in failures if not any(words in failure for words in expected)]


def simulate_own(
    config_path: Path,
    directory: Path | None,
    *,
    minutes: float | None,
    speed: float,
    enable: bool,
    json_path: str | None,
) -> None:
    """Run until the time is over or Ctrl-C; end with 1 when the run did not meet its own checks."""
    duration_s = math.inf if minutes is None else minutes * 60.0
    with simulation_folder(directory) as folder:
        port = None if minutes is not None else port_from(WEB_PORT)
        try:
            path = prepare(config_path, folder, speed=speed, http_port=port, say=say)
        except RefusedInputError as error:
            refuse(str(error))
        arguments = [] if math.isinf(duration_s) else ["--until-s", repr(duration_s)]
        with start_simulation(arguments, path, speed=speed, epoch_utc_s=time.time(), directory=folder) as running:
            say(f"the daemon runs on {path}: `toolpoint status --config {path}`")
            if enable:
                switch_on(running)
            else:
                say(f"nothing is written until you say `toolpoint enable --config {path}`")
            if port is not None:
                say(f"watch it at {page_address(port)}; Ctrl-C ends")
            with suppress(KeyboardInterrupt):
                watch(running, duration_s, lambda status: None, LOOK_S)
            if running.time_s < duration_s:  # a person has ended it
                return
            final, status = settle(running)
            period_s = min(each.cycle_period_s for each in running.configuration.temperatures.inputs)
    numbers, failures = result(final, status, speed, period_s)
    write_json(json_path, numbers)
    if not enable:
        failures = beyond_waiting(failures, written=numbers["writes"]["sent"] > 0)
    for failure in failures:
        say(failure)
    sys.exit(1 if failures else 0)
