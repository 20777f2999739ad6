"""`toolpoint sources`: what the temperature sources of a configuration deliver."""

import asyncio
import math
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import click

from config.schema import Configuration
from config.schema.source_drivers import SourceConfig
from daemon.cli.admin.scanning import scan
from daemon.cli.common import config_option, json_option, option, read_configuration, refuse, say, write_json
from drivers import registry
from drivers.clock import SystemClock
from drivers.contract import DriverError
from drivers.readings import in_words
from models.json_values import finite_or_none, printable
from models.quality import describe
from models.records import TemperatureCycle

PATIENCE_S = 5.0
"""Time for the first cycle beyond its period [s]."""


@click.group()
def sources() -> None:
    """Temperature sources beside the LATSIS lines: Modbus, logger files, the kernel, programs, MQTT, OPC UA tags."""


sources.add_command(scan)


@sources.command()
@config_option
@option(
    "--simulated", is_flag=True, help="Read simulated boxes on this computer, at the registers of the configuration."
)
@option("--cycles", type=click.IntRange(min=1), default=1, help="End after so many cycles of each source.")
@json_option
def read(config_path: Path, simulated: bool, cycles: int, json_path: str | None) -> None:
    """Show what every sensor of every source measures now.

    Exit status 0 when every sensor has a temperature, else 1. Nothing is written. Stop the daemon first where a device
    takes one connection only.
    """
    configuration = read_configuration(config_path)
    if not configuration.temperatures.sources:
        refuse(f"{config_path}: temperatures.sources names no source; `toolpoint check` reads LATSIS lines")
    results = asyncio.run(_read(configuration, simulated=simulated, count=cycles, quiet=json_path == "-"))
    write_json(json_path, {"simulated": simulated, "sources": results})
    sound = all(each["problem"] is None and each["missing"] == 0 for each in results.values())
    sys.exit(0 if sound else 1)


async def _read(configuration: Configuration, *, simulated: bool, count: int, quiet: bool) -> dict[str, Any]:
    async with AsyncExitStack() as stack:
        if simulated:
            from daemon.simulation.boxes import simulated_sources

            configuration = await stack.enter_async_context(simulated_sources(configuration))
        each = configuration.temperatures.sources or []
        done = await asyncio.gather(*(_one(configuration, source, count, quiet) for source in each))
        return {source.name: result for source, result in zip(each, done, strict=True)}


async def _one(configuration: Configuration, source: SourceConfig, count: int, quiet: bool) -> dict[str, Any]:
    """Read one source; return its sensors, or its problem."""
    result: dict[str, Any] = {"driver": source.driver, "exposed": source.connection.exposed, "problem": None}
    opened = registry.open_temperature_source(configuration, source, SystemClock())
    seen: TemperatureCycle | None = None
    try:
        cycles = opened.cycles()
        for _ in range(count):
            async with asyncio.timeout(source.cycle_period_s + PATIENCE_S):
                seen = await anext(cycles)
            if not quiet:
                _show(source, seen)
    except (DriverError, TimeoutError, StopAsyncIteration) as error:
        late = f"source {source.name}: nothing arrived within {source.cycle_period_s + PATIENCE_S:g} s"
        result["problem"] = str(error) if isinstance(error, DriverError) else late
        if not quiet:
            say(printable(str(result["problem"])))
    finally:
        await opened.close()
    return result | _sensors(source, seen)


def _sensors(source: SourceConfig, cycle: TemperatureCycle | None) -> dict[str, Any]:
    degc = [math.nan] * len(source.sensors) if cycle is None else cycle.degc.tolist()
    sensors = {
        str(sensor.id): {
            "degc": finite_or_none(value, 3),
            "reason": "" if math.isfinite(value) else "nothing arrived" if cycle is None else describe(cycle.reason[i]),
        }
        for i, (sensor, value) in enumerate(zip(source.sensors, degc, strict=True))
    }
    faults = [] if cycle is None else list(cycle.faults)
    return {"missing": sum(not math.isfinite(value) for value in degc), "sensors": sensors, "faults": faults}


def _show(source: SourceConfig, cycle: TemperatureCycle) -> None:
    exposed = f"; {source.connection.exposed}" if source.connection.exposed else ""
    click.echo(printable(f"source {source.name} ({source.driver}{exposed}), cycle {cycle.number}"))
    for sensor, degc, reason in zip(source.sensors, cycle.degc.tolist(), cycle.reason.tolist(), strict=True):
        value = f"{degc:8.2f} degC" if math.isfinite(degc) else f"       - {describe(reason)}"
        click.echo(printable(f"  {in_words(sensor):40.40} {value}"))
    for fault in cycle.faults:
        say(printable(fault))
