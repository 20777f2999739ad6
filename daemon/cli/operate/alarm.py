"""`toolpoint alarm`: try whether alarms reach people."""

from pathlib import Path
from typing import Any

import click

from config.schema.sinks import SinkConfig
from daemon.cli.command_group import Group
from daemon.cli.common import config_option, option, read_configuration, refuse, write_json
from daemon.cli.options import json_option


@click.group(cls=Group)
def alarm() -> None:
    """Try whether alarms reach people."""


@alarm.command("test")
@config_option
@option("--sink", "name", help="Only the sink of this name. Without: every one that takes alarms.")
@json_option
def send_test(config_path: Path, name: str | None, json_path: str | None) -> None:
    """Send a test message by every webhook and mail server of the section `sinks`; 1 when one does not take it."""
    configuration = read_configuration(config_path)
    sinks = [each for each in configuration.sinks or () if each.alarms is not None]
    if not sinks:
        refuse(f"{config_path}: no sink has the driver webhook or mail; docs/how-to/send-alarms.md shows one")
    chosen = [each for each in sinks if name in (None, each.name)]
    if not chosen:
        refuse(
            f"{config_path}: no sink that takes alarms is called {name}; there are {', '.join(s.name for s in sinks)}"
        )
    found = [_tried(each, configuration.machine) for each in chosen]
    write_json(json_path, {"alarms": found})
    for each in found if json_path is None else ():
        click.echo(f"{each['name']} ({each['driver']}, {each['place']}): {each['problem'] or 'taken'}")
    if any(each["problem"] for each in found):
        raise SystemExit(1)


def _tried(config: SinkConfig, machine: str) -> dict[str, Any]:
    """Return what came of a test message."""
    import time

    from daemon.sinks.alarms.message import Message
    from daemon.sinks.contract import SinkError
    from daemon.sinks.running import make_messenger

    message = Message(machine=machine, time_utc_s=time.time())
    try:
        problem = make_messenger(config).send(message)
    except SinkError as error:
        problem = str(error)
    return {
        "name": config.name,
        "driver": config.driver,
        "place": config.place,
        "id": message.number,
        "taken": not problem,
        "problem": problem,
    }
