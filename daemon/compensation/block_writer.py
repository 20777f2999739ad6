"""Decides when the block is written, and handles the outcome."""

from collections.abc import Callable

import numpy as np

from daemon.cnc.events import Journal
from daemon.cnc.session import CncSession
from daemon.compensation.applied_tracker import EchoWatch
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import DriverError, FatalDriverError
from models.records import CompensationCommand, OutputState, Receipt, ThermalErrorEstimate, Trace, WriteOutcome


class BlockWriter:
    """Writes what is due and turns a refusal or a differing read-back into a FAULT; owned by the control task."""

    def __init__(
        self, clock: Clock, telemetry: Telemetry, journal: Journal, echo_watch: EchoWatch, validity_s: float
    ) -> None:
        self._clock = clock
        self._telemetry = telemetry
        self._journal = journal
        self._echo_watch = echo_watch
        self._validity_s = validity_s
        self.receipt: Receipt | None = None
        self.counts = {"sent": 0, "verified": 0, "refused": 0}
        self.axes: set[str] = set()
        """Axes that were ever written with their enable bit set."""

    async def look_ahead(self, session: CncSession | None, command: CompensationCommand | None) -> None:
        """Read what stands in the block while the estimate that will be written is made: the two take as long."""
        if session is not None and command is not None and command.write and command.state is not OutputState.OFF:
            await session.look_ahead()

    async def write_and_settle(
        self,
        session: CncSession | None,
        command: CompensationCommand,
        estimate: ThermalErrorEstimate | None,
        settle: Callable[[str | None], None],
    ) -> None:
        """Write what is due, then settle with the fault that it ended in; a lost link is none: all may have arrived."""
        fault: str | None = "a defect in the write, see the log"
        try:
            if session is not None and command.write:
                await self.write_when_due(session, command, estimate)
            fault = self._journal.fault
        except DriverError:
            fault = None
            raise
        finally:
            settle(fault)

    async def write_when_due(
        self, session: CncSession, command: CompensationCommand, estimate: ThermalErrorEstimate | None
    ) -> None:
        """Write the block when its content changed, an estimate asks for it, or its validity runs out."""
        if not self._due(session, command, estimate):
            return
        now = self._clock.now()
        trace = estimate.trace if estimate is not None else Trace(first_byte=now, last_byte=now)
        cause = "estimate" if estimate is not None else "tick"
        try:
            receipt = await session.write(command, validity_s=self._validity_s, trace=trace, cause=cause)
        except FatalDriverError as error:
            self.counts["refused"] += 1
            self._journal.raise_fault(f"a write was refused: {error}")
            return
        finally:
            self.counts["sent"] += 1
        self.receipt = receipt
        if receipt.outcome is not WriteOutcome.VERIFIED:
            self._journal.raise_fault(f"read-back differs: {receipt.detail}")
            return
        self.counts["verified"] += 1
        self.axes |= {axis for axis, on in zip(command.axes, command.enable, strict=True) if on}
        line = estimate.line if estimate is not None else None
        self._echo_watch.wrote(receipt.trace, command, session.echo, line, session.last_write_id)
        if line is not None:
            self._telemetry.stages(line, receipt.trace)

    def _due(self, session: CncSession, command: CompensationCommand, estimate: ThermalErrorEstimate | None) -> bool:
        last = session.last_command
        changed = (
            last is None
            or last.enable != command.enable
            or not np.array_equal(last.compensation_um, command.compensation_um)
        )
        if command.state is OutputState.OFF:
            return session.enabled or (changed and last is not None)
        if estimate is not None or changed or session.expired:
            return True
        return self._clock.now().monotonic_s - session.last_write_s > self._validity_s / 3
