"""`toolpoint sink`: send the history to other systems, and say how far each of them is."""

import signal
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from config.schema import Configuration
from daemon.cli.command_group import Group
from daemon.cli.common import FAILED, config_option, read_configuration, refuse, write_json
from daemon.cli.options import json_option
from daemon.ending import set_by_signals
from daemon.history.database import HistoryError
from daemon.sinks.running import run_sinks, sink_status
from daemon.telemetry.logs import configure_logging
from daemon.telemetry.sd_notify import ServiceManager


@click.group(cls=Group)
def sink() -> None:
    """Send the history to other systems; say how far each of them is."""


@sink.command()
@config_option
def run(config_path: Path) -> None:
    """Send what the history holds to every sink until SIGTERM or Ctrl-C, beside the daemon or without it.

    Exit status 1 when another process does so already, or the store's folder cannot be written.
    """
    configuration = _with_sinks(config_path)
    configure_logging(configuration.service.log_level)
    stop = set_by_signals(signal.SIGTERM, signal.SIGINT)
    manager = ServiceManager()
    manager.ready("sending")
    try:
        run_sinks(configuration, stop, manager.watchdog)
    except HistoryError as error:
        refuse(str(error), FAILED)  # that passes, so the service manager starts this again


@sink.command()
@config_option
@json_option
def status(config_path: Path, json_path: str | None) -> None:
    """Say what each sink has taken, what waits for it, and what keeps it from taking more.

    Exit status 1 when one of them does not run or cannot send.
    """
    configuration = _with_sinks(config_path)
    found = sink_status(configuration, time.time())
    write_json(json_path, {"sinks": found})
    if json_path is None:
        for each in found:
            click.echo(in_words(each, configuration.history.keep_for_sinks_days))
    if any(each["problem"] or not each["running"] for each in found):
        sys.exit(FAILED)


def in_words(status: dict[str, Any], keep_days: float) -> str:
    """Return one sink in some lines."""
    rows, running = status["rows"], "runs" if status["running"] else "does not run: start `toolpoint sink run`"
    counted = f"rows, of which {rows['stored']} were new" if status["counted"] == "rows" else status["counted"]
    lines = [
        f"{status['name']} ({status['driver']}, {status['place']}): {running}",
        f"  sent {rows['sent']} {counted}; last acknowledged {_iso(status)}",
    ]
    if waiting := rows["waiting"]:
        counts = ", ".join(f"{count} {name}" for name, count in waiting.items())
        lines.append(f"  waiting: {counts}, the oldest of {_iso(status, 'oldest_waiting_utc_s')}")
        lines.append(f"  what waits is kept {keep_days:g} days longer than history.keep_..._days say")
    if exposed := status["exposed"]:
        lines.append(f"  {exposed}")
    if problem := status["problem"]:
        lines.append(f"  {problem}")
    return "\n".join(lines)


def _iso(status: dict[str, Any], key: str = "acknowledged_utc_s") -> str:
    utc_s = status[key]
    return "never" if utc_s is None else datetime.fromtimestamp(utc_s, UTC).isoformat(timespec="seconds")


def _with_sinks(config_path: Path) -> Configuration:
    configuration = read_configuration(config_path)
    if not configuration.sinks:
        refuse(f"{config_path}: there is no section `sinks`; docs/how-to/send-history-to-a-plant.md shows one")
    return configuration
