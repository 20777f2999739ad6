"""What `toolpoint simulate` does without a clock: a configuration, the simulated machine and the daemon together."""

import math
import sys
import time
from contextlib import suppress
from pathlib import Path

from daemon.cli.common import refuse, say, write_json
from daemon.cli.simulate.demo import page_address, say_result, simulation_folder
from daemon.simulation.demonstration import Trail, result, settle, switch_on, watch
from daemon.simulation.own_machine import prepare
from daemon.simulation.processes import port_from, start_simulation
from models.errors import RefusedInputError

LOOK_S = 1.0
WEB_PORT = 8080


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
            trail = Trail()
            trail.take(running.reports)
            period_s = min(each.cycle_period_s for each in running.configuration.temperatures.inputs)
    numbers, failures = result(final, status, speed, period_s, enabled=enable)
    write_json(json_path, numbers)
    if json_path is None:
        say_result(trail, status, None)
    if not enable and not numbers["writes"]["sent"]:
        say("nobody switched the output on, so it is not judged how much of the error is left; --enable switches it on")
    for failure in failures:
        say(failure)
    sys.exit(1 if failures else 0)
