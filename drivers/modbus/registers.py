"""Contents of Modbus registers -> numbers. No I/O."""

import struct
from collections.abc import Sequence

from config.schema.modbus import ModbusRegister

_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}


def number_of(registers: Sequence[int], sensor: ModbusRegister) -> float:
    """Return the number that a sensor's registers hold, in the order of their addresses; raises ValueError."""
    if len(registers) != sensor.width or not all(0 <= word <= 0xFFFF for word in registers):
        raise ValueError(f"{sensor.type} takes {sensor.width} registers of 16 bit, not {list(registers)}")
    words = registers if sensor.word_order == "big" else registers[::-1]
    (number,) = struct.unpack(_FORMATS[sensor.type], struct.pack(f">{len(words)}H", *words))
    return float(number)
