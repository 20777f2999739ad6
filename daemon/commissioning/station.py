"""The CNC while offsets are applied: keeps one session, renews the validity, ramps values at the slew rate.

One task owns every call to the CNC. It polls at each tick, moves the value towards its target at the
slew rate, and renews `valid_until`, however long the person looks at the instrument.
"""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from config.schema import Configuration
from daemon.cnc.audited_write import ForeignValueError
from daemon.cnc.limits import output_limits
from daemon.cnc.macro_block import ECHO_SLACK_UM, UNFINISHED, UNSETTLED, Echo
from daemon.cnc.session import CncSession
from daemon.commissioning.initialising import CommissioningRefusedError, ForeignWriterError
from daemon.commissioning.link import CommissioningLink
from drivers.contract import LinkError
from drivers.guard.text import GuardStatus
from models.control.program import power_cycled
from models.records import CncSample, CompensationCommand, FloatArray, OutputState, Trace, WriteOutcome

T = TypeVar("T")

STOP_CALLS = 4
"""A beat may end this many calls to the CNC before it is cancelled."""
SPINDLE_AT_REST_RPM = 1.0
"""A spindle that turns faster tears the instrument off [1/min]."""
UM_PER_MM = 1000.0
INCREMENT_SLACK = 1e-6


class Station:
    """One control, from the first look to everything back at zero."""

    def __init__(self, configuration: Configuration, control: CommissioningLink) -> None:
        self._configuration = configuration
        self.control = control
        self.clock = control.clock
        self.axes = tuple(configuration.compensation.axes)
        self.limits = output_limits(configuration)
        self._block = control.block
        self._session: CncSession | None = None
        self._previous: CncSample | None = None
        self._stopping = False
        self._beats = asyncio.Condition()
        self._moved_s = 0.0
        self.target_um: FloatArray = np.zeros(len(self.axes))
        self.command_um: FloatArray = np.zeros(len(self.axes))
        self.enable = [False] * len(self.axes)
        self.going_back = False
        """On the way back to zero an alarm or a power cycle is no reason to stop: the values must still go to zero."""
        self.touched = False
        """An enable bit has been written, so the machine must be left in order."""
        self.moved = False
        """The guard has applied something since this was last set back."""
        self._echo_behind = False
        """The echo may not say what is applied: a run of the guard was broken off, or found its memory damaged."""

    async def connect(self) -> None:
        """Connect anew; raises DriverError."""
        await self.control.connect()
        if self._session is not None:
            self._session = self._new_session(self._session.known)

    def _new_session(self, known: dict[int, tuple[float, ...]] | None) -> CncSession:
        return CncSession(self.control.writer(), self.limits, known, self.control.last_block)

    def take_over(self, sample: CncSample) -> None:
        """Begin a session on the block as it now stands; what is applied is where the command begins."""
        held = {number: sample.macros.get(number) for number in self._block.ours}
        self.control.last_block.keep({number: (value,) for number, value in held.items() if value is not None})
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
        echo = self.session.echo
        return self._block.echo({}) if echo is None else echo

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
        self.control.history.cnc_sample(sample)
        status = self.echo.status
        self._echo_behind = status in UNSETTLED and (status != GuardStatus.INCH or self._echo_behind)
        self.moved = self.moved or status == UNFINISHED or bool(np.any(self._echoes_other_than(0.0)))
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
        try:
            receipt = await self.session.write(
                command,
                validity_s=self._configuration.compensation.output.validity_s,
                trace=Trace(first_byte=now, last_byte=now),
                cause="commission",
            )
        except ForeignValueError as error:
            raise ForeignWriterError(
                f"{error}: something else writes these variables; find it, and begin again"
            ) from error
        if receipt.outcome is not WriteOutcome.VERIFIED:
            raise ForeignWriterError(f"read-back differs: {receipt.detail}")

    # --- what the procedure asks for -----------------------------------------------------

    async def next_beat(self) -> None:
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
        """Whether the guard says that it applies exactly this [um], and no run of it was broken off after that."""
        return not self._echo_behind and self.echo.status != UNFINISHED and not np.any(self._echoes_other_than(um))

    def _echoes_other_than(self, um: FloatArray | float) -> npt.NDArray[np.bool_]:
        return ~(np.abs(self.echo.applied_um - um) <= ECHO_SLACK_UM)

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
        if self._echo_behind:
            left.append(f"what the guard applies is not known (status {self.echo.status})")
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
    """Refuse a state in which no person may stand at the machine with an instrument."""
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
