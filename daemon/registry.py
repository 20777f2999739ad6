"""Which driver serves which part of the configuration. The only place that names drivers."""

from collections.abc import Callable
from dataclasses import dataclass

from config.schema import Configuration
from config.schema.temperatures import LineConfig
from daemon.housekeeping.side_job import Housekeeping, housekeeping_scheduler
from drivers.clock import Clock
from drivers.contract import Cnc, DisplacementSource, TemperatureSource
from drivers.displacement.source import DisplacementCsvSource
from drivers.latsis.source import LatsisSerialSource
from drivers.opcua.cnc import OpcUaCnc


def open_temperature_source(configuration: Configuration, line: LineConfig, clock: Clock) -> TemperatureSource:
    """Return a new, unopened source for one LATSIS line."""
    return LatsisSerialSource(line, configuration.temperatures.sensors, clock)


def open_displacement_source(
    configuration: Configuration, clock: Clock, after_utc_s: float | None
) -> DisplacementSource:
    """Return a new, unopened source for the logger's files; rows up to `after_utc_s` are skipped."""
    assert configuration.displacements is not None
    return DisplacementCsvSource(configuration.displacements, clock, after_utc_s=after_utc_s)


def open_cnc(configuration: Configuration, clock: Clock) -> Cnc:
    """Return a new, unconnected CNC."""
    return OpcUaCnc(configuration.cnc, clock)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """What a daemon is composed of at its edges; a rehearsal may put others there."""

    open_temperature_source: Callable[[Configuration, LineConfig, Clock], TemperatureSource] = open_temperature_source
    open_displacement_source: Callable[[Configuration, Clock, float | None], DisplacementSource] = (
        open_displacement_source
    )
    open_cnc: Callable[[Configuration, Clock], Cnc] = open_cnc
    housekeeping: Housekeeping = housekeeping_scheduler


PARTS = Parts()
"""The parts of the product."""
