"""What answers on a Modbus bus: units, their registers, and which of them look like temperatures. Reads only."""

import math
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass

from config.schema.modbus import ModbusConfig, ModbusRequest, ModbusSensorConfig, Table
from drivers.contract import LinkError
from drivers.modbus.client import ModbusClient, RefusedRead
from drivers.modbus.registers import number_of

TABLES: tuple[Table, ...] = ("holding", "input")
SIGNS = (-999.0, -9999.0, -32768.0, 32767.0, -1000.0, 9999.0)
"""What boxes commonly send where no sensor is connected."""
COLDEST_DEGC, HOTTEST_DEGC = 5.0, 60.0
"""A machine at rest lies between; what does not is not proposed."""
SCALES = (0.1, 0.01, 1.0)
"""How boxes commonly scale degC, the most common first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundRegister:
    """One register, or two of them, and what it may be."""

    unit_id: int
    table: Table
    address: int
    type: str
    scale: float
    number: float
    is_open: bool

    @property
    def words(self) -> str:
        """What it holds, for a person."""
        return "open sensor" if self.is_open else f"{self.number * self.scale:g} degC"


class ModbusScan:
    """Looks at the units of one bus, one read at a time."""

    def __init__(self, place: ModbusConfig) -> None:
        self._config = place
        self._client: ModbusClient | None = None

    async def found(self, unit_ids: Sequence[int], registers: int) -> AsyncIterator[tuple[int, Table, dict[int, int]]]:
        """Yield unit, table and registers of what answers; raises LinkError when the bus cannot be opened."""
        try:
            for unit_id in unit_ids:
                for table in TABLES:
                    words = await self._table(unit_id, table, registers)
                    if words is None:
                        break  # nobody is there
                    yield unit_id, table, words
        finally:
            self._close()

    async def _table(self, unit_id: int, table: Table, registers: int) -> dict[int, int] | None:
        """Return the registers of a table; None when the unit does not answer at all."""
        words: dict[int, int] = {}
        for start, count in [(0, registers), *((address, 1) for address in range(registers))]:
            request = ModbusRequest(unit_id=unit_id, table=table, start=start, count=count, inputs=())
            client = self._client or await self._open()
            try:
                words |= dict(enumerate(await client.read(request), start=start))
            except RefusedRead:
                continue
            except LinkError:
                self._close()
                return words or None
            if count == registers:
                return words
        return words

    async def _open(self) -> ModbusClient:
        self._client = ModbusClient(self._config, "scan")
        await self._client.connect()
        return self._client

    def _close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()


def temperatures_among(unit_id: int, table: Table, words: dict[int, int]) -> list[FoundRegister]:
    """Return which registers look like temperatures, with one scale for all of a table; 32-bit numbers first."""
    floats = _readings(words, "float32")
    likely = {a: n for a, n in floats.items() if COLDEST_DEGC <= n <= HOTTEST_DEGC and n != round(n)}
    if likely:
        return [_register(unit_id, table, a, "float32", 1.0, n) for a, n in sorted(likely.items())]
    integers = _readings(words, "int16")
    for scale in SCALES:
        fitting = [a for a, n in integers.items() if COLDEST_DEGC <= n * scale <= HOTTEST_DEGC]
        if fitting:
            signs = [a for a, n in integers.items() if n in SIGNS]
            return [_register(unit_id, table, a, "int16", scale, integers[a]) for a in sorted({*fitting, *signs})]
    return []


def _readings(words: dict[int, int], kind: str) -> dict[int, float]:
    about = {"id": 1, "component": "-", "address": 0, "type": kind}
    sensor = ModbusSensorConfig.model_validate(about)
    step, found = sensor.width, dict[int, float]()
    for address in range(min(words, default=0), max(words, default=-1) + 1, step):
        registers = [words.get(address + i) for i in range(step)]
        known = [word for word in registers if word is not None]
        if len(known) == step and math.isfinite(number := number_of(known, sensor)):
            found[address] = number
    return found


def _register(unit_id: int, table: Table, address: int, kind: str, scale: float, number: float) -> FoundRegister:
    return FoundRegister(
        unit_id=unit_id,
        table=table,
        address=address,
        type=kind,
        scale=scale,
        number=number,
        is_open=kind != "float32" and number in SIGNS,
    )
