"""Takes the offsets back at the slew rate after an early end, and says what is left when that is not possible."""

import asyncio
from collections.abc import Callable
from pathlib import Path

from config.records.commissioning import PROOF_TOLERANCE, CommissioningError, load_commissioning
from daemon.commissioning.dialogue import Dialogue
from daemon.commissioning.initialising import CommissioningRefusedError, ForeignWriterError
from daemon.commissioning.judgement import DisprovedError
from daemon.commissioning.movement import Movement
from daemon.commissioning.station import Station
from drivers.contract import DriverError

DISPROVED = ".disproved"
"""End of the name of a record that counts no more."""
RECONNECTING_S = 2.0
RECONNECTS = 15
"""A lost link is tried so often before the machine is left as it is."""


def set_aside(record_file: Path | None, error: BaseException) -> str:
    """Let a record of before count no more that says otherwise of this axis, or more than was seen of it now.

    Returns what a person is to know of it; empty when every record counts as before.
    """
    if record_file is None or not isinstance(error, DisprovedError):
        return ""
    try:
        record = load_commissioning(record_file)
    except CommissioningError:
        return ""
    known = record.axes.get(error.axis)
    if known is None or abs(error.ratio / (known.sign * known.scale) - 1.0) <= PROOF_TOLERANCE:
        return ""
    aside = record_file.with_name(record_file.name + DISPROVED)
    what = f"The record of {record.date} is in doubt for axis {error.axis}"
    try:
        record_file.replace(aside)
    except OSError as problem:
        return f"{what} and still counts: {record_file} cannot be renamed ({problem.strerror}); remove it"
    return f"{what}, so it counts no more and is {aside} now: no axis can be switched on until a new one is there"


class SafeExit:
    """Brings the machine back to zero whatever has ended the commissioning."""

    def __init__(self, station: Station, movement: Movement, dialogue: Dialogue, event: Callable[[str], None]) -> None:
        """`event` leaves a line in the audit."""
        self._station = station
        self._movement = movement
        self._dialogue = dialogue
        self._event = event

    async def leave(self, error: BaseException) -> None:
        """Go back to zero after an early end, as far as that is possible, and say what is left."""
        interrupted = isinstance(error, asyncio.CancelledError)
        if interrupted and (task := asyncio.current_task()) is not None:
            task.uncancel()
        why = "interrupted" if interrupted else str(error) or type(error).__name__
        self._event(f"ended early: {why}")
        station = self._station
        if not station.touched:
            self._dialogue.say("Nothing has been moved.")
            return
        if isinstance(error, ForeignWriterError):
            self._dialogue.say(
                "Another program writes the block, so nothing more is written; the block expires in the CNC."
            )
        else:
            self._dialogue.say(f"Stopped ({why}). Going back to zero; press Ctrl-C to leave the machine as it is.")
            try:
                await self._retreat(lost=isinstance(error, DriverError))
            except (CommissioningRefusedError, DriverError, asyncio.CancelledError) as problem:
                self._dialogue.say(f"The way back to zero broke off: {str(problem) or 'interrupted'}")
        left = station.whats_left()
        self._event(f"left behind: {left or 'nothing'}")
        self._dialogue.say(
            f"LEFT BEHIND: {left}. The guard finds the block expired and acts as its expiry policy says. Run "
            "`toolpoint commission` again: it takes the offset back first."
            if left
            else "Everything is back at zero."
        )

    async def _retreat(self, *, lost: bool) -> None:
        station = self._station
        if lost:
            await self._reconnect()

        async def back() -> None:
            await station.next_beat()
            await self._movement.to_zero()
            await self._movement.switch_off()

        station.target_um = station.command_um.copy()
        station.going_back = True
        await station.supervise(back())

    async def _reconnect(self) -> None:
        station = self._station
        for attempt in range(1, RECONNECTS + 1):
            try:
                await station.connect()
                return
            except DriverError as problem:
                self._dialogue.say(f"No link to the CNC ({problem}); attempt {attempt} of {RECONNECTS}")
                if attempt == RECONNECTS:
                    raise
            await station.clock.sleep(RECONNECTING_S)
