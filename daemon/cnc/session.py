"""One connected CNC: writing the block, reading it back, and knowing what is ours.

Owned by the control task alone; it serialises every call to the CNC.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from daemon.cnc.macro_block import ECHO_SLACK_UM, LAST_SEQUENCE, Echo, MacroBlock
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.history.writer import HistoryWriter
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import Cnc, FatalDriverError
from models.control.state import OutputLimits
from models.records import (
    CncSample,
    CompensationCommand,
    FloatArray,
    Receipt,
    Trace,
    WriteOutcome,
)


class CncSession:
    """The macro block of one CNC, from connect to loss of the link."""

    def __init__(
        self,
        cnc: Cnc,
        block: MacroBlock,
        clock: Clock,
        history: HistoryWriter,
        telemetry: Telemetry,
        limits: OutputLimits,
        known: dict[int, tuple[float, ...]] | None,
        last_block: WriteAheadRecord,
    ) -> None:
        self.cnc = cnc
        self._block = block
        self._clock = clock
        self._history = history
        self._telemetry = telemetry
        self._limits = limits
        self._acceptable = None if known is None else {n: v for n, v in known.items() if n in block.ours}
        self._last_block = last_block
        self._sequence = 0
        self._enabled = False
        self._seen: Mapping[int, float | None] = {}
        self._after_expiry = block.expires_to_zero
        """The guard may have taken an expired block's offset out and not yet put it back; nobody knows at the start."""
        self.sample: CncSample | None = None
        self.echo: Echo | None = None
        self.last_write_s = -np.inf
        self.last_command: CompensationCommand | None = None
        self.last_write_id: int | None = None
        """Number of the latest write of the block in the audit."""

    @property
    def known(self) -> dict[int, tuple[float, ...]] | None:
        """What our macros may hold: what was written, and what a lost write may have left."""
        return self._acceptable

    @property
    def enabled(self) -> bool:
        """The CNC held an enable bit at the latest poll or read-back."""
        return self._enabled

    @property
    def expired(self) -> bool:
        """The guard would call the block expired as the latest poll showed it: power-off clears valid_until."""
        return self.sample is not None and self._block.expired(self._seen, self.sample.clock_s)

    @property
    def written_um(self) -> FloatArray:
        """What the block holds per axis as it was last seen [um], NaN where it is vacant or unknown."""
        return self._block.values_um(self._seen)

    async def poll(self) -> list[str]:
        """Read state, block and echo; return what is vacant or foreign among our macros."""
        sample = await self.cnc.read(self._block.polled)
        self.sample = sample
        self.echo = self._block.echo(sample.macros)
        self._enabled = self._block.enabled(sample.macros)
        self._seen = sample.macros
        self._sequence = self._sequence or self._block.sequence(sample.macros)
        if self._acceptable is None:
            return self._adopt(sample)
        problems = self._block.differences(self._acceptable, sample.macros)
        if not problems:
            self._narrow(sample.macros)
        return problems + self._implausible_echo(sample.macros, sample.clock_s)

    def acknowledge(self) -> list[str]:
        """Take what the CNC holds now as known: a person has acknowledged. Return what is vacant and stays a fault."""
        if not self._seen:
            return []
        found = {number: self._seen.get(number) for number in self._block.ours}
        self._acceptable = {number: () if value is None else (value,) for number, value in found.items()}
        bound = replace(self._limits, step_um=np.full(len(self._limits.axes), np.inf))
        return self._block.vacant(found) + self._block.implausible_echo(self._seen, bound)

    def _narrow(self, found: Mapping[int, float | None]) -> None:
        ours = {number: found.get(number) for number in self._block.ours}
        self._acceptable = {number: (value,) for number, value in ours.items() if value is not None}

    def _adopt(self, sample: CncSample) -> list[str]:
        """Take over a block that nobody here has written: only a whole, disabled one."""
        found = {number: sample.macros.get(number) for number in self._block.ours}
        problems = self._block.vacant(found)
        if self._block.enabled(sample.macros):
            problems.append("enable bits are set in the CNC, and this daemon has no record of having set them")
        if not problems:
            self._narrow(sample.macros)
        return problems + self._implausible_echo(sample.macros, sample.clock_s)

    def _implausible_echo(self, found: Mapping[int, float | None], clock_s: float) -> list[str]:
        """Return what the guard cannot have applied; between two steps of a way back after an expiry it may lag."""
        lagging = self._block.implausible_echo(found, self._limits)
        vacant = bool(np.isnan(self._block.echo(found).applied_um).any())
        expired = self._block.expires_to_zero and self._block.expired(found, clock_s)
        self._after_expiry = expired or (self._after_expiry and (bool(lagging) or vacant))
        return self._block.implausible_echo(found, self._limits, after_expiry=True) if self._after_expiry else lagging

    async def write(self, command: CompensationCommand, *, validity_s: float, trace: Trace, cause: str) -> Receipt:
        """Write the block first to last, read it back, and leave intent and outcome in the audit."""
        assert self.sample is not None
        now = self._clock.now()
        clock_s = self.sample.clock_s + (now.monotonic_s - self.sample.time.monotonic_s)
        self._after_expiry |= self._block.expires_to_zero and self._block.expired(self._seen, clock_s)
        self._sequence = self._sequence % LAST_SEQUENCE + 1
        stopped = not any(command.enable)
        valid_until_s = 0.0 if stopped else clock_s + validity_s
        if np.any(np.abs(command.compensation_um) > self._limits.absolute_bound_um + ECHO_SLACK_UM):
            raise FatalDriverError(f"{command.compensation_um} um is outside the absolute bound; nothing was sent")
        groups = self._block.encode(command, sequence=self._sequence, valid_until_s=valid_until_s)
        macros = tuple(pair for group in groups for pair in group)
        intent = self._history.write_intent(command, macros, cause)
        self.last_write_id = int(intent)
        self._expect_old_or_new(macros)
        self._last_block.keep(self._acceptable or {})
        try:
            await self.cnc.write_macros(groups)
            trace = replace(trace, written=self._clock.now())
            found = await self.cnc.read_macros(self._block.read_back)
            trace = replace(trace, read_back=self._clock.now())
        except Exception as error:
            refused = isinstance(error, FatalDriverError)
            outcome = WriteOutcome.REFUSED if refused else WriteOutcome.FAILED
            self._conclude(intent, macros, outcome, str(error), {}, trace)
            raise
        self._acceptable = {number: (value,) for number, value in macros}
        problems = self._block.differences(self._acceptable, found)
        problems += self._implausible_echo(found, clock_s)
        self.echo = self._block.echo(found)
        self._enabled = self._block.enabled(found)
        self._seen = found
        self.last_write_s = now.monotonic_s
        self.last_command = command
        outcome = WriteOutcome.DIFFERS if problems else WriteOutcome.VERIFIED
        return self._conclude(intent, macros, outcome, "; ".join(problems), found, trace)

    async def write_one(self, number: int, value: float, *, cause: str, trace: Trace | None = None) -> Receipt:
        """Write one macro that is not of the block, read it back, and leave intent and outcome in the audit."""
        return await self.write_apart((((number, value),),), cause=cause, trace=trace)

    async def write_apart(
        self, groups: tuple[tuple[tuple[int, float], ...], ...], *, cause: str, trace: Trace | None = None
    ) -> Receipt:
        """Write macros that are not of the block, group after group, with read-back and audit as for the block."""
        now = self._clock.now()
        trace = trace or Trace(first_byte=now, last_byte=now)
        macros = tuple(pair for group in groups for pair in group)
        intent = self._history.write_intent(None, macros, cause)
        try:
            await self.cnc.write_macros(groups)
            trace = replace(trace, written=self._clock.now())
            found = await self.cnc.read_macros(tuple(number for number, _ in macros))
            trace = replace(trace, read_back=self._clock.now())
        except Exception as error:
            refused = isinstance(error, FatalDriverError)
            outcome = WriteOutcome.REFUSED if refused else WriteOutcome.FAILED
            self._conclude(intent, macros, outcome, str(error), {}, trace)
            raise
        problems = self._block.differences({number: (value,) for number, value in macros}, found)
        outcome = WriteOutcome.DIFFERS if problems else WriteOutcome.VERIFIED
        return self._conclude(intent, macros, outcome, "; ".join(problems), found, trace)

    def _expect_old_or_new(self, macros: Sequence[tuple[int, float]]) -> None:
        before = self._acceptable or {}
        self._acceptable = {number: (*before.get(number, ()), value) for number, value in macros}

    def _conclude(
        self,
        intent: int,
        macros: tuple[tuple[int, float], ...],
        outcome: WriteOutcome,
        detail: str,
        found: Mapping[int, float | None],
        trace: Trace,
    ) -> Receipt:
        echo = self._block.echo(found)
        receipt = Receipt(
            sequence=self._sequence,
            macros=macros,
            outcome=outcome,
            detail=detail,
            read_back=tuple(found.get(number) for number, _ in macros),
            applied_um=echo.applied_um,
            trace=trace,
        )
        self._history.write_outcome(intent, receipt)
        self._telemetry.write(receipt)
        return receipt
