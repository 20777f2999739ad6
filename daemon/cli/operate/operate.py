"""Commands to a running daemon: status, monitor, reference, enable, disable, acknowledge."""

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FAILED, FILE, config_option, option, read_configuration, refuse, say, write_json
from daemon.cli.options import json_option
from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.monitor.control_socket import RequestError

socket_option = option("--socket", "socket_path", type=FILE, help="Socket of the daemon (else the configuration's).")
speed_option = option(
    "--spindle-speed", is_flag=True, help="Not the compensation: the tuning of the spindle speed, and nothing else."
)

SILENT_S = 4.0
"""When the daemon is silent for so long, what it said before is old; the pages take as long."""
ASKED_AGAIN = "The daemon is asked again until it answers. Ctrl-C ends."


@contextmanager
def daemon_at(config_path: Path, socket_path: Path | None) -> Iterator[ControlClient]:
    """Connect to the daemon; end with a sentence when it refuses or does not answer."""
    path = socket_path or read_configuration(config_path).service.socket
    try:
        client = ControlClient(path)
        try:
            yield client
        finally:
            client.close()
    except (DaemonUnreachableError, RequestError) as error:
        refuse(str(error), FAILED)


def _tell(outcome: Mapping[str, Any]) -> None:
    """Print what became of a request."""
    if not outcome.get("decided"):
        click.echo("taken, but not decided yet: `toolpoint status` shows what becomes of it")
        return
    click.echo(f"{outcome['state']}: {outcome['reason']}")
    if outcome["alarm"]:
        say(outcome["alarm"])


@click.command()
@config_option
@socket_option
@json_option
def status(config_path: Path, socket_path: Path | None, json_path: str | None) -> None:
    """Say whether compensation is on, what it does, and why not."""
    with daemon_at(config_path, socket_path) as client:
        picture = client.ask("status")
    if json_path is not None:
        write_json(json_path, picture)
        return
    from rich.console import Console

    from daemon.monitor.view import status_view

    Console().print(status_view(picture))


@click.command()
@config_option
@socket_option
def monitor(config_path: Path, socket_path: Path | None) -> None:
    """Watch the daemon live in the terminal, until Ctrl-C."""
    import time

    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from daemon.monitor.view import status_view

    console = Console()
    if not console.is_terminal or console.is_dumb_terminal:
        refuse("`toolpoint monitor` draws on a terminal, and this is none; `toolpoint status` prints the same once")
    path = socket_path or read_configuration(config_path).service.socket
    with daemon_at(config_path, path) as client:
        first = status_view(client.ask("status"), live=True)
    with suppress(KeyboardInterrupt), Live(first, console=console, screen=True) as live:
        while True:
            try:
                with closing(ControlClient(path, SILENT_S)) as client:
                    while True:
                        live.update(status_view(client.ask("status"), live=True))
                        time.sleep(0.5)
            except (
                DaemonUnreachableError,
                RequestError,
            ) as error:  # it is started anew, or hangs; what it said before is old
                live.update(Text.assemble((" NO ANSWER ", "bold white on red3"), f"  {error}\n\n{ASKED_AGAIN}"))
                time.sleep(1.0)


@click.command()
@config_option
@socket_option
def reference(config_path: Path, socket_path: Path | None) -> None:
    """Set the reference by hand: the thermal error is zero now, by definition. The output does not move."""
    with daemon_at(config_path, socket_path) as client:
        outcome = client.ask("reference")
    _tell(outcome)


@click.command()
@config_option
@socket_option
@speed_option
@click.argument("axes", nargs=-1)
def enable(config_path: Path, socket_path: Path | None, spindle_speed: bool, axes: tuple[str, ...]) -> None:
    """Switch compensation on, for AXES or for every axis that has a model; or the tuning of the spindle speed."""
    if spindle_speed and axes:
        raise click.UsageError("--spindle-speed switches the tuning of the speed alone; name no axes with it")
    with daemon_at(config_path, socket_path) as client:
        outcome = client.ask("enable", axes=list(axes) or None, spindle_speed=spindle_speed)
    _tell(outcome)


@click.command()
@config_option
@socket_option
@option("--zero", is_flag=True, help="Disable every axis and retreat to zero, not to the reference's baseline.")
@speed_option
@click.argument("axes", nargs=-1)
def disable(
    config_path: Path, socket_path: Path | None, zero: bool, spindle_speed: bool, axes: tuple[str, ...]
) -> None:
    """Switch compensation off, for AXES or for all; what is applied retreats at the slew rate.

    With --spindle-speed the tuning of the spindle speed instead: the next call of its NC program runs as programmed.
    """
    if spindle_speed and (axes or zero):
        raise click.UsageError("--spindle-speed switches the tuning of the speed alone; name neither axes nor --zero")
    if zero and axes:
        raise click.UsageError("--zero retreats every axis; name no axes with it")
    with daemon_at(config_path, socket_path) as client:
        outcome = client.ask("disable", axes=list(axes) or None, zero=zero, spindle_speed=spindle_speed)
    _tell(outcome)


@click.command()
@config_option
@socket_option
@click.argument("fault", type=click.IntRange(min=1), required=False)
def acknowledge(config_path: Path, socket_path: Path | None, fault: int | None) -> None:
    """Clear a latched FAULT after its cause is gone; the output then holds what the CNC applies.

    FAULT is its number, `output.fault` of `toolpoint status --json -`; left out, the FAULT is shown and you are asked.
    One that came after it is not cleared.
    """
    with daemon_at(config_path, socket_path) as client:
        if fault is None:
            output = client.ask("status")["output"]
            fault = output.get("fault")  # one of an earlier version, until it is restarted, knows no numbers
            click.echo(f"{output['state']}: {output['reason']}")
            if output["state"] != "FAULT":
                if output.get("since_s", 0.0) is None:  # what was restored or kept is in force from the first poll on
                    refuse("the CNC has not been reached yet: nothing can be acknowledged before", FAILED)
                return
            click.confirm(
                f"Acknowledge {'it' if fault is None else f'FAULT {fault}'}, because this is gone?", abort=True
            )
        outcome = client.ask("acknowledge", **({} if fault is None else {"fault": fault}))
    _tell(outcome)
