"""`toolpoint sources`: what the sources of a configuration deliver."""

import asyncio
import math
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import click

from config.schema import Configuration
from config.schema.source_drivers import SourceEntry
from daemon.cli.admin.scanning import scan
from daemon.cli.command_group import Group
from daemon.cli.common import config_option, option, read_configuration, refuse, say, write_json
from daemon.cli.options import json_option
from drivers import registry
from drivers.clock import SystemClock
from drivers.contract import DriverError
from drivers.readings import Row
from models.json_values import finite_or_none, printable
from models.quality import describe

PATIENCE_S = 5.0
"""Time for the first cycle beyond its period [s]."""


@click.group(cls=Group)
def sources() -> None:
    """Sources of temperatures and displacements: Modbus, logger files, the kernel, programs, MQTT, OPC UA tags."""


sources.add_command(scan)


@sources.command()
@config_option
@option(
    "--simulated", is_flag=True, help="Read simulated boxes on this computer, at the registers of the configuration."
)
@option("--cycles", type=click.IntRange(min=1), default=1, help="End after so many cycles of each source.")
@json_option
def read(config_path: Path, simulated: bool, cycles: int, json_path: str | None) -> None:
    """Show what every sensor and every channel of every source measures now.

    Exit status 0 when each of them has a value, else 1. Nothing is written. Stop the daemon first where a device
    takes one connection only.
    """
    configuration = read_configuration(config_path)
    if not _sources(configuration):
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
        each = _sources(configuration)
        done = await asyncio.gather(*(_one(source, count, quiet) for source in each))
        return {source.name: result for source, result in zip(each, done, strict=True)}


def _sources(configuration: Configuration) -> list[SourceEntry]:
    """Return the sources of temperatures and those of displacements."""
    displacements = configuration.displacements
    measured = None if displacements is None else displacements.sources
    return [*(configuration.temperatures.sources or ()), *(measured or ())]


async def _one(source: SourceEntry, count: int, quiet: bool) -> dict[str, Any]:
    """Read one source; return what it measures, or its problem."""
    result: dict[str, Any] = {"driver": source.driver, "exposed": source.connection.exposed, "problem": None}
    opened = registry.SOURCES[source.driver]()(source, SystemClock())
    seen: Row | None = None
    try:
        rows = opened.rows()
        for _ in range(count):
            async with asyncio.timeout(source.cycle_period_s + PATIENCE_S):
                seen = await anext(rows)
            if not quiet:
                _show(source, seen)
    except (DriverError, TimeoutError, StopAsyncIteration) as error:
        late = f"source {source.name}: nothing arrived within {source.cycle_period_s + PATIENCE_S:g} s"
        result["problem"] = str(error) if isinstance(error, DriverError) else late
        if not quiet:
            say(printable(str(result["problem"])))
    finally:
        await opened.close()
    return result | _values(source, seen)


def _values(source: SourceEntry, row: Row | None) -> dict[str, Any]:
    values = [math.nan] * len(source.inputs) if row is None else row.values.tolist()
    found = {
        str(each.key): {
            each.unit_words.lower(): finite_or_none(value, 3),
            "reason": "" if math.isfinite(value) else "nothing arrived" if row is None else describe(row.reason[i]),
        }
        for i, (each, value) in enumerate(zip(source.inputs, values, strict=True))
    }
    faults = [] if row is None else list(row.faults)
    missing = sum(not math.isfinite(value) for value in values)
    return {"missing": missing, source.connection.listed: found, "faults": faults}


def _show(source: SourceEntry, row: Row) -> None:
    exposed = f"; {source.connection.exposed}" if source.connection.exposed else ""
    click.echo(printable(f"source {source.name} ({source.driver}{exposed}), cycle {row.number}"))
    for each, value, reason in zip(source.inputs, row.values.tolist(), row.reason.tolist(), strict=True):
        words = f"{value:8.2f} {each.unit_words}" if math.isfinite(value) else f"       - {describe(reason)}"
        click.echo(printable(f"  {each.in_words:40.40} {words}"))
    for fault in row.faults:
        say(printable(fault))
