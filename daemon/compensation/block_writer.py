"""Decides when the block is written, and finds out when the guard has applied the value that a cycle led to."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from daemon.cnc.events import Journal
from daemon.cnc.macro_block import Echo
from daemon.cnc.session import CncSession
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import DriverError, FatalDriverError
from models.records import (
    CompensationCommand,
    FloatArray,
    Instant,
    OutputState,
    Receipt,
    ThermalErrorEstimate,
    Trace,
    WriteOutcome,
)

APPLIED_STATUS = 0
"""Status of a guard that took the block over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Awaited:
    """The newest estimate's write, and what the block holds because of it."""

    line: str
    trace: Trace
    write_id: int | None
    """Number of the estimate's write in the audit."""
    value_um: FloatArray
    enabled: tuple[bool, ...]
    guard_time_s: float | None
    """When the guard had last run, as read back with the write [s of the CNC's clock]."""


class EchoWatch:
    """Waits for the echo of the newest estimate's write.

    It is there at the first poll in which the guard has run since the read-back (the time in its echo has changed),
    applied (status 0), and every enabled axis stands at the value of the block. A tick that carries the same request
    further only moves that value; a newer estimate with another one supersedes it, which is counted apart.
    """

    def __init__(
        self,
        telemetry: Telemetry,
        slack_um: FloatArray,
        record: Callable[[int, Trace], object] = lambda _write_id, _trace: None,
    ) -> None:
        """`record` takes the number of a write in the audit, and the trace of the cycle behind it."""
        self._telemetry = telemetry
        self._record = record
        self._slack_um = slack_um
        self._awaited: _Awaited | None = None

    def wrote(
        self,
        trace: Trace,
        command: CompensationCommand,
        echo: Echo | None,
        line: str | None,
        write_id: int | None = None,
    ) -> None:
        """Note a verified write with the echo in its read-back; `line` is that of its estimate, None for a tick."""
        before = self._awaited
        if not any(command.enable):
            self._drop()
            return
        if before and before.enabled == command.enable and np.array_equal(before.value_um, command.compensation_um):
            return
        if line is not None:
            self._drop()
        elif before is not None:
            line, trace, write_id = before.line, before.trace, before.write_id
        else:
            return
        self._awaited = _Awaited(
            line=line,
            trace=trace,
            write_id=write_id,
            value_um=command.compensation_um,
            enabled=command.enable,
            guard_time_s=None if echo is None else echo.time_s,
        )

    def seen(self, echo: Echo | None, time: Instant) -> None:
        """Take what a poll shows: perhaps the guard has applied in full what is awaited."""
        awaited = self._awaited
        if awaited is None or echo is None or echo.status != APPLIED_STATUS or echo.time_s == awaited.guard_time_s:
            return
        there = np.abs(echo.applied_um - awaited.value_um) <= self._slack_um
        if there[np.array(awaited.enabled, dtype=bool)].all():
            self._awaited = None
            trace = replace(awaited.trace, echoed=time)
            self._telemetry.echoed(awaited.line, trace)
            if awaited.write_id is not None:
                self._record(awaited.write_id, trace)

    def _drop(self) -> None:
        if self._awaited is not None:
            self._telemetry.superseded()
        self._awaited = None


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

    def unwritten(self, session: CncSession) -> bool:
        """Tell whether the guard may still apply what another run of the daemon has left in the block."""
        return session.enabled and not self.counts["sent"]

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
