"""One temperature in a macro variable of its own; the configuration names sensor and macro, or it is off.

It moves nothing, and is written as everything else: inside `macros.writable`, read back, audited, by the control task.
"""

import math

from config.schema import Configuration
from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks
from daemon.cnc.session import CncSession
from daemon.telemetry.metrics import Telemetry
from drivers.contract import FatalDriverError
from models.records import MachineTemperatures, Trace, WriteOutcome

TEMPERATURE_CAUSE = "temperature"


class TemperatureMacro:
    """Follows one sensor."""

    def __init__(
        self, configuration: Configuration, telemetry: Telemetry, journal: Journal, interlocks: Interlocks
    ) -> None:
        self._config = configuration.cnc.temperature_macro
        self._telemetry = telemetry
        self._journal = journal
        self._interlocks = interlocks
        self._line = ""
        self._index = 0
        self._due: tuple[float, Trace] | None = None
        self._shown_degc: float | None = None
        if self._config is not None:
            sensor, temperatures = self._config.sensor, configuration.temperatures
            self._index = temperatures.sensor_ids.index(sensor)
            self._line = next(each.name for each in temperatures.inputs if sensor in each.sensor_ids)

    @property
    def due(self) -> bool:
        """A value waits to be written."""
        return self._due is not None

    def on_temperatures(self, temperatures: MachineTemperatures) -> None:
        """Take a cycle; a missing value leaves the macro as it is, and the same value is not written again."""
        if self._config is None or temperatures.line != self._line:
            return
        values = temperatures.degc if self._config.cleansed else temperatures.measured_degc
        degc = float(values[self._index])
        if math.isfinite(degc) and degc != self._shown_degc:
            self._due = (degc, temperatures.trace)

    async def serve(self, session: CncSession | None, *_: object) -> None:
        """Write what waits; returns at once when nothing does, or when nothing may be written."""
        if self._due is None or self._config is None:
            return
        (degc, trace), self._due, self._shown_degc = self._due, None, None
        if session is None or self._journal.fault is not None or self._interlocks.write_inhibit(session.cnc):
            return
        try:
            receipt = await session.write_one(self._config.macro, degc, cause=TEMPERATURE_CAUSE, trace=trace)
        except FatalDriverError as error:
            self._journal.raise_fault(f"a write was refused: {error}")
            return
        if receipt.outcome is not WriteOutcome.VERIFIED:
            self._journal.raise_fault(f"read-back differs: {receipt.detail}")
            return
        self._shown_degc = degc
        self._telemetry.temperature_shown(receipt.trace)
