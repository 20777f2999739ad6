"""Sensors behind Modbus: registers of boxes, and by which requests they are read.

On a serial line an answer shows its unit, its function and how many registers it holds, not which. So no two requests
of one unit and table ask for the same count there: a late or doubled answer fits no other request.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

from pydantic import Field

from config.schema.base import Host, Problems, Seconds, checked
from config.schema.sources import Measured, SourceConnection, SourceSensorConfig

LAST_ADDRESS = 65535
MOST_REGISTERS = 125
"""One Modbus answer holds no more."""
BITS = {"int16": 16, "uint16": 16, "int32": 32, "uint32": 32, "float32": 32}
Table = Literal["holding", "input"]
Span = tuple[int, int]
"""First register and the one after the last."""


class ModbusRegister(Measured):
    """One or two registers of a box, and the number that they hold."""

    address: int = Field(
        ge=0,
        le=LAST_ADDRESS,
        description="its (first) register, counted from 0 as on the wire: what a manual calls 40001 or 30001 is 0",
        examples=[0],
    )
    table: Table = Field("holding", description="holding registers (function 3) or input registers (function 4)")
    type: Literal["int16", "uint16", "int32", "uint32", "float32"] = Field("int16", description="what it holds")
    word_order: Literal["big", "little"] = Field(
        "big", description="of a 32-bit number's two registers the upper one first, or the lower one first"
    )
    unit_id: int | None = Field(
        None, ge=0, le=255, description="unit of its box, where it is not the source's `unit_id`", examples=[1]
    )

    @property
    def width(self) -> int:
        return BITS[self.type] // 16

    def is_open(self, number: float) -> bool:
        """Return whether a number as read says that there is no sensor; 64537 and -999 are one 16-bit register."""
        signs: Sequence[float] = getattr(self, "open")  # noqa: B009 - the field is that of the subclass
        if self.type == "float32":
            return any(abs(number - sign) <= 1e-6 * max(1.0, abs(sign)) for sign in signs)
        modulus = 1 << BITS[self.type]
        return any((number - sign) % modulus == 0 for sign in signs)


class ModbusSensorConfig(ModbusRegister, SourceSensorConfig):
    """One sensor in one or two registers of a box."""

    @property
    def step_k(self) -> float:
        """Step in which it counts [K]; 0 where the register holds fractions."""
        of_register = 0.0 if self.type == "float32" else abs(self.value(1.0) - self.value(0.0))
        return max(of_register, super().step_k)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusRequest:
    """One read of successive registers."""

    unit_id: int
    table: Table
    start: int
    count: int
    inputs: tuple[int, ...]
    """Places in the section's list of the inputs whose registers it holds whole."""

    def __str__(self) -> str:
        last = self.start + self.count - 1
        registers = f"register {self.start}" if self.count == 1 else f"registers {self.start}-{last}"
        return f"unit {self.unit_id}, {self.table} {registers}"


class ModbusWire(SourceConnection):
    """Boxes that answer Modbus, over TCP or on a serial line."""

    driver: ClassVar[str] = "modbus"

    host: Host | None = Field(None, description="name or address of the box or gateway", examples=["192.168.10.30"])
    port: int = Field(502, ge=1, le=65535, description="its TCP port")
    framing: Literal["tcp", "rtu"] = Field(
        "tcp", description="rtu where a serial device server passes the bytes of its line on; only with `host`"
    )
    serial_port: str | None = Field(
        None,
        min_length=1,
        description="serial port of Modbus RTU instead of `host`; prefer /dev/serial/by-id/... or by-path",
        examples=["/dev/serial/by-id/usb-FTDI_FT232R_A5069RR4-if00-port0"],
    )
    baud: int = Field(9600, gt=0, description="baud rate of the serial port [1/s]")
    parity: Literal["none", "even", "odd"] = Field("none", description="parity of the serial port")
    stop_bits: Literal[1, 2] = Field(1, description="stop bits of the serial port")
    unit_id: int = Field(1, ge=0, le=255, description="unit (slave address) of the box")
    timeout_s: Seconds = Field(
        1.0, description="an answer that takes longer is not waited for [s of this computer's clock]"
    )
    gap: int = Field(
        0, ge=0, le=MOST_REGISTERS, description="so many registers that nobody asked for may be read along"
    )
    most_registers: int = Field(
        MOST_REGISTERS, ge=2, le=MOST_REGISTERS, description="the box answers at most so many registers at once"
    )

    @checked
    def _consistent(self) -> Problems:
        if (self.host is None) == (self.serial_port is None):
            yield ("host",), "give either `host` (Modbus TCP) or `serial_port` (Modbus RTU)"
        if self.framing == "rtu" and self.host is None:
            yield ("framing",), "a serial port always has Modbus RTU; leave `framing` out"
        yield from self._registers_read_twice()

    def _registers_read_twice(self) -> Problems:
        taken: dict[tuple[int, str, int], int] = {}
        for index, each in enumerate(self.registers):
            if each.address + each.width > LAST_ADDRESS + 1:
                yield (self.listed, index, "address"), f"{each.type} takes two registers; the last register is 65535"
            for address in range(each.address, each.address + each.width):
                key = (self.unit_of(each), each.table, address)
                if (other := taken.setdefault(key, index)) != index:
                    owner = f"{self.listed[:-1]} {self.registers[other].key}"
                    sentence = f"{each.table} register {address} of unit {key[0]} belongs to {owner} already"
                    yield (self.listed, index, "address"), sentence

    @checked
    def _alike(self) -> Problems:
        """Yield which requests have answers that a serial line cannot tell apart."""
        if not self.is_rtu:
            return
        seen: dict[tuple[int, str, int], ModbusRequest] = {}
        for request in self.requests:
            other = seen.setdefault((request.unit_id, request.table, request.count), request)
            if other is not request:
                sentence = (
                    f"{request} and {other} have answers of one length, which Modbus RTU cannot tell apart: "
                    f"set `gap` to {self.gap + 1} or more, so that one of them reads a register more"
                )
                yield (self.listed, request.inputs[0], "address"), sentence

    @property
    def is_rtu(self) -> bool:
        """Whether answers carry no number."""
        return self.serial_port is not None or self.framing == "rtu"

    @property
    def registers(self) -> Sequence[ModbusRegister]:
        """Its inputs, in the order of the section."""
        return self.every_input

    @property
    def exclusive(self) -> tuple[str, str] | None:
        """The serial port."""
        return None if self.serial_port is None else ("serial_port", self.serial_port)

    @property
    def exposed(self) -> str:
        """What Modbus over a network cannot keep out."""
        if self.serial_port is not None:
            return ""
        return "NOT encrypted: whoever is on its network can answer in the box's place, so give it a wire of its own"

    @property
    def place(self) -> str:
        """Where the boxes are, for a sentence."""
        return f"port {self.serial_port}" if self.serial_port is not None else f"{self.host}:{self.port}"

    def unit_of(self, sensor: ModbusRegister) -> int:
        """Return the unit of a sensor's box."""
        return self.unit_id if sensor.unit_id is None else sensor.unit_id

    @cached_property
    def requests(self) -> tuple[ModbusRequest, ...]:
        """The reads that bring all inputs."""
        found: list[ModbusRequest] = []
        all_of = self.registers
        for unit_id, table in dict.fromkeys((self.unit_of(each), each.table) for each in all_of):
            places = [
                place for place, each in enumerate(all_of) if (self.unit_of(each), each.table) == (unit_id, table)
            ]
            spans = sorted((all_of[p].address, all_of[p].address + all_of[p].width) for p in places)
            groups = grouped(spans, self.gap, self.most_registers)
            for first, after in (
                told_apart(groups, self.gap, self.most_registers) if self.is_rtu else map(_whole, groups)
            ):
                inside = tuple(
                    p for p in places if first <= all_of[p].address and all_of[p].address + all_of[p].width <= after
                )
                found.append(
                    ModbusRequest(unit_id=unit_id, table=table, start=first, count=after - first, inputs=inside)
                )
        return tuple(found)


class ModbusConfig(ModbusWire):
    """Boxes whose registers hold temperatures."""

    sensors: list[ModbusSensorConfig] = Field(
        min_length=1,
        description="the sensors and their registers",
        examples=[
            [
                {"id": 401, "component": "Spindle unit", "label": "Housing", "scale": 0.1, "open": [-999]},
                {"id": 402, "component": "Column", "address": 1, "scale": 0.1, "open": [-999]},
            ]
        ],
    )


def grouped(spans: Sequence[Span], gap: int, most: int) -> list[list[Span]]:
    """Return ascending spans in groups that one request reads: with gaps up to `gap`, at most `most` registers."""
    groups: list[list[Span]] = []
    for first, after in spans:
        if groups and first - groups[-1][-1][1] <= gap and after - groups[-1][0][0] <= most:
            groups[-1].append((first, after))
        else:
            groups.append([(first, after)])
    return groups


def told_apart(groups: Sequence[Sequence[Span]], gap: int, most: int) -> list[Span]:
    """Return the reads of these groups, each of another length as far as that is possible.

    A group whose length is taken is read with up to `gap` registers more, or in two parts.
    """
    used: set[int] = set()
    reads: list[Span] = []
    for group in sorted(groups, key=lambda group: (_whole(group)[1] - _whole(group)[0], group[0])):
        parts = next(
            (parts for parts in _ways(group, gap) if _fits([after - first for first, after in parts], used, most)),
            (_whole(group),),
        )
        used.update(after - first for first, after in parts)
        reads += parts
    return sorted(reads)


def _whole(group: Sequence[Span]) -> Span:
    return group[0][0], group[-1][1]


def _ways(group: Sequence[Span], gap: int) -> Iterator[tuple[Span, ...]]:
    first, after = _whole(group)
    for more in range(gap + 1):
        if after + more <= LAST_ADDRESS + 1:
            yield ((first, after + more),)
        if first - more >= 0:
            yield ((first - more, after),)
    for cut in range(1, len(group)):
        yield _whole(group[:cut]), _whole(group[cut:])


def _fits(lengths: Sequence[int], used: set[int], most: int) -> bool:
    return len(set(lengths)) == len(lengths) and not used & set(lengths) and max(lengths) <= most
