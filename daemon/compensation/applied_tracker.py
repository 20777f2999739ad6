"""Finds out when the guard has applied the value that a cycle led to.

A value counts as echoed at the first poll that shows three things: the guard has run since the
value was read back (the time in its echo has changed), it applied (status 0), and every enabled
axis stands at the value of the block, not on a step towards it. As long as no newer estimate asks for
something else, a tick that carries the same request further (slew rate) only moves the value that
is looked for. A newer estimate with another value supersedes the older one, whose value the guard
then never shows; that is counted apart. The instant is the poll's, so it is late by up to a poll.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from daemon.cnc.macro_block import ECHO_SLACK_UM, Echo
from daemon.telemetry.metrics import Telemetry
from models.records import CompensationCommand, FloatArray, Instant, Trace

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
    """Waits for the echo of the newest estimate's write."""

    def __init__(
        self,
        telemetry: Telemetry,
        slack_um: float = ECHO_SLACK_UM,
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
        awaited = self._awaited
        if not any(command.enable):
            self._drop()
            return
        if awaited is not None and self._holds(awaited, command):
            return
        if line is not None:
            self._drop()
        elif awaited is not None:
            line, trace, write_id = awaited.line, awaited.trace, awaited.write_id
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
        distance_um = np.abs(echo.applied_um - awaited.value_um)[np.array(awaited.enabled, dtype=bool)]
        if np.all(distance_um <= self._slack_um):
            self._awaited = None
            trace = replace(awaited.trace, echoed=time)
            self._telemetry.echoed(awaited.line, trace)
            if awaited.write_id is not None:
                self._record(awaited.write_id, trace)

    def _drop(self) -> None:
        if self._awaited is not None:
            self._telemetry.superseded()
        self._awaited = None

    @staticmethod
    def _holds(awaited: _Awaited, command: CompensationCommand) -> bool:
        return awaited.enabled == command.enable and bool(np.array_equal(awaited.value_um, command.compensation_um))
