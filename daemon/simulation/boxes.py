"""Simulated boxes for the sources of a configuration, and the published machine's sensors put on other wires."""

import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

from config.schema import Configuration
from config.schema.modbus import ModbusConfig
from config.schema.source_drivers import SourceConfig
from config.schema.temperatures import expand_ranges
from daemon.simulation import SimulationError
from daemon.simulation.processes import free_port
from drivers.sim.wires.source_wires import SourceWires

TMP102 = {"scale": 0.0625}
MLX90615 = {"unit": "K", "scale": 0.02}
"""How the numbers of the two devices are read; the boxes hold the sensors' own codes."""


def put_on(driver: str, content: dict[str, Any]) -> None:
    """Make a source of every line, at an address of its own: a Modbus box, or a broker with one topic.

    Boxes hold the sensors in successive registers, in the order of the chain; a message is a JSON object of them all.
    """
    temperatures = content["temperatures"]
    known = {sensor["id"]: sensor for sensor in temperatures.pop("sensors")}
    temperatures["sources"] = [
        {
            "name": line["name"],
            "driver": driver,
            "cycle_period_s": line.get("cycle_period_s", 10.0),
            driver: {
                "host": "127.0.0.1",
                "port": free_port(),
                "sensors": [
                    _sensor(known[sensor_id]) | PLACES[driver](line["name"], sensor_id, place)
                    for place, sensor_id in enumerate(expand_ranges(line["chain"]))
                ],
            },
        }
        for line in temperatures["lines"]
    ]
    temperatures["lines"] = []


PLACES: dict[str, Callable[[str, int, int], dict[str, Any]]] = {
    "modbus": lambda line, sensor_id, place: {"address": place},
    "mqtt": lambda line, sensor_id, place: {"topic": f"toolpoint/{line}", "field": f"t{sensor_id}"},
}
"""Driver -> where a sensor of a line is found, by the line's name, its ID and its place in the chain."""


def _sensor(sensor: dict[str, Any]) -> dict[str, Any]:
    device = MLX90615 if sensor.get("device") == "MLX90615" else TMP102
    return {key: value for key, value in sensor.items() if key != "device"} | device


def swinging_degc(sensor_ids: Sequence[int]) -> list[float]:
    """Return temperatures that differ from sensor to sensor and move by half a degree within some minutes [degC]."""
    now_s = time.monotonic()
    return [21.0 + 0.05 * (i % 40) + 0.25 * math.sin(now_s / 60.0 + i) for i in sensor_ids]


@contextlib.asynccontextmanager
async def simulated_sources(configuration: Configuration) -> AsyncIterator[Configuration]:
    """Serve a box for every source; yield the configuration with their addresses. Raises SimulationError."""
    temperatures = configuration.temperatures
    moved = [_here(source) for source in temperatures.sources or ()]
    try:
        wires = SourceWires(moved, swinging_degc)
        await wires.open()
    except (ValueError, OSError) as error:
        raise SimulationError(str(error)) from error
    try:
        yield configuration.model_copy(update={"temperatures": temperatures.model_copy(update={"sources": moved})})
    finally:
        await wires.close()


def _here(source: SourceConfig) -> SourceConfig:
    """Return a source at a free port of this computer; a serial line as its bytes over TCP."""
    config = source.connection
    if not isinstance(config, ModbusConfig):
        raise SimulationError(f"source {source.name}: driver {source.driver} cannot be simulated")
    place = {"host": "127.0.0.1", "port": free_port(), "serial_port": None}
    place["framing"] = "rtu" if config.is_rtu else "tcp"
    return source.model_copy(update={source.driver: config.model_copy(update=place)})
