"""Sensors in the registers of Modbus boxes, over TCP or on a serial line."""

from config.schema.modbus import ModbusRequest, ModbusWire
from config.schema.source_drivers import SourceEntry
from drivers.clock import Clock
from drivers.contract import LinkError
from drivers.modbus.client import EndedError, ModbusClient, RefusedRead
from drivers.modbus.registers import number_of
from drivers.polling import PolledSource
from drivers.readings import NoReading, Readings
from models.quality import Reason


class ModbusSource(PolledSource):
    """Reads the boxes of one TCP connection or one serial line in turn.

    A box that does not answer costs its own sensors only: the connection is closed, and built anew for the next one.
    When none answers in a whole cycle, the link is lost.
    """

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        super().__init__(source, clock)
        assert isinstance(source.connection, ModbusWire)
        self._config = source.connection
        self._owner = f"source {source.name}"
        self._client: ModbusClient | None = None

    async def open(self) -> None:
        """Connect; raises LinkError."""
        await self._connect()

    async def _connect(self) -> ModbusClient:
        self._client = ModbusClient(self._config, self._owner)
        await self._client.connect()
        return self._client

    async def read(self) -> Readings:
        """Return the number of each sensor; raises LinkError when no box answered."""
        readings: dict[int | str, float | NoReading] = {}
        answered, lost = False, ""
        for request in self._config.requests:
            if self._closed.is_set():
                break
            try:
                registers = await self._ask(request)
            except RefusedRead as refusal:
                answered = True
                self._miss(readings, request, NoReading(reason=Reason.DEVICE_ERROR, why=str(refusal)))
            except LinkError as error:
                lost = lost or str(error)
                await self.release()
                why = str(error).removeprefix(f"{self._owner}: ")  # the row names it before each sensor
                self._miss(readings, request, NoReading(reason=Reason.NOT_RECEIVED, why=why))
            else:
                answered = True
                self._take(readings, request, registers)
        if lost and not answered:
            raise LinkError(lost)
        return readings

    async def _ask(self, request: ModbusRequest) -> list[int]:
        """Return the registers of a request; of a box that ends connections on a new one."""
        try:
            return await (self._client or await self._connect()).read(request)
        except EndedError:
            await self.release()
            if self._closed.is_set():
                raise
            return await (await self._connect()).read(request)

    def _miss(self, readings: dict[int | str, float | NoReading], request: ModbusRequest, why: NoReading) -> None:
        readings.update(dict.fromkeys((self._config.registers[place].key for place in request.inputs), why))

    def _take(self, readings: dict[int | str, float | NoReading], request: ModbusRequest, registers: list[int]) -> None:
        for place in request.inputs:
            each = self._config.registers[place]
            at = each.address - request.start
            readings[each.key] = number_of(registers[at : at + each.width], each)

    async def release(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()
