"""Maps sections of the configuration to drivers: the only place that names drivers.

A driver is imported when it is first asked for, so that an installation loads the libraries of its own wires only.
To add one: its section in the schema, and one line in a table here.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from config.schema import Configuration
from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import FocasConfig
from config.schema.displacements import DisplacementFileConfig, DisplacementsConfig, DisplacementSourceConfig
from config.schema.source_drivers import SourceEntry
from config.schema.temperatures import LineConfig, SensorConfig, TemperatureInput
from drivers.clock import Clock
from drivers.contract import Cnc, DisplacementSource, TemperatureSource

if TYPE_CHECKING:
    from drivers.readings import RowSource

CncFactory = Callable[[CncConfig, Clock], Cnc]
LineFactory = Callable[[LineConfig, list[SensorConfig], Clock], TemperatureSource]
SourceFactory = Callable[[SourceEntry, Clock], "RowSource"]
FileFactory = Callable[[DisplacementsConfig, Clock, float | None], DisplacementSource]
DisplacementInput = DisplacementFileConfig | DisplacementSourceConfig


def _opcua() -> CncFactory:
    from drivers.opcua.cnc import OpcUaCnc

    return OpcUaCnc


def _focas() -> CncFactory:
    def own_or_the_vendors(config: CncConfig, clock: Clock) -> Cnc:
        if config.connection_as(FocasConfig).library is not None:
            from drivers.focas.library import LibraryFocasCnc

            return LibraryFocasCnc(config, clock)
        from drivers.focas.cnc import FocasCnc

        return FocasCnc(config, clock)

    return own_or_the_vendors


def _haas() -> CncFactory:
    from drivers.haas.cnc import HaasCnc

    return HaasCnc


def _linuxcnc() -> CncFactory:
    from drivers.linuxcnc.cnc import LinuxcncCnc

    return LinuxcncCnc


def _mtconnect() -> CncFactory:
    from drivers.mtconnect.cnc import MtconnectCnc

    return MtconnectCnc


def _latsis() -> LineFactory:
    from drivers.latsis.source import LatsisSerialSource

    return LatsisSerialSource


def _modbus() -> SourceFactory:
    from drivers.modbus.source import ModbusSource

    return ModbusSource


def _csv() -> SourceFactory:
    from drivers.displacement.logger import LoggerSource

    return LoggerSource


def _kernel() -> SourceFactory:
    from drivers.kernel import KernelSource

    return KernelSource


def _process() -> SourceFactory:
    from drivers.process import ProcessSource

    return ProcessSource


def _mqtt() -> SourceFactory:
    from drivers.mqtt import MqttSource

    return MqttSource


def _opcua_tags() -> SourceFactory:
    from drivers.opcua.tags import OpcUaTagSource

    return OpcUaTagSource


def _file() -> FileFactory:
    from drivers.displacement.source import DisplacementCsvSource

    return lambda config, clock, after_utc_s: DisplacementCsvSource(config, clock, after_utc_s=after_utc_s)


CNC_DRIVERS: Mapping[str, Callable[[], CncFactory]] = {
    "opcua": _opcua,
    "focas": _focas,
    "haas": _haas,
    "linuxcnc": _linuxcnc,
    "mtconnect": _mtconnect,
}
"""`cnc.driver` -> what imports the driver and returns its factory."""
LINES: Mapping[str, Callable[[], LineFactory]] = {"latsis": _latsis}
"""Driver of a line -> the same."""
SOURCES: Mapping[str, Callable[[], SourceFactory]] = {
    "modbus": _modbus,
    "csv": _csv,
    "kernel": _kernel,
    "process": _process,
    "mqtt": _mqtt,
    "opcua": _opcua_tags,
}
"""Driver of a source of temperatures or displacements -> the same."""
FILES: Mapping[str, Callable[[], FileFactory]] = {"file": _file}
"""Kind of the A/D logger's files -> the same."""


def open_cnc(configuration: Configuration, clock: Clock) -> Cnc:
    return CNC_DRIVERS[configuration.cnc.driver]()(configuration.cnc, clock)


def open_temperature_source(configuration: Configuration, each: TemperatureInput, clock: Clock) -> TemperatureSource:
    """Return a new, unopened source for one line or one entry of the sources."""
    if isinstance(each, LineConfig):
        return LINES[each.driver]()(each, configuration.temperatures.sensors, clock)
    return SOURCES[each.driver]()(each, clock)


def open_displacement_source(
    configuration: Configuration, each: DisplacementInput, clock: Clock, after_utc_s: float | None
) -> DisplacementSource:
    """Return a new source of all channels; rows of the A/D logger's files up to `after_utc_s` are skipped."""
    displacements = configuration.displacements
    assert displacements is not None
    if isinstance(each, DisplacementFileConfig):
        opened = FILES[each.driver]()(displacements, clock, after_utc_s)
        if not displacements.sources:
            return opened
        names = {channel.name for channel in displacements.channels}
    else:
        from drivers.displacement.of_sources import SourceDisplacements

        opened = SourceDisplacements(SOURCES[each.driver]()(each, clock))
        names = {channel.name for channel in each.channels}
    from drivers.displacement.of_sources import AmongOthers

    every = displacements.every_channel
    return AmongOthers(opened, [place for place, channel in enumerate(every) if channel.name in names], len(every))


def import_drivers(configuration: Configuration) -> None:
    """Import what this configuration needs now, because an import in a running event loop would hold it up."""
    CNC_DRIVERS[configuration.cnc.driver]()
    displacements = () if configuration.displacements is None else configuration.displacements.inputs
    for driver in (each.driver for each in (*configuration.temperatures.inputs, *displacements)):
        (LINES.get(driver) or FILES.get(driver) or SOURCES[driver])()
