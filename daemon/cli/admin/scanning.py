"""`toolpoint sources scan`: what is on a bus, as configuration to paste."""

import asyncio
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import yaml

from daemon.cli.common import option, refuse, say
from daemon.cli.options import FiniteFloat
from drivers.contract import DriverError
from models.json_values import printable

if TYPE_CHECKING:
    from drivers.opcua.scan import FoundTag

FIRST_ID = 401
KERNEL_FILES = {
    "1-Wire": "bus/w1/devices/[0-9a-f][0-9a-f]-*/temperature",
    "hwmon": "class/hwmon/hwmon*/temp*_input",
    "IIO": "bus/iio/devices/iio:device*/in_temp*_input",
}
"""Where the kernel shows temperatures, below /sys."""
MOST_TAGS = 500


Found = list[tuple[dict[str, Any], str]]
"""Keys of a sensor, and what it measures now."""


def units(text: str) -> range:
    """Return the units of a text such as 1-16."""
    first, _, last = text.partition("-")
    if (
        not (text.isascii() and first.isdigit() and (last or first).isdigit())
        or not 0 <= int(first) <= int(last or first) <= 247
    ):
        raise click.BadParameter("give a unit or a range of them, such as 1 or 1-16, at most 247")
    return range(int(first), int(last or first) + 1)


@click.command()
@click.argument("kind", type=click.Choice(["modbus", "kernel", "mqtt", "opcua"]))
@click.argument("place", required=False)
@option("--units", "units_text", default="1", help="Modbus: units to ask, such as 1-16.")
@option("--registers", type=click.IntRange(1, 125), default=16, help="Modbus: registers from 0 on to look at.")
@option("--baud", type=click.IntRange(min=1), default=9600, help="Modbus: baud rate of a serial port.")
@option("--parity", type=click.Choice(["none", "even", "odd"]), default="none", help="Modbus: its parity.")
@option("--timeout-s", type=FiniteFloat(min=0.01), default=0.5, help="Modbus: wait so long for each answer [s].")
@option("--topic", default="#", help="MQTT: listen to this topic; + and # are wildcards.")
@option("--seconds", type=FiniteFloat(min=0.1), default=10.0, help="MQTT: listen for so long.")
def scan(
    kind: str,
    place: str | None,
    units_text: str,
    registers: int,
    baud: int,
    parity: str,
    timeout_s: float,
    topic: str,
    seconds: float,
) -> None:
    """Find what is on a bus, and print configuration to paste.

    PLACE is HOST or HOST:PORT of a box or broker, a serial port such as /dev/ttyUSB0, the address of an OPC UA server
    (opc.tcp://host:port/path, which must let anybody read), or, for the kernel, nothing.
    Nothing is written to a device. Stop the daemon first where it has the same port open: a serial bus has one master.
    """
    if kind == "kernel":
        _kernel(Path(place or "/sys"))
        return
    if place is None:
        raise click.UsageError(f"name the place: toolpoint sources scan {kind} HOST")
    if kind == "mqtt":
        _broker(*_host_and_port(place, 1883), topic, seconds)
        return
    if kind == "opcua":
        _server(place)
        return
    wire: dict[str, Any] = {"serial_port": place, "baud": baud, "parity": parity}
    if not place.startswith("/"):
        wire = dict(zip(("host", "port"), _host_and_port(place, 502), strict=True))
    try:
        found = asyncio.run(_modbus(wire | {"timeout_s": timeout_s}, units(units_text), registers))
    except DriverError as error:
        refuse(str(error), status=1)
    if not found:
        refuse(f"{place}: no register from 0 to {registers - 1} looks like a temperature; try --units, --registers", 1)
    paste("modbus", wire, found)


def _host_and_port(place: str, usual: int) -> tuple[str, int]:
    host, _, port = place.partition(":")
    if port and not (port.isascii() and port.isdigit() and 1 <= int(port) <= 65535):
        raise click.BadParameter(f"{place}: the port must be a number from 1 to 65535")
    return host, int(port or usual)


async def _modbus(wire: dict[str, Any], unit_ids: range, registers: int) -> Found:
    from config.schema.modbus import ModbusConfig
    from drivers.modbus.scan import SIGNS, ModbusScan, temperatures_among

    config = ModbusConfig.model_validate({**wire, "sensors": [{"id": 1, "component": "-", "address": 0}]})
    answered = False
    shown = set[int]()
    found: Found = []
    async for unit_id, table, words in ModbusScan(config).found(unit_ids, registers):
        answered, registers_found = True, temperatures_among(unit_id, table, words)
        if unit_id in shown:
            continue  # boxes often show the same registers in both tables; the first that fits is enough
        say(f"unit {unit_id}: {len(words)} {table} registers, {len(registers_found)} look like temperatures")
        for each in registers_found:
            entry: dict[str, Any] = {"address": each.address, "unit_id": unit_id, "table": table, "type": each.type}
            if each.scale != 1.0:
                entry["scale"] = each.scale
            if each.type != "float32":
                entry["open"] = sorted({*SIGNS[:1], *({each.number} if each.is_open else ())})
            found.append((entry, each.words))
        if registers_found:
            shown.add(unit_id)
    if not answered:
        asked = f"unit {unit_ids[0]}" if len(unit_ids) == 1 else f"of units {unit_ids[0]} to {unit_ids[-1]} none"
        silent = "does not answer" if len(unit_ids) == 1 else "answers"
        raise DriverError(f"{asked} {silent} as a Modbus box: check place, wires, --units, --baud and --parity")
    return found


def _kernel(root: Path) -> None:
    from drivers.kernel import number_in
    from drivers.readings import NoReading

    found: Found = []
    for kind, pattern in KERNEL_FILES.items():
        for path in sorted(root.glob(pattern)):
            number = number_in(path)
            words = number.why if isinstance(number, NoReading) else f"{number / 1000:g} degC"
            found.append(({"path": str(path)}, f"{kind}: {words}"))
    if not found:
        refuse(f"the kernel shows no temperature below {root}: plug the sensors in, and load the bus's driver", 1)
    paste("kernel", {}, found)


def _broker(host: str, port: int, topic: str, seconds: float) -> None:
    try:
        found = asyncio.run(_mqtt(host, port, topic, seconds))
    except OSError as error:
        refuse(f"{host}:{port} cannot be reached: {error}", 1)
    if not found:
        refuse(f"{host}:{port}: no message with a number came within {seconds:g} s; listen longer (--seconds)", 1)
    paste("mqtt", {"host": host, "port": port}, found)


async def _mqtt(host: str, port: int, topic: str, seconds: float) -> Found:
    import aiomqtt

    from drivers.mqtt import fields_of, new_identifier

    found: dict[tuple[str, str], float] = {}
    try:
        async with aiomqtt.Client(host, port, identifier=new_identifier(), timeout=seconds) as client:
            await client.subscribe(topic)
            async with asyncio.timeout(seconds):
                async for message in client.messages:
                    for field, number in fields_of(message.payload).items():
                        if len(found) < MOST_TAGS:
                            found[str(message.topic), field] = number
    except aiomqtt.MqttError as error:
        raise OSError(str(error)) from error
    except TimeoutError:
        pass
    return [
        ({"topic": name} | ({"field": field} if field else {}), f"{number:g}")
        for (name, field), number in sorted(found.items())
    ]


def _server(place: str) -> None:
    from drivers.opcua.scan import LENGTHS

    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # what matters of it is in the error
    endpoint = place if place.startswith("opc.tcp://") else f"opc.tcp://{place if ':' in place else f'{place}:4840'}"
    try:
        tags, more = asyncio.run(_browsed(endpoint))
    except DriverError as error:
        refuse(str(error), status=1)
    if not tags:
        refuse(f"{endpoint} shows no variable that holds a number; a user may see more than anybody does", 1)
    for uri in dict.fromkeys(tag.namespace_uri for tag in tags):
        here = [tag for tag in tags if tag.namespace_uri == uri]
        wire = {"endpoint": endpoint, "namespace_uri": uri}
        lengths = [tag for tag in here if tag.unit in LENGTHS.values()]
        if others := [tag for tag in here if tag.unit not in LENGTHS.values()]:
            paste("opcua", wire, [(_place_of(tag), _now(tag)) for tag in others])
        if lengths:
            _paste_channels(wire, [({"name": t.name} | _place_of(t), _now(t)) for t in lengths])
    if more:
        say(f"{endpoint} has more than is shown; {len(tags)} variables are")


async def _browsed(endpoint: str) -> "tuple[list[FoundTag], bool]":
    from config.schema.source_sections import OpcUaServer
    from drivers.opcua.scan import analog_variables
    from drivers.opcua.tags import TagSession

    session = TagSession(OpcUaServer(endpoint=endpoint, namespace_uri="-", security=None, timeout_s=5.0), endpoint)
    try:
        return await analog_variables(session)
    finally:
        await session.close()


def _place_of(tag: "FoundTag") -> dict[str, Any]:
    element = {} if tag.element is None else {"element": tag.element}
    return {"node": tag.node} | element | ({"unit": tag.unit} if tag.unit not in ("", "degC") else {})


def _now(tag: "FoundTag") -> str:
    return f"{tag.name}: {tag.number:g} {tag.given_unit or '(no unit is given)'}"


def _paste_channels(wire: dict[str, Any], found: Found) -> None:
    """Print an entry of the sources of displacements."""
    click.echo("displacements:\n  sources:")
    _paste_entry("gauges", "opcua", wire)
    click.echo("        channels:")
    for entry, words in found:
        click.echo(f"          - {_yaml(entry)}  # {printable(words)}")


def _paste_entry(name: str, driver: str, wire: dict[str, Any]) -> None:
    click.echo(f"    - name: {name}\n      driver: {driver}\n      cycle_period_s: 10.0\n      {driver}:")
    for key, value in wire.items():
        click.echo(f"        {key}: {_yaml(value)}")


def paste(driver: str, wire: dict[str, Any], found: Found) -> None:
    """Print an entry of the sources, each sensor on a line with what it measures now."""
    click.echo("temperatures:\n  sources:")
    _paste_entry(driver, driver, wire)
    click.echo("        sensors:")
    for number, (entry, words) in enumerate(found, start=FIRST_ID):
        sensor = _yaml({"id": number, "component": "WHERE IT SITS", **entry})
        click.echo(f"          - {sensor}  # {printable(words)}")


def _yaml(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False).split("\n", 1)[0]
