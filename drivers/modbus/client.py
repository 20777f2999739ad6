"""One connection to Modbus boxes, and one read at a time over it. What does not fit the read ends the connection.

pymodbus looks at neither function nor length of an answer, takes transaction number 0 for any request, and on a serial
line a late answer for the next one: all of that is judged here.
"""

import asyncio
import contextlib
import logging
import random
import termios
from pathlib import Path
from typing import Any, ClassVar

from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerType
from pymodbus.pdu import ModbusPDU

from config.schema.modbus import ModbusRequest, ModbusWire
from drivers.contract import LinkError

FUNCTIONS = {"holding": 3, "input": 4}
QUIET_S = 0.05
"""A serial line that has been silent for so long has no answer under way [s]; at least 3.5 characters."""
BITS_PER_CHARACTER = 11
REFUSALS = {
    1: "it does not know this function: try the other `table`",
    2: "it has no such register: check `address`, `table` and `gap`",
    3: "it does not answer so many registers: lower `most_registers`",
    4: "its own error",
    6: "it is busy",
    10: "its gateway has no way to the unit: check `unit_id`",
    11: "the unit does not answer its gateway: check `unit_id`, power and wires of the box",
}
"""Exception codes of Modbus in words."""

# The library writes a line for every frame that it drops; what matters is raised here.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)


class RefusedRead(Exception):
    """The box answered that it will not; the text is fit for an operator."""


class UnreadableError(Exception):
    """An answer is none of this protocol."""


class EndedError(LinkError):
    """A connection that had answered has been ended, as boxes do that are not asked for a while."""


class ModbusClient:
    """One connection, built anew for every attempt.

    Transaction numbers go on over all connections: the library would begin with 1 each time, and an answer of an older
    connection, which a gateway may still hold, would have the number of a request of this one.
    """

    last_number: ClassVar[int] = random.randrange(60000)

    def __init__(self, config: ModbusWire, owner: str) -> None:
        self._config = config
        self._where = f"{owner}: {config.place}"
        self._sent_number = 0
        self._heard_s = 0.0
        self._closed = False
        self._reading = self._answered = self._ended = False
        self._sent = b""
        """The request of which an adapter may bring the echo before the answer."""
        self._client = self._built()
        self._of_library = self._client.ctx.callback_data
        self._client.ctx.callback_data = self._taken  # type: ignore[method-assign]

    def _built(self) -> AsyncModbusTcpClient | AsyncModbusSerialClient:
        config, parity = self._config, self._config.parity[0].upper()
        common = {
            "retries": 0,
            "reconnect_delay": 0,
            "timeout": config.timeout_s,
            "trace_pdu": self._on_pdu,
            "trace_packet": self._on_packet,
            "trace_connect": self._on_connect,
        }
        if config.serial_port is not None:
            return AsyncModbusSerialClient(
                config.serial_port,
                framer=FramerType.RTU,
                baudrate=config.baud,
                parity=parity,
                stopbits=config.stop_bits,
                **common,  # type: ignore[arg-type]
            )
        framer = FramerType.RTU if config.framing == "rtu" else FramerType.SOCKET
        return AsyncModbusTcpClient(str(config.host), port=config.port, framer=framer, **common)  # type: ignore[arg-type]

    def _on_pdu(self, sending: bool, pdu: ModbusPDU) -> ModbusPDU:
        if sending:
            self._sent_number = pdu.transaction_id
            ModbusClient.last_number = self._sent_number or ModbusClient.last_number
        return pdu

    def _on_packet(self, sending: bool, packet: bytes) -> bytes:
        if sending:
            self._sent = packet if self._config.is_rtu else b""
        else:
            self._heard_s = asyncio.get_running_loop().time()
        return packet

    def _on_connect(self, connected: bool) -> None:
        if not connected:
            self._ended = True
            if self._reading:
                self._end_read(EndedError())

    def _end_read(self, error: Exception) -> None:
        if not self._client.ctx.response_future.done():
            self._client.ctx.response_future.set_exception(error)

    def _taken(self, data: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Return how many bytes were taken; an answer that cannot be decoded ends the read: it would be logged.

        An echo is passed over: a request has eight bytes, and an answer, whatever it holds, an odd number of them.
        """
        if self._sent.startswith(data):
            return 0
        echo, self._sent = self._sent, b""
        if echo and data.startswith(echo):
            rest = data[len(echo) :]
            return len(echo) + (self._taken(rest, addr) if rest else 0)
        try:
            return self._of_library(data, addr)
        except ModbusException:
            self._end_read(UnreadableError())
            return len(data)

    async def connect(self) -> None:
        """Connect, and on a serial line wait until nothing is under way on it; raises LinkError."""
        try:
            async with asyncio.timeout(self._config.timeout_s):
                connected = await self._client.connect()
        except (TimeoutError, OSError, ModbusException, UnicodeError):  # the last of a host's name that is none
            connected = False
        except termios.error as error:  # which is no OSError
            raise LinkError(
                f"{self._where} does not take its settings ({error.args[-1]}): correct `baud`, `parity` and "
                "`stop_bits`, or plug the adapter in anew"
            ) from error
        if self._closed:  # meanwhile, and the library would keep what it has opened since
            self._drop()
            raise LinkError(f"{self._where} was closed while it was being connected")
        if not connected:
            raise LinkError(f"{self._where} {self._why_not_connected()}")
        if self._config.is_rtu:
            await self._drain()
        else:
            self._client.ctx.next_tid = ModbusClient.last_number

    async def _drain(self) -> None:
        """Let what is still on the line arrive and be dropped; raises LinkError when it does not end."""
        loop = asyncio.get_running_loop()
        quiet_s = max(QUIET_S, 3.5 * BITS_PER_CHARACTER / self._config.baud)
        self._heard_s = loop.time()
        until_s = loop.time() + self._config.timeout_s + 2 * quiet_s
        while (left_s := self._heard_s + quiet_s - loop.time()) > 0:
            if loop.time() > until_s:
                raise LinkError(
                    f"{self._where} brings bytes that nobody asked for: is there another master on the bus, or another "
                    "program at the port? The daemon must be the only one"
                )
            await asyncio.sleep(left_s)

    def _why_not_connected(self) -> str:
        port = self._config.serial_port
        if port is None:
            return (
                f"cannot be reached within {self._config.timeout_s:g} s: check address, port, cable and power, and "
                "whether another program holds its only connection"
            )
        if not Path(port).exists():
            return "does not exist: plug the adapter in, and name it by /dev/serial/by-id/... or by-path"
        return (
            "cannot be opened: another program may hold it (`fuser` names it), or the daemon's account may not "
            "(on most systems the group dialout may)"
        )

    async def read(self, request: ModbusRequest) -> list[int]:
        """Return the registers of a request; raises RefusedRead when the box says no, EndedError, LinkError.

        After a LinkError the connection must be closed, because what comes later on it belongs to nobody.
        """
        ask = self._client.read_holding_registers if request.table == "holding" else self._client.read_input_registers
        self._reading = True
        try:
            if self._ended:
                raise EndedError
            async with asyncio.timeout(2 * self._config.timeout_s):
                answer = await ask(request.start, count=request.count, device_id=request.unit_id)
        except EndedError as error:
            words = f"{self._where}: {request}: it ended the connection: see whether it serves another client"
            raise (EndedError if self._answered else LinkError)(words) from error
        except UnreadableError as error:
            raise self._dropped(request, "the answer cannot be read") from error
        except (TimeoutError, ModbusException, OSError) as error:
            raise LinkError(self._no_answer(request)) from error
        finally:
            self._reading = False
        if (mismatch := self._foreign(request, answer)) != "":
            raise LinkError(f"{self._where}: {request}: {mismatch}; it is dropped and the connection built anew")
        self._answered = True
        if answer.isError():
            code = int(getattr(answer, "exception_code", 0))
            raise RefusedRead(f"{request}: the box refuses: {REFUSALS.get(code, 'for its own reason')} (code {code})")
        return list(answer.registers)

    def _dropped(self, request: ModbusRequest, why: str) -> LinkError:
        return LinkError(f"{self._where}: {request}: {why}; it is dropped and the connection built anew")

    def _no_answer(self, request: ModbusRequest) -> str:
        serial = ", baud and parity" if self._config.is_rtu else ""
        return (
            f"{self._where}: {request}: no answer within {self._config.timeout_s:g} s: "
            f"check `unit_id`{serial}, wires and power of the box; raise `timeout_s` where it is slow"
        )

    def _foreign(self, request: ModbusRequest, answer: ModbusPDU) -> str:
        """Return why an answer is not that of a request, '' when it is."""
        function = FUNCTIONS[request.table]
        if answer.dev_id != request.unit_id:
            return f"the answer is unit {answer.dev_id}'s"
        if not self._config.is_rtu and answer.transaction_id != self._sent_number:
            return f"the answer has the number {answer.transaction_id}, the request {self._sent_number}"
        if answer.function_code & 0x7F != function:
            return f"the answer is to function {answer.function_code & 0x7F}, the request {function}"
        if not answer.isError() and len(answer.registers) != request.count:
            return f"the answer holds {len(answer.registers)} registers"
        return ""

    def close(self) -> None:
        """Close. May be called in any state, more than once; never raises."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        with contextlib.suppress(Exception):
            self._client.ctx.is_closing = False  # once closed it would not close what it opened after that
            self._client.close()
