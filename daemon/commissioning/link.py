"""The connection of a commissioning: a look at the macro variables, and zeros into those that are vacant or foreign."""

from collections.abc import Callable

from config.schema import Configuration
from daemon.cnc.audited_write import AuditedWriter, AuditError, ForeignValueError, MacroWrite
from daemon.cnc.macro_block import MacroBlock
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.commissioning.initialising import (
    BlockFound,
    CommissioningRefusedError,
    find_block,
    ours_to_initialise,
    zero_groups,
)
from daemon.history.writer import HistoryWriter
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import Cnc, LinkError, Security
from models.records import CncSample, Trace, WriteOutcome

COMMIT_S = 10.0
"""The audit takes the intent within this, or nothing is written [s of the wall clock]."""


class CommissioningLink:
    """One control, connected anew as often as needed, with the audit of what is written to it."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        open_cnc: Callable[[], Cnc],
        history: HistoryWriter,
        last_block: WriteAheadRecord,
    ) -> None:
        self.clock, self.history, self.last_block = clock, history, last_block
        self._open_cnc = open_cnc
        self._telemetry = Telemetry()
        self._macros = configuration.cnc.macros
        self._speed = configuration.spindle_speed.macros if configuration.spindle_speed is not None else None
        axes = tuple(configuration.compensation.axes)
        self.block = MacroBlock(
            self._macros,
            axes,
            {},
            guard=configuration.cnc.guard,
            pivots_mm=configuration.compensation.pivots_mm,
        )
        self._cnc: Cnc | None = None
        self.identity = ""
        self.security: Security = "insecure"

    async def connect(self) -> None:
        """Connect anew; raises DriverError."""
        await self.close()
        cnc = self._cnc = self._open_cnc()
        await cnc.connect()
        self.identity, self.security = cnc.identity, cnc.security

    async def close(self) -> None:
        """Close the connection; never raises."""
        cnc, self._cnc = self._cnc, None
        if cnc is not None:
            await cnc.close()

    def _connected(self) -> Cnc:
        if self._cnc is None:
            raise LinkError("there is no connection to the CNC")
        return self._cnc

    def writer(self) -> AuditedWriter:
        return AuditedWriter(self._connected(), self.block, self.clock, self.history, self._telemetry)

    async def look(self) -> CncSample:
        """Read state and block once, before there is a heartbeat."""
        numbers = dict.fromkeys((*self.block.polled, *ours_to_initialise(self._macros, self.block, self._speed)))
        return await self._connected().read(tuple(numbers))

    async def read(self, numbers: tuple[int, ...]) -> dict[int, float | None]:
        """Read other macro variables once, before there is a heartbeat; raises DriverError."""
        found = await self._connected().read_macros(numbers)
        return {number: found.get(number) for number in numbers}

    def block_found(self, sample: CncSample) -> BlockFound:
        """Sort the variables of the block by what the last write and the audit say they may hold."""
        newest = self.history.last_write_id()
        known, _ = self.last_block.newer_of(self.history.last_written_macros(), newest)
        if self._speed is not None:
            speed = WriteAheadRecord.of_speed(self.history.path)
            audit = self.history.last_written_macros(self._speed.ours)
            known = {**(known or {}), **(speed.newer_of(audit, newest)[0] or {})}
        return find_block(self._macros, self.block, known, sample.macros, self._speed)

    async def initialise(self, numbers: tuple[int, ...], found: BlockFound, person: str) -> None:
        """Set these variables to 0 over what was found in them; the audit has the intent before anything is sent."""
        groups = zero_groups(self._macros, numbers, self._speed)
        pairs = tuple(pair for group in groups for pair in group)
        if not pairs:
            return
        possible = {n: tuple(dict.fromkeys((found.values[n] or 0.0, 0.0))) for n, _ in pairs}
        now, writer = self.clock.now(), self.writer()
        write = MacroWrite(
            groups=groups,
            expected={number: (found.values[number],) for number, _ in pairs},
            cause="commission",
            trace=Trace(first_byte=now, last_byte=now),
            person=person,
            commit_s=COMMIT_S,
            sending=lambda _found: self.last_block.keep(possible, writer.last_write_id),
        )
        try:
            receipt = await writer.write(write)
        except AuditError as error:
            raise CommissioningRefusedError(str(error)) from error
        except ForeignValueError as error:
            raise CommissioningRefusedError(
                f"the variables changed while they were looked at: {error}. Something else writes them; find it"
            ) from error
        if receipt.outcome is not WriteOutcome.VERIFIED:
            raise CommissioningRefusedError(
                f"initialised variables read back differently: {receipt.detail}. Check that nothing else writes them "
                "and that the CNC's user may; nothing has moved"
            )
