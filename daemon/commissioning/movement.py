"""Moves an axis through the guard: writes the value, has a person call the guard; takes offsets back."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np

from config.records.commissioning import PROOF_TOLERANCE, CommissioningError, load_commissioning, older_guard
from daemon.commissioning.dialogue import Dialogue
from daemon.commissioning.initialising import CommissioningRefusedError, ForeignWriterError
from daemon.commissioning.judgement import DisprovedError
from daemon.commissioning.station import Station
from daemon.compensation.alarms import GUARD_CONTENT
from drivers.contract import DriverError
from drivers.guard.text import GuardStatus
from models.records import FloatArray

CALL_THE_GUARD = "Call the guard now: in MDI, or run the program to its safe point."
GUARD_SAYS: dict[int, str] = {
    GuardStatus.TORN: "the block was torn (status 2): guard and map of the macros disagree on the sequence numbers",
    GuardStatus.EXPIRED: "the block has expired (status 3): the guard reads another clock, or its limit is shorter",
    GuardStatus.VACANT: "a value is vacant (status 4): the guard reads other variables than the map says",
    GuardStatus.OVERSIZE: "the value is outside the guard's bound (status 5): its bound or its unit differs",
    GuardStatus.INCH: "the control is in inch mode (status 6): command G21",
    GuardStatus.MODAL: "cutter compensation or a canned cycle is active (status 7): command G40 and G80",
    GuardStatus.MEMORY: "the guard's memory is damaged (status 8): run the guard's initialise program in MDI",
    GuardStatus.CHECK: "the check does not fit the block (status 10): something else writes a macro of it, or guard "
    "and map of the macros disagree",
    GuardStatus.SWITCHED_OFF: "the control does not act on SD43900 (status 11): set bit 0 of MD32750, and MD32760 "
    "above 0, for every axis that is compensated",
    GuardStatus.PLACE: "nothing was moved, of any axis: one with a slope stands outside its travel, or the control "
    "does not say where (status 12): bring it into its slope.travel_mm, then call the guard again",
    GuardStatus.NEARING: "the slope is on its way to where the axis stands now, a step for each call (status 13): "
    "leave the axis where it stands",
    GuardStatus.UNSETTLED: "the external offset was changed in between (status 9): run the initialise program in MDI",
}
"""What a guard that does not apply the block says by its status."""
NO_MEMORY = "its echo of what is applied is vacant: run the guard's initialise program in MDI, then the guard again"


class Movement:
    """Moves axes leg by leg and waits for the guard; used while the station's heart beats."""

    def __init__(self, station: Station, dialogue: Dialogue, *, patience_s: float, version_macro: int) -> None:
        """`patience_s` is how long a person has to call the guard [s]."""
        self._station = station
        self._dialogue = dialogue
        self._patience_s = patience_s
        self._version_macro = version_macro

    async def hear_guard(self) -> int:
        """Wait until the guard has run once with everything off; return its version."""
        station = self._station
        await station.next_beat()
        before_s = station.echo.time_s  # of before a power-off it may be ahead of the clock
        self._dialogue.say(f"The guard must run once while nothing is asked of it. {CALL_THE_GUARD}")

        told = False

        def heard() -> bool:
            nonlocal told
            echo = station.echo
            ran = echo.time_s not in (None, before_s)
            known = bool(np.all(np.isfinite(echo.applied_um)))
            if ran and not known and not told:
                told = True
                self._dialogue.say(f"The guard ran, but {NO_MEMORY}.")
            return ran and known

        await self._wait_for_guard(heard, lambda: NO_MEMORY if told else "it has not run")
        guard_version = station.echo.guard_version
        if guard_version is None or guard_version != round(guard_version):
            raise CommissioningRefusedError(
                f"the guard ran, but its version reads {guard_version}: it must echo a whole number in "
                f"#{self._version_macro} (cnc.macros.echo_guard_version)"
            )
        if older := older_guard(guard_version):
            raise CommissioningRefusedError(f"the control runs {older}, then begin again")
        self._dialogue.say(f"The guard answers: version {guard_version:g}, status {station.echo.status}.")
        return round(guard_version)

    async def move(self, index: int, target_um: float) -> None:
        """Bring one axis to its target, leg by leg, each no larger than the guard's step."""
        station = self._station
        while station.command_um[index] != target_um:
            wanted_um = station.target_um.copy()
            wanted_um[index] = station.next_leg_um(index, target_um)
            station.target_um = wanted_um
            await station.written()
            await self._wait_for_applied(wanted_um)

    async def arrived(self) -> None:
        """Wait until the guard has brought every slope to where its axis stands."""
        station = self._station
        await station.next_beat()
        if station.echo.status == GuardStatus.NEARING:
            self._dialogue.say(f"The guard ran, and {GUARD_SAYS[GuardStatus.NEARING]}. {CALL_THE_GUARD}")
        await self._wait_for_guard(
            lambda: station.echo.status != GuardStatus.NEARING,
            lambda: "the slope has not reached where the axis stands",
        )

    async def _wait_for_applied(self, wanted_um: FloatArray) -> None:
        station = self._station
        if not station.applied(wanted_um):
            values = ", ".join(f"{axis} {um:+.2f} um" for axis, um in zip(station.axes, wanted_um, strict=True) if um)
            self._dialogue.say(f"The CNC holds {values or 'zero'}. {CALL_THE_GUARD}")
        await self._wait_for_guard(lambda: station.applied(wanted_um), lambda: "it has not applied what was asked")

    async def _wait_for_guard(self, done: Callable[[], bool], complaint: Callable[[], str]) -> None:
        """Wait for the guard; say what it says when it refuses, end with a sentence when it never does."""
        station = self._station
        begin_s = station.clock.now().monotonic_s
        said: int | None = 0
        await station.next_beat()
        before_s = station.echo.time_s
        while not done():
            echo = station.echo
            ran = echo.time_s not in (None, before_s)
            if ran and echo.status != said and echo.status not in GUARD_CONTENT:
                said = echo.status
                self._dialogue.say(f"The guard ran, and {GUARD_SAYS.get(said or -1, f'refused (status {said})')}.")
            if station.clock.now().monotonic_s - begin_s > self._patience_s:
                last = GUARD_SAYS.get(said or -1, "") if said else ""
                raise CommissioningRefusedError(
                    f"waited {self._patience_s:g} s for the guard: {last or complaint()}; "
                    f"{self._echo_in_words()}. Check that the guard is loaded, that "
                    "the program or MDI really calls it, and that cnc.macros names the variables it uses"
                )
            await station.next_beat()

    def _echo_in_words(self) -> str:
        station, echo = self._station, self._station.echo
        pairs = zip(station.axes, station.target_um, echo.applied_um, strict=True)
        return "; ".join(f"{axis}: asked {asked:.2f} um, applied {um:.2f} um" for axis, asked, um in pairs)

    async def to_zero(self) -> None:
        """Bring every axis to zero, leg by leg."""
        station = self._station
        echo_um = station.echo.applied_um
        station.enable = [
            on or abs(um) > 0 or abs(echo) > 0
            for on, um, echo in zip(station.enable, station.command_um, np.nan_to_num(echo_um), strict=True)
        ]
        while np.any(station.command_um != 0):
            station.target_um = np.array([station.next_leg_um(i, 0.0) for i in range(len(station.axes))])
            await station.written()
            await self._wait_for_applied(station.target_um)
        await self._wait_for_applied(np.zeros(len(station.axes)))

    async def switch_off(self) -> None:
        station = self._station
        station.enable = [False] * len(station.axes)
        await station.written()
        await station.next_beat()
        if not station.applied(np.zeros(len(station.axes))) or station.session.enabled:
            raise CommissioningRefusedError(f"not everything is back at zero: {station.whats_left()}")
        station.touched = False
        self._dialogue.say("Everything is at zero, and the enable word is 0.")


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
    axis = next((each for each in (error.axis, *error.also_moved) if each in record.axes), None)
    if axis is None:
        return ""
    known = record.axes[axis]
    if axis == error.axis and abs(error.ratio / (known.sign * known.scale) - 1.0) <= PROOF_TOLERANCE:
        return ""
    aside = record_file.with_name(record_file.name + DISPROVED)
    what = f"The record of {record.date} is in doubt for axis {axis}"
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
