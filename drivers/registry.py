"""Maps sections of the configuration to drivers: the only place that names drivers.

A driver is imported when it is first asked for, so that an installation loads the libraries of its own wires only.
To add one: its section in the schema, and one line in a table here.
"""

from collections.abc import Callable, Mapping

from config.schema import Configuration
from config.schema.cnc import CncConfig
from config.schema.displacements import DisplacementsConfig
from config.schema.source_drivers import SourceConfig
from config.schema.temperatures import LineConfig, SensorConfig, TemperatureInput
from drivers.clock import Clock
from drivers.contract import Cnc, DisplacementSource, TemperatureSource

CncFactory = Callable[[CncConfig, Clock], Cnc]
TemperatureFactory = Callable[[TemperatureInput, list[SensorConfig], Clock], TemperatureSource]
DisplacementFactory = Callable[[DisplacementsConfig, Clock, float | None], DisplacementSource]


def _opcua() -> CncFactory:
    from drivers.opcua.cnc import OpcUaCnc

    return OpcUaCnc


def _focas() -> CncFactory:
    from drivers.focas.cnc import FocasCnc

    return FocasCnc


def _haas() -> CncFactory:
    from drivers.haas.cnc import HaasCnc

    return HaasCnc


def _latsis() -> TemperatureFactory:
    from drivers.latsis.source import LatsisSerialSource

    def opened(line: TemperatureInput, sensors: list[SensorConfig], clock: Clock) -> TemperatureSource:
        assert isinstance(line, LineConfig)
        return LatsisSerialSource(line, sensors, clock)

    return opened


def _of_source(factory: Callable[[SourceConfig, Clock], TemperatureSource]) -> TemperatureFactory:
    """Return a factory of a source, which brings its own sensors."""

    def opened(source: TemperatureInput, _: list[SensorConfig], clock: Clock) -> TemperatureSource:
        assert isinstance(source, SourceConfig)
        return factory(source, clock)

    return opened


def _modbus() -> TemperatureFactory:
    from drivers.modbus.source import ModbusSource

    return _of_source(ModbusSource)


def _csv() -> TemperatureFactory:
    from drivers.displacement.temperatures import LoggerTemperatureSource

    return _of_source(LoggerTemperatureSource)


def _kernel() -> TemperatureFactory:
    from drivers.kernel import KernelSource

    return _of_source(KernelSource)


def _process() -> TemperatureFactory:
    from drivers.process import ProcessSource

    return _of_source(ProcessSource)


def _mqtt() -> TemperatureFactory:
    from drivers.mqtt import MqttSource

    return _of_source(MqttSource)


def _opcua_tags() -> TemperatureFactory:
    from drivers.opcua.temperatures import OpcUaTemperatureSource

    return _of_source(OpcUaTemperatureSource)


def _file() -> DisplacementFactory:
    from drivers.displacement.source import DisplacementCsvSource

    return lambda config, clock, after_utc_s: DisplacementCsvSource(config, clock, after_utc_s=after_utc_s)


CNC_DRIVERS: Mapping[str, Callable[[], CncFactory]] = {"opcua": _opcua, "focas": _focas, "haas": _haas}
"""`cnc.driver` -> what imports the driver and returns its factory."""
TEMPERATURE_SOURCES: Mapping[str, Callable[[], TemperatureFactory]] = {
    "latsis": _latsis,
    "modbus": _modbus,
    "csv": _csv,
    "kernel": _kernel,
    "process": _process,
    "mqtt": _mqtt,
    "opcua": _opcua_tags,
}
"""Driver of a line or of a source -> the same."""
DISPLACEMENT_SOURCES: Mapping[str, Callable[[], DisplacementFactory]] = {"file": _file}
"""Kind of a displacement source -> the same."""


def open_cnc(configuration: Configuration, clock: Clock) -> Cnc:
    """Return a new, unconnected CNC."""
    return CNC_DRIVERS[configuration.cnc.driver]()(configuration.cnc, clock)


def open_temperature_source(configuration: Configuration, each: TemperatureInput, clock: Clock) -> TemperatureSource:
    """Return a new, unopened source for one line or one entry of the sources."""
    return TEMPERATURE_SOURCES[each.driver]()(each, configuration.temperatures.sensors, clock)


def open_displacement_source(
    configuration: Configuration, clock: Clock, after_utc_s: float | None
) -> DisplacementSource:
    """Return a new, unopened source for the displacements; samples up to `after_utc_s` are skipped."""
    assert configuration.displacements is not None
    return DISPLACEMENT_SOURCES[configuration.displacements.driver]()(configuration.displacements, clock, after_utc_s)


def import_drivers(configuration: Configuration) -> None:
    """Import what this configuration needs now, because an import in a running event loop would hold it up."""
    CNC_DRIVERS[configuration.cnc.driver]()
    for each in configuration.temperatures.inputs:
        TEMPERATURE_SOURCES[each.driver]()
    if configuration.displacements is not None:
        DISPLACEMENT_SOURCES[configuration.displacements.driver]()
