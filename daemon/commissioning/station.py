"""The CNC during a commissioning: one session, a heartbeat that never pauses, and offsets that creep.

One task owns every call to the CNC. It polls at each tick, moves the value towards its target at the
slew rate, and renews `valid_until`, however long the person looks at the instrument.
"""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

import numpy as np

from config.schema import Configuration
from daemon.cnc.clock_watch import power_cycled
from daemon.cnc.limits import echo_slack_um, output_limits
from daemon.cnc.macro_block import ECHO_SLACK_UM, Echo, MacroBlock
from daemon.cnc.session import CncSession
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.commissioning.initialising import (
    BlockFound,
    CommissioningRefusedError,
    ForeignWriterError,
    find_block,
    ours_to_initialise,
    zero_groups,
)
from daemon.history.writer import HistoryWriter, WriteId
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import Cnc, LinkError, Security
from models.records import (
    CncSample,
    CompensationCommand,
    FloatArray,
    OutputState,
    Receipt,
    Trace,
    WriteOutcome,
)

T = TypeVar("T")

STOP_CALLS = 4
"""A beat may end this many calls to the CNC before it is cancelled."""
SPINDLE_AT_REST_RPM = 1.0
"""A spindle that turns faster tears the instrument off [1/min]."""
UM_PER_MM = 1000.0
INCREMENT_SLACK = 1e-6
COMMIT_S = 10.0
"""The audit takes the intent within this, or nothing is written [s of the wall clock]."""


class Station:
    """One control, from the first look to everything back at zero."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        open_cnc: Callable[[], Cnc],
        history: HistoryWriter,
        last_block: WriteAheadRecord,
    ) -> None:
        self._configuration = configuration
        self.clock = clock
        self._open_cnc = open_cnc
        self._history = history
        self._last_block = last_block
        self.axes = tuple(configuration.compensation.axes)
        self.limits = output_limits(configuration)
        self._block = MacroBlock(
            configuration.cnc.macros, self.axes, {}, echo_slack_um(configuration), configuration.cnc.guard
        )
        self._speed = configuration.spindle_speed.macros if configuration.spindle_speed is not None else None
        self._telemetry = Telemetry()
        self._cnc: Cnc | None = None
        self._session: CncSession | None = None
        self._previous: CncSample | None = None
        self._stopping = False
        self._beats = asyncio.Condition()
        self._moved_s = 0.0
        self.identity = ""
        self.security: Security = "insecure"
        self.target_um: FloatArray = np.zeros(len(self.axes))
        self.command_um: FloatArray = np.zeros(len(self.axes))
        self.enable = [False] * len(self.axes)
        self.going_back = False
        """On the way back to zero an alarm or a power cycle is no reason to stop: the values must still go to zero."""
        self.touched = False
        """An enable bit has been written, so the machine must be left in order."""

    # --- connection ----------------------------------------------------------------------

    async def connect(self) -> None:
        """Connect anew; raises DriverError."""
        await self.close()
        cnc = self._cnc = self._open_cnc()
        await cnc.connect()
        self.identity, self.security = cnc.identity, cnc.security
        if self._session is not None:
            self._session = self._new_session(self._session.known)

    async def close(self) -> None:
        """Close the connection; never raises."""
        cnc, self._cnc = self._cnc, None
        if cnc is not None:
            await cnc.close()

    def _new_session(self, known: dict[int, tuple[float, ...]] | None) -> CncSession:
        return CncSession(
            self._connected(),
            self._block,
            self.clock,
            self._history,
            self._telemetry,
            self.limits,
            known,
            self._last_block,
        )

    def _connected(self) -> Cnc:
        if self._cnc is None:
            raise LinkError("there is no connection to the CNC")
        return self._cnc

    async def look(self) -> CncSample:
        """Read state and block once, before there is a heartbeat."""
        macros = self._configuration.cnc.macros
        numbers = dict.fromkeys((*self._block.polled, *ours_to_initialise(macros, self._block, self._speed)))
        return await self._connected().read(tuple(numbers))

    async def read(self, numbers: tuple[int, ...]) -> dict[int, float | None]:
        """Read other macro variables once, before there is a heartbeat; raises DriverError."""
        found = await self._connected().read_macros(numbers)
        return {number: found.get(number) for number in numbers}

    # --- initialising --------------------------------------------------------------------

    def block_found(self, sample: CncSample) -> BlockFound:
        """Sort the variables of the block by what the last write and the audit say they may hold."""
        kept = self._last_block.load()
        known = kept if kept is not None else self._history.last_written_macros()
        if self._speed is not None:
            known = {**(known or {}), **(WriteAheadRecord.of_speed(self._history.path).load() or {})}
        return find_block(self._configuration.cnc.macros, self._block, known, sample.macros, self._speed)

    async def initialise(self, numbers: tuple[int, ...], found: BlockFound, person: str) -> None:
        """Set these variables to 0, read them back, and leave intent and outcome in the audit."""
        groups = zero_groups(self._configuration.cnc.macros, numbers, self._speed)
        pairs = tuple(pair for group in groups for pair in group)
        if not pairs:
            return
        cnc = self._connected()
        intent = self._history.write_intent(None, pairs, "commission", person)
        await self._committed(intent)
        self._last_block.keep(
            {n: (0.0,) if found.values[n] is None else (found.values[n] or 0.0, 0.0) for n, _ in pairs}
        )
        now = self.clock.now()
        outcome, detail, read_back = WriteOutcome.FAILED, "", dict[int, float | None]()
        try:
            await cnc.write_macros(groups)
            read_back = await cnc.read_macros([number for number, _ in pairs])
            wrong = [number for number, value in pairs if read_back.get(number) != value]
            outcome = WriteOutcome.DIFFERS if wrong else WriteOutcome.VERIFIED
            detail = ", ".join(f"#{number} reads {read_back.get(number)}" for number in wrong)
        except Exception as error:
            detail = str(error)
            raise
        finally:
            self._history.write_outcome(
                intent,
                Receipt(
                    sequence=0,
                    macros=pairs,
                    outcome=outcome,
                    detail=detail,
                    read_back=tuple(read_back.get(number) for number, _ in pairs),
                    applied_um=np.full(len(self.axes), np.nan),
                    trace=Trace(first_byte=now, last_byte=now),
                ),
            )
        if detail:
            raise CommissioningRefusedError(
                f"initialised variables read back differently: {detail}. Check that nothing else writes them and that "
                "the CNC's user may; nothing has moved"
            )

    async def _committed(self, intent: WriteId) -> None:
        try:
            async with asyncio.timeout(COMMIT_S):
                await intent
        except TimeoutError:
            problem = self._history.problem or "the store does not answer"
            raise CommissioningRefusedError(
                f"the audit cannot be written, and nothing is written to the CNC without it: {problem}"
            ) from None

    def take_over(self, sample: CncSample) -> None:
        """Begin a session on the block as it now stands; what is applied is where the command begins."""
        held = {number: sample.macros.get(number) for number in self._block.ours}
        self._last_block.keep({number: (value,) for number, value in held.items() if value is not None})
        self._session = self._new_session({n: () if value is None else (value,) for n, value in held.items()})
        applied_um = self._block.echo(sample.macros).applied_um
        self.command_um = np.where(np.isfinite(applied_um), applied_um, 0.0)
        self.target_um = self.command_um.copy()
        bits = round(sample.macros.get(self._configuration.cnc.macros.enable) or 0.0)
        self.enable = [bool(bits >> index & 1) for index in range(len(self.axes))]
        self.touched = any(self.enable)
        self._previous = sample

    # --- the heartbeat -------------------------------------------------------------------

    @property
    def session(self) -> CncSession:
        """The session; raises LinkError before `take_over`."""
        if self._session is None:
            raise LinkError("the block has not been taken over yet")
        return self._session

    @property
    def echo(self) -> Echo:
        """What the guard said last."""
        echo = self.session.echo
        return self._block.echo({}) if echo is None else echo

    @property
    def cnc_clock_s(self) -> float:
        """The CNC's clock at the latest poll [s]."""
        assert self._previous is not None
        return self._previous.clock_s

    async def supervise(self, work: Coroutine[Any, Any, T], *beside: Coroutine[Any, Any, None]) -> T:
        """Do the work while the heart beats; what stops the heart ends the work with its error."""
        self._stopping = False
        self._moved_s = self.clock.now().monotonic_s
        working = asyncio.create_task(work)
        heart = asyncio.create_task(self._heart())
        others = [asyncio.create_task(other) for other in beside]
        try:
            await asyncio.wait({working, heart, *others}, return_when=asyncio.FIRST_COMPLETED)
            for beside_it in (heart, *others):
                if beside_it.done() and not working.done():
                    await beside_it
            return await working
        finally:
            self._stopping = True
            for task in (working, *others):
                task.cancel()
            await asyncio.gather(working, *others, return_exceptions=True)
            await asyncio.wait([heart], timeout=STOP_CALLS * self._configuration.cnc.timeout_s)
            heart.cancel()
            await asyncio.gather(heart, return_exceptions=True)

    async def _heart(self) -> None:
        tick_s = min(self._configuration.compensation.output.tick_s, self._configuration.cnc.poll_period_s)
        while not self._stopping:
            await self._beat()
            async with self._beats:
                self._beats.notify_all()
            await self.clock.sleep(tick_s)

    async def _beat(self) -> None:
        session = self.session
        if problems := await session.poll():
            raise ForeignWriterError(
                f"{'; '.join(problems)}: something else writes these variables, or the guard is not the configured "
                "one. Nothing more is written; find it, and begin again"
            )
        sample = session.sample
        assert sample is not None
        self._history.cnc_sample(sample)
        self._refuse_state(sample)
        changed = self._ramp()
        bits = tuple(self.enable)
        if session.last_command is None and not any(bits):
            return
        renew_s = self._configuration.compensation.output.validity_s / 3
        age_s = self.clock.now().monotonic_s - session.last_write_s
        same = session.last_command is not None and session.last_command.enable == bits
        if changed or not same or (any(bits) and age_s > renew_s):
            await self._write(bits)

    def _refuse_state(self, sample: CncSample) -> None:
        previous, self._previous = self._previous, sample
        if self.going_back:
            return
        if power_cycled(previous, sample):
            raise CommissioningRefusedError("the control was switched off and on; begin the commissioning again")
        refuse_unsafe(sample)

    def _ramp(self) -> bool:
        """Move the command towards its target at the slew rate; return whether it moved."""
        now_s = self.clock.now().monotonic_s
        elapsed_min, self._moved_s = (now_s - self._moved_s) / 60.0, now_s
        way_um = self.target_um - self.command_um
        most_um = np.minimum(self.limits.slew_um_per_min * elapsed_min, self.limits.step_um)
        near = np.abs(way_um) <= most_um
        self.command_um = np.where(near, self.target_um, self.command_um + np.clip(way_um, -most_um, most_um))
        return bool(np.any(np.abs(way_um) > 0))

    async def _write(self, bits: tuple[bool, ...]) -> None:
        command = CompensationCommand(
            axes=self.axes,
            requested_um=self.target_um.copy(),
            compensation_um=self.command_um.copy(),
            enable=bits,
            state=OutputState.ARMED if any(bits) else OutputState.OFF,
            reason="commissioning",
            write=True,
        )
        self.touched = self.touched or any(bits)
        now = self.clock.now()
        receipt = await self.session.write(
            command,
            validity_s=self._configuration.compensation.output.validity_s,
            trace=Trace(first_byte=now, last_byte=now),
            cause="commission",
        )
        if receipt.outcome is not WriteOutcome.VERIFIED:
            raise ForeignWriterError(f"read-back differs: {receipt.detail}")

    # --- what the procedure asks for -----------------------------------------------------

    async def next_beat(self) -> None:
        """Wait for the end of the next beat."""
        async with self._beats:
            await self._beats.wait()

    async def written(self) -> None:
        """Return when the CNC holds the target and the enable bits as they are set now."""
        while True:
            await self.next_beat()
            last = self.session.last_command
            there = np.array_equal(self.command_um, self.target_um)
            if there and last is not None and last.enable == tuple(self.enable):
                if np.array_equal(last.compensation_um, self.command_um):
                    return
            elif there and last is None and not any(self.enable):
                return

    def applied(self, um: FloatArray) -> bool:
        """Whether the guard says that it applies exactly this [um]."""
        return bool(np.all(np.abs(self.echo.applied_um - um) <= ECHO_SLACK_UM))

    def next_leg_um(self, index: int, target_um: float) -> float:
        """Return the next target of an axis: no more than the guard's step from what is applied [um]."""
        here_um = float(self.command_um[index])
        step_um = float(self.limits.step_um[index])
        increment_um = self._configuration.cnc.guard.increment_mm * UM_PER_MM
        if step_um > increment_um:  # the guard moves by whole increments of the control
            step_um = float(np.floor(step_um / increment_um + INCREMENT_SLACK)) * increment_um
        return here_um + float(np.clip(target_um - here_um, -step_um, step_um))

    def whats_left(self) -> str:
        """Return in words what the CNC holds and applies, '' when everything is at zero."""
        session = self._session
        if session is None:
            return ""
        left = []
        echo_um = self.echo.applied_um
        for index, axis in enumerate(self.axes):
            if np.isfinite(echo_um[index]) and abs(echo_um[index]) > ECHO_SLACK_UM:
                left.append(f"the guard applies {echo_um[index]:.2f} um along {axis}")
        known = session.known or {}
        for axis in self.axes:
            number = self._configuration.cnc.macros.values[axis]
            if any(abs(value) > 0 for value in known.get(number, ())):
                values = " or ".join(f"{value:g}" for value in known[number])
                left.append(f"#{number} ({axis}) may hold {values}")
        number = self._configuration.cnc.macros.enable
        if any(known.get(number, ())):
            left.append(f"#{number} (enable) may hold {' or '.join(f'{value:g}' for value in known[number])}")
        return "; ".join(left)


def refuse_unsafe(sample: CncSample) -> None:
    """Refuse a state in which nobody may stand at the machine with an instrument."""
    if sample.alarm:
        raise CommissioningRefusedError(
            "an alarm is active at the CNC: clear it there, and begin again. An alarm of the guard because of an "
            "expired block comes back with each of its calls until this command has renewed it: call it when asked"
        )
    if abs(sample.spindle_speed_rpm) > SPINDLE_AT_REST_RPM:
        raise CommissioningRefusedError(
            f"the spindle turns at {sample.spindle_speed_rpm:.0f} 1/min: stop it before an instrument touches the "
            "machine, and begin again"
        )
