"""`toolpoint cnc`: what the configured control gives and takes."""

import asyncio
import math
import re
import sys
from pathlib import Path
from typing import Any

import click
import yaml

from config.schema.base import ENDPOINT_PATTERN
from daemon.cli.command_group import Group
from daemon.cli.common import FAILED, FILE, config_option, option, read_configuration, refuse, say, write_json
from daemon.cli.options import FiniteFloat, json_option
from models.json_values import printable


@click.group(cls=Group)
def cnc() -> None:
    """Look at the control, without writing anything."""


@cnc.command()
@config_option
@json_option
def probe(config_path: Path, json_path: str | None) -> None:
    """Say who the control is, whether the connection is secure, and what can be read and written.

    Nothing is written: what stands under write_macros is what the daemon itself would refuse. Exit status 1 when the
    control does not answer or refuses what the daemon needs.
    """
    from daemon.checkup.control import probe_control
    from drivers.clock import SystemClock

    found = asyncio.run(probe_control(read_configuration(config_path), SystemClock()))
    write_json(json_path, found)
    if json_path is None:
        for line in _in_words(found):
            say(line)
    sys.exit(0 if found["identity"] else FAILED)


@cnc.command()
@click.argument("url", required=False)
@option("--config", "-c", "config_path", type=FILE, help="Ask the control of this configuration, as its user.")
@option("--timeout-s", type=FiniteFloat(min=0.1), default=5.0, help="Wait so long for each answer [s].")
@json_option
def browse(url: str | None, config_path: Path | None, timeout_s: float, json_path: str | None) -> None:
    """Show the variables of a control's OPC UA server, and propose the map of them to paste.

    URL is opc.tcp://HOST:PORT of a server that lets anybody look; with -c the configuration says where and as whom.
    Variables are known by usual names and by nothing else: compare what each holds with the control's screen. Nothing
    is written. Exit status 1 when the server does not answer or nothing in it has a usual name.
    """
    from daemon.checkup.node_map import look
    from drivers.contract import DriverError

    security, guard = None, None
    if config_path is not None:
        configured = read_configuration(config_path).cnc
        if url is not None or configured.opcua is None:
            refuse("name a URL, or a configuration with driver opcua, and not both")
        url, security, guard = configured.opcua.endpoint, configured.opcua.security, configured.guard
    if url is None or not re.search(ENDPOINT_PATTERN, url):
        refuse("name the server: toolpoint cnc browse opc.tcp://HOST:PORT, or -c FILE")
    try:
        browsed, proposal = asyncio.run(look(url, security, timeout_s, guard))
    except DriverError as error:
        refuse(str(error), status=FAILED)
    shown = [
        {"node": each.node, "namespace": each.namespace, "path": each.path, "value": printable_value(each.value)}
        for each in browsed.variables
    ]
    found: dict[str, Any] = {"endpoint": url, "namespaces": browsed.namespaces, "complete": browsed.complete}
    found |= {"variables": shown, "proposal": None, "missing": [], "others": {}}
    if proposal is not None:
        values = {key: printable_value(value) for key, value in proposal.values.items()}
        found |= {"proposal": proposal.section(url), "missing": proposal.missing, "others": proposal.others}
        found["values"] = values
    write_json(json_path, found)
    if json_path is None:
        _say_browsed(found)
    sys.exit(0 if proposal is not None else FAILED)


def printable_value(value: Any) -> Any:
    """Return a value as JSON takes it: numbers and short texts as they are, everything else by its beginning."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, (bool, int, float)) else printable(str(value))[:80]


def _say_browsed(found: dict[str, Any]) -> None:
    for each in found["variables"]:
        value = "no value" if each["value"] is None else each["value"]
        click.echo(f"# {each['node']}  {printable(each['path'])}  {value}")
    if not found["complete"]:
        click.echo("# and more: not all nodes of the server were looked at")
    if found["proposal"] is None:
        say("no variable has a usual name; name them in cnc.opcua.nodes with preset generic")
        return
    click.echo(yaml.safe_dump({"cnc": {"driver": "opcua", "opcua": found["proposal"]}}, sort_keys=False), nl=False)
    for key, value in found["values"].items():
        click.echo(f"# {key} holds {'no value now' if value is None else value}")
    for key, nodes in found["others"].items():
        click.echo(f"# {key}: {', '.join(nodes)} might be meant as well")
    for key in found["missing"]:
        click.echo(f"# {key}: nothing found; name it, or leave it out where the control has none")


def _in_words(found: dict[str, Any]) -> list[str]:
    security = "encrypted" if found["secure"] else "NOT secure: anybody on this network can read and write"
    can = ", ".join(name.replace("_", " ") for name, able in found["can"].items() if able)
    return [
        f"{found['identity'] or 'no control'} by driver {found['driver']}, {security}",
        f"can: {can or 'nothing'}",
        *(f"cannot: {entry['what'].replace('_', ' ')}: {entry['why']}" for entry in found["refused"]),
    ]
