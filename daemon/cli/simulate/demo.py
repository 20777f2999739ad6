"""`toolpoint demo`: the simulated machine, the daemon, and a live view of both."""

import contextlib
import math
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click
import yaml

from daemon.cli.common import FAILED, option, refuse, say, write_json
from daemon.cli.options import EXISTING, POSITIVE, FiniteFloat, directory_option, json_option
from daemon.monitor.control_client import DaemonUnreachableError
from daemon.simulation import SimulationError
from daemon.simulation.boxes import put_on
from daemon.simulation.demonstration import Trail, result, settle, switch_on, switch_on_again, watch
from daemon.simulation.processes import (
    RunningSimulation,
    folder_for,
    port_from,
    start_simulation,
    write_simulation_configuration,
)

SENSORS = ("latsis", "modbus", "mqtt")
LIVE_PERIOD_S = 0.25
WEB_PORT = 8080
CNC_WIRES = ("opcua", "focas", "haas", "sinumerik")


@click.command()
@option("--headless", is_flag=True, help="No live view: run for --minutes and end.")
@option(
    "--web-port",
    type=click.IntRange(1, 65535),
    help="Port of the pages on this computer, or the next that is free (default: 8080; headless: no pages).",
)
@option("--minutes", type=POSITIVE, help="Simulated minutes (headless: 60).")
@option("--speed", type=FiniteFloat(min=0, min_open=True, max=600), default=60.0, help="Simulated seconds per second.")
@directory_option
@option("--faults", "faults_path", type=EXISTING, help="Fault script (YAML) for the simulated machine.")
@option(
    "--cnc",
    "driver",
    type=click.Choice(CNC_WIRES),
    default="opcua",
    help="How the daemon reaches the simulated CNC: `focas` as a FANUC over Ethernet, `haas` as a Haas, `sinumerik` "
    "as a Siemens control over OPC UA, with the guard in its language.",
)
@option("--secure", is_flag=True, help="Encrypted and signed OPC UA with a user (Basic256Sha256).")
@option(
    "--sensors",
    type=click.Choice(SENSORS),
    default=SENSORS[0],
    help="What brings the temperatures: serial LATSIS lines, boxes that answer Modbus TCP, or an MQTT broker.",
)
@option(
    "--spindle-speed/--no-spindle-speed",
    default=None,
    help="Let the spindle speed follow the stability pockets too (default: with the live view).",
)
@json_option
def demo(
    headless: bool,
    web_port: int | None,
    minutes: float | None,
    speed: float,
    directory: Path | None,
    faults_path: Path | None,
    driver: str,
    secure: bool,
    sensors: str,
    spindle_speed: bool | None,
    json_path: str | None,
) -> None:
    """Watch a simulated machine tool warm up while the daemon compensates it.

    Exit status 0 when the run met its own checks, 1 when it did not, 2 for bad usage.
    """
    from config.loader import load_configuration

    duration_s = math.inf if minutes is None and not headless else (minutes or 60.0) * 60.0
    if faults_path is not None:
        if sensors != SENSORS[0]:
            refuse(f"a fault script plays on LATSIS lines; leave --sensors {sensors} or --faults out")
        _check_faults(faults_path)
    with simulation_folder(directory) as folder:
        port = None if headless and web_port is None else port_from(web_port or WEB_PORT)
        if port is not None:
            say(f"open {page_address(port)} in a browser: the machine, its error, the delay and the reason")
        machine = demo_machine()
        record = folder / "commissioning.json"  # its own: a commissioning tried on it may disprove it
        record.write_bytes(Path(machine["compensation"]["commissioning_file"]).read_bytes())
        machine["compensation"]["commissioning_file"] = str(record)
        for line in machine["temperatures"]["lines"]:
            line["profile"] = "checked"  # the simulated nodes can send a checksum, which the published ones could not
        if sensors != SENSORS[0]:
            put_on(sensors, machine)
        if spindle_speed or (spindle_speed is None and not headless):
            tune_spindle_speed(machine)
        path, _ = write_simulation_configuration(
            machine, folder, speed=speed, http_port=port, secure=secure, driver=driver
        )
        arguments = [] if math.isinf(duration_s) else ["--until-s", repr(duration_s)]
        if faults_path is not None:
            arguments += ["--faults", str(faults_path.resolve())]
        with start_simulation(arguments, path, speed=speed, epoch_utc_s=time.time(), directory=folder) as running:
            switch_on(running)
            trail = Trail()
            if headless:
                watch(running, duration_s, lambda status: None, 1.0)
            else:
                seen = _show(running, duration_s, trail)
                if running.time_s < duration_s:  # a person has ended it
                    say_result(trail, seen, port)
                    return
            final, status = settle(running)
            trail.take(running.reports)
            period_s = min(each.cycle_period_s for each in load_configuration(path).temperatures.inputs)
    numbers, failures = result(final, status, speed, period_s)
    write_json(json_path, numbers)
    if json_path is None:
        say_result(trail, status, port)
    for failure in failures:
        say(failure)
    sys.exit(1 if failures else 0)


def demo_machine() -> dict[str, Any]:
    """Return the published machine's description with the simulated machine's model and commissioning record."""
    from config.machines import shipped_file

    content = yaml.safe_load(shipped_file("cfrpmt.yaml").read_text(encoding="utf-8"))
    assert isinstance(content, dict)
    content["machine"] = "simulated CFRP machine tool"
    content["compensation"]["reference"] = {"sequence_numbers": [100]}
    content["compensation"].setdefault("output", {})["safe_sequence_numbers"] = [900]
    content["compensation"]["model_file"] = str(shipped_file("simulated_machine_model.json"))
    content["compensation"]["commissioning_file"] = str(shipped_file("simulated_machine_commissioning.json"))
    return content


def tune_spindle_speed(content: dict[str, Any]) -> None:
    """Let the spindle speed of the simulated machine's tool 1 follow the stability pockets."""
    from config.machine.spindle import spindle_folder
    from config.machines import shipped_file

    data = spindle_folder().parent
    tuning = yaml.safe_load((data / "simulated_machine_spindle_speed.yaml").read_text(encoding="utf-8"))
    tuning["thermomechanical_model"] = str(shipped_file("simulated_machine_bearings.json"))
    for operation in tuning["operations"]:
        operation["case"] = str(data / "simulated_machine_cut.yaml")
    content["cnc"]["macros"]["writable"].append(str(tuning["macros"]["valid_until"]))
    content["spindle_speed"] = tuning


def _check_faults(path: Path) -> None:
    """Refuse a fault script that the demo's machine cannot play, before anything starts."""
    from config.loader import load_configuration
    from config.machines import shipped_file
    from daemon.simulation.simulation import read_faults

    read_faults(path, load_configuration(shipped_file("cfrpmt.yaml")))


def page_address(port: int | None) -> str:
    return f"http://127.0.0.1:{port}/"


def _show(running: RunningSimulation, until_s: float, trail: Trail) -> dict[str, Any]:
    """Show both until the time is over or a person ends it; return the status that was seen last."""
    from rich.console import Console
    from rich.live import Live

    from daemon.monitor.view import status_view, truth_panel

    seen, again = running.client.ask("status"), 0
    port = running.configuration.service.http_port
    with Live(console=Console(), screen=True, auto_refresh=False) as live:

        def look(status: dict[str, Any]) -> None:
            nonlocal seen, again
            seen = status
            again += switch_on_again(running, status)
            held = f" · held too long and switched on again: {again} times" if again else ""
            report = trail.take(running.reports)
            beside = [truth_panel(report, trail.axes)] if report and "truth" in report else []
            footer = f"in a browser: {page_address(port)} · Ctrl-C ends{held}"
            live.update(status_view(status, beside, footer, live=True), refresh=True)

        with contextlib.suppress(KeyboardInterrupt):
            watch(running, until_s, look, LIVE_PERIOD_S)
    return seen


def say_result(trail: Trail, status: dict[str, Any], port: int | None) -> None:
    """Say what was seen, for when the live view has gone from the screen, or there was none."""
    from daemon.monitor.view import speed_in_words

    minutes, writes, feedback = trail.time_s / 60.0, status["writes"], status["latency_s"]["feedback"]
    say(f"seen until {minutes:.0f} min of the machine's time; the output is {status['output']['state']}")
    for axis, (without, compensated) in trail.largest_um().items():
        say(f"axis {axis}: error up to {without:.1f} um without compensation, up to {compensated:.1f} um with it")
    if speed := status["spindle_speed"]:
        say(f"spindle speed {speed_in_words(speed)}")
    delay = "" if feedback["mean"] is None else f"; feedback {feedback['mean'] * 1e3:.0f} ms in the mean"
    say(f"{writes['verified']} of {writes['sent']} writes read back and equal{delay}")
    if port is not None:
        say(f"the pages were at {page_address(port)}; `toolpoint demo` shows them again")


LOGS = ("daemon.log", "simulator.log")
LAST_LINES = 5
"""Of each log this many lines are shown when its folder is removed."""


@contextmanager
def simulation_folder(directory: Path | None) -> Iterator[Path]:
    """Yield the folder of a run; end with sentences when it cannot be used or the run breaks off."""
    with ExitStack() as stack:
        folder = stack.enter_context(folder_for(directory))
        try:
            yield folder
        except (SimulationError, DaemonUnreachableError) as error:
            if directory is None:
                say("\n".join([str(error), *last_lines(folder)]))
            else:
                say(f"{error}; logs are in {folder}")
            sys.exit(FAILED)


def last_lines(folder: Path) -> Iterator[str]:
    """Yield the end of each log in the folder, under its name."""
    for name in LOGS:
        path = folder / name
        if path.exists() and (lines := path.read_text(encoding="utf-8", errors="replace").splitlines()):
            yield f"the end of {name}:"
            yield from (f"  {line}" for line in lines[-LAST_LINES:])
