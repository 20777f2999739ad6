"""One connected CNC, owned by the control task: what its block holds and the guard applies, and what is ours of it."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from daemon.cnc.audited_write import AuditedWriter, Expected, Groups, MacroValues, MacroWrite
from daemon.cnc.macro_block import ECHO_SLACK_UM, LAST_SEQUENCE, Echo
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.supervisor import LinkHealth
from drivers.contract import Cnc, FatalDriverError, LinkError
from models.control.state import OutputLimits
from models.records import CncSample, CompensationCommand, FloatArray, Receipt, Trace

CLEARED_BY_POWER_OFF = range(100, 200)
"""Macros that may be found vacant although they have been written."""


class CncSession:
    """The macro block of one CNC, from connect to loss of the link."""

    def __init__(
        self,
        writer: AuditedWriter,
        limits: OutputLimits,
        known: dict[int, tuple[float, ...]] | None,
        last_block: WriteAheadRecord,
        *,
        resumed: bool = False,
    ) -> None:
        """`resumed`: `known` is what a previous run of the daemon left, of which a power cut may have lost the end."""
        self.cnc = writer.cnc
        self._writer = writer
        self._block = block = writer.block
        self._clock = writer.clock
        self._limits = limits
        self._acceptable = None if known is None else {n: v for n, v in known.items() if n in block.ours}
        self._apart: dict[int, tuple[float, ...]] = {n: v for n, v in (known or {}).items() if n not in block.ours}
        """What the macros that are written apart from the block may hold."""
        self._last_block = last_block
        self._resumed = resumed
        self._sequence = 0
        self._enabled = False
        self._seen: Mapping[int, float | None] = {}
        self._after_expiry = block.expires_to_zero
        """The guard may have taken an expired block's offset out and not yet put it back; unknown at the start."""
        self.sample: CncSample | None = None
        self.echo: Echo | None = None
        self.last_write_s = -np.inf
        self.last_command: CompensationCommand | None = None
        self.last_write_id: int | None = None
        """Number of the latest write of the block in the audit."""

    @property
    def known(self) -> dict[int, tuple[float, ...]] | None:
        """What our macros may hold: what was written, and what a lost write may have left."""
        return None if self._acceptable is None else {**self._acceptable, **self._apart}

    @property
    def enabled(self) -> bool:
        """The CNC held an enable bit at the latest poll or read-back."""
        return self._enabled

    @property
    def expired(self) -> bool:
        """The guard would call the block expired as the latest poll showed it: power-off clears valid_until."""
        return self.sample is not None and self._block.expired(self._seen, self.sample.clock_s)

    @property
    def withdrawn(self) -> bool:
        """The guard may have taken the offset of an expired block out, and has not put it back."""
        return self._after_expiry

    @property
    def lapsed(self) -> bool:
        """A guard that takes an expired offset out may have begun to since the latest poll."""
        if self.sample is None or not self._block.expires_to_zero:
            return False
        clock_s = self.sample.clock_s + self._clock.now().monotonic_s - self.sample.time.monotonic_s
        return self._block.expired(self._seen, clock_s)

    @property
    def written_um(self) -> FloatArray:
        """What the block holds per axis as it was last seen [um], NaN where it is vacant or unknown."""
        return self._block.values_um(self._seen)

    async def poll(self) -> list[str]:
        """Read state, block and echo; return what is vacant or foreign among our macros."""
        self._writer.forget_look()
        sample = await self.cnc.read(self._block.polled)
        self.sample = sample
        self.echo = self._block.echo(sample.macros)
        self._enabled = self._block.enabled(sample.macros)
        self._seen = sample.macros
        self._sequence = self._sequence or self._block.sequence(sample.macros)
        if self._acceptable is None:
            return self._adopt(sample)
        problems = self._block.differences(self._acceptable, sample.macros)
        if problems and self._resumed and self._block.unrecorded(self._acceptable, sample.macros, self._limits):
            self._writer.note("audit gap", f"a power cut kept the latest write from the disk: {'; '.join(problems)}")
            problems = []
        self._resumed = False
        if not problems:
            self._narrow(sample.macros)
        return problems + self._implausible_echo(sample.macros, sample.clock_s)

    async def look_ahead(self) -> None:
        """Read what stands in the block for a write that is about to be decided on."""
        await self._writer.look_ahead(self._block.ours)

    def acknowledge(self) -> list[str]:
        """Take what the CNC holds now as known: a person has acknowledged. Return what is vacant and stays a fault."""
        if not self._seen:
            return []
        found = {number: self._seen.get(number) for number in self._block.ours}
        self._apart = {}
        self._acceptable = {number: () if value is None else (value,) for number, value in found.items()}
        bound = replace(self._limits, step_um=np.full(len(self._limits.axes), np.inf))
        return self._block.vacant(found) + self._block.implausible_echo(self._seen, bound)

    def _narrow(self, found: Mapping[int, float | None]) -> None:
        ours = {number: found.get(number) for number in self._block.ours}
        self._acceptable = {number: () if value is None else (value,) for number, value in ours.items()}

    def _adopt(self, sample: CncSample) -> list[str]:
        """Take over a block that this daemon has not written: only a whole, disabled one."""
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
        vacant = self.echo is None or bool(np.isnan(self.echo.applied_um).any())
        expired = self._block.expires_to_zero and self._block.expired(found, clock_s)
        self._after_expiry = expired or (self._after_expiry and (bool(lagging) or vacant))
        return self._block.implausible_echo(found, self._limits, after_expiry=True) if self._after_expiry else lagging

    async def write(self, command: CompensationCommand, *, validity_s: float, trace: Trace, cause: str) -> Receipt:
        """Write the block first to last over what is known to stand there, and read it back."""
        if self.sample is None or self._acceptable is None:
            raise FatalDriverError("it is not known what the block holds; nothing was sent")
        now = self._clock.now()
        clock_s = self.sample.clock_s + (now.monotonic_s - self.sample.time.monotonic_s)
        self._sequence = self._sequence % LAST_SEQUENCE + 1
        stopped = not any(command.enable)
        valid_until_s = 0.0 if stopped else clock_s + validity_s
        if np.any(np.abs(command.compensation_um) > self._limits.absolute_bound_um + ECHO_SLACK_UM):
            raise FatalDriverError(f"{command.compensation_um} um is outside the absolute bound; nothing was sent")
        groups = self._block.encode(command, sequence=self._sequence, valid_until_s=valid_until_s)
        macros = tuple(pair for group in groups for pair in group)

        def sending(found: MacroValues) -> None:
            self._after_expiry |= self._block.expires_to_zero and self._block.expired(found, clock_s)
            self._expect_old_or_new(macros)
            self._last_block.keep(self._acceptable or {}, self._writer.last_write_id)

        def judge(found: MacroValues) -> list[str]:
            self._acceptable = {number: (value,) for number, value in macros}
            self._enabled = self._block.enabled(found)
            self._seen = found
            self.echo = self._block.echo(found)
            return self._implausible_echo(found, clock_s)

        receipt = await self._writer.write(
            MacroWrite(
                groups=groups,
                expected=self._acceptable,
                cause=cause,
                trace=trace,
                sequence=self._sequence,
                command=command,
                also_read=self._block.read_back,
                sending=sending,
                kept=True,
                judge=judge,
            )
        )
        self.last_write_id = self._writer.last_write_id
        self.last_write_s = now.monotonic_s
        self.last_command = command
        return receipt

    async def write_one(self, number: int, value: float, *, cause: str, trace: Trace | None = None) -> Receipt:
        """Write one macro that is not of the block; see `write_apart`."""
        return await self.write_apart((((number, value),),), cause=cause, trace=trace)

    async def write_apart(
        self, groups: Groups, *, cause: str, trace: Trace | None = None, expected: Expected | None = None
    ) -> Receipt:
        """Write macros that are not of the block, group after group, compared, read back and audited as the block is.

        `expected` is what may stand there, where the caller keeps account of it. Otherwise that is what was written
        here before; a macro that nobody here has written may hold what the latest poll showed, and where it is not
        polled, anything.
        """
        now = self._clock.now()
        macros = tuple(pair for group in groups for pair in group)
        standing = self._standing(macros) if expected is None else expected

        def sending(_found: MacroValues) -> None:
            if expected is None:
                self._apart |= {
                    number: (*(each for each in standing[number] if each is not None), value)
                    for number, value in macros
                    if number in standing
                }

        receipt = await self._writer.write(
            MacroWrite(
                groups=groups,
                expected=standing,
                cause=cause,
                trace=trace or Trace(first_byte=now, last_byte=now),
                sending=sending,
            )
        )
        if expected is None:
            self._apart |= {number: (value,) for number, value in macros}
        return receipt

    def _standing(self, macros: Sequence[tuple[int, float]]) -> Expected:
        """Return what may stand in macros that are not of the block."""
        polled: MacroValues = {} if self.sample is None else self.sample.macros
        standing: dict[int, tuple[float | None, ...]] = {}
        for number, _ in macros:
            if number in self._apart:
                standing[number] = self._apart[number]
            elif number in polled:
                standing[number] = () if (value := polled[number]) is None else (value,)
            else:
                continue
            if number in CLEARED_BY_POWER_OFF:
                standing[number] += (None,)
        return standing

    def _expect_old_or_new(self, macros: Sequence[tuple[int, float]]) -> None:
        before = self._acceptable or {}
        self._acceptable = {number: (*before.get(number, ()), value) for number, value in macros}


class CncLink:
    """Holds the present session; the control task uses it and says when it is lost."""

    def __init__(
        self, open_cnc: Callable[[], Cnc], open_session: Callable[[Cnc, CncSession | None], CncSession]
    ) -> None:
        self._open_cnc = open_cnc
        self._open_session = open_session
        self._lost: asyncio.Future[LinkError] | None = None
        self._last: CncSession | None = None
        self.session: CncSession | None = None
        self.health = LinkHealth("cnc")

    @property
    def cnc(self) -> Cnc | None:
        """The control while there is a session."""
        return None if self.session is None else self.session.cnc

    async def attempt(self) -> None:
        """Connect, offer the session until it is lost, close. Raises what ended it."""
        cnc = self._open_cnc()
        try:
            await cnc.connect()
            self._lost = asyncio.get_running_loop().create_future()
            self.session = self._last = self._open_session(cnc, self._last)
            self.health.came_up(identity=cnc.identity, security=cnc.security)
            raise await self._lost
        finally:
            self.session = None
            await cnc.close()

    def lost(self, error: LinkError) -> None:
        """End the present session; the supervisor opens the next one."""
        self.session = None
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(error)
