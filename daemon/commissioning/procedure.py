"""The steps of a commissioning, each announced and agreed to before it happens."""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version

import numpy as np

from config.commissioning import CommissionedAxis, CommissioningRecord, macro_map_digest
from config.schema import Configuration
from daemon.commissioning.dialogue import Dialogue
from daemon.commissioning.initialising import BlockFound
from daemon.commissioning.judgement import judge, refuse_noise
from daemon.commissioning.preconditions import refuse_clock, refuse_insecure, refuse_offset, refuse_state
from daemon.commissioning.readings import DisplacementLog, Instruments, Moment, Reading
from daemon.commissioning.refusal import CommissioningRefusedError, ForeignWriterError
from daemon.commissioning.station import Station
from daemon.history.writer import HistoryWriter
from daemon.output.alarm import GUARD_CONTENT
from drivers.contract import DriverError
from models.records import CncSample, FloatArray

CALL_THE_GUARD = "Call the guard now: in MDI, or run the program to its safe point."
GUARD_SAYS = {
    2: "the block was torn (status 2): the guard and the map of the macros do not agree on the sequence numbers",
    3: "the block has expired (status 3): the guard's clock is not the one that is configured, or its limit is shorter",
    4: "a value is vacant (status 4): the guard reads other variables than the map says",
    5: "the value is outside its bound (status 5): the guard's bound is smaller than the offset, or its unit differs",
    6: "the control is in inch mode (status 6): command G21",
    7: "cutter compensation or a canned cycle is active (status 7): command G40 and G80",
    8: "the guard's memory is damaged (status 8): run the guard's initialise program in MDI",
    9: "the external work offset was changed in between (status 9): run the guard's initialise program in MDI",
}
"""What a guard that does not apply the block says by its status."""
NO_MEMORY = "its echo of what is applied is vacant: run the guard's initialise program in MDI, then the guard again"
RECONNECTING_S = 2.0
RECONNECTS = 15
"""A lost link is tried so often before the machine is left as it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is to be done, as a person has asked for it."""

    axes: tuple[str, ...]
    offset_um: float
    person: str
    instrument: str
    patience_s: float = 300.0
    """So long a person has to call the guard [s]."""
    initialise_only: bool = False
    overwrite_foreign: bool = False
    accept_reversed: frozenset[str] = frozenset()
    accept_scale: frozenset[str] = frozenset()
    guard_program_sha256: str | None = None


@dataclass(slots=True)
class Outcome:
    """What has been found so far."""

    identity: str = ""
    guard_version: int | None = None
    axes: dict[str, CommissionedAxis] = field(default_factory=dict)


class Commissioning:
    """One commissioning from the first look to everything at zero."""

    def __init__(
        self,
        configuration: Configuration,
        plan: Plan,
        station: Station,
        dialogue: Dialogue,
        instruments: Instruments,
        history: HistoryWriter,
        today: Callable[[], str],
        log: DisplacementLog | None = None,
    ) -> None:
        self._configuration = configuration
        self._plan = plan
        self._station = station
        self._dialogue = dialogue
        self._instruments = instruments
        self._history = history
        self._today = today
        self._log = log
        self._outcome = Outcome()

    async def run(self) -> CommissioningRecord | None:
        """Go through all steps; None with `initialise_only`.

        Whatever ends it early (a refusal, a lost link, Ctrl-C), the offsets go back to zero first, as far as
        that is possible, and what is left is said. Raises CommissioningRefusedError or DriverError afterwards.
        """
        refuse_insecure(self._configuration)
        refuse_offset(self._configuration, self._plan.axes, self._plan.offset_um)
        self._event("begun")
        try:
            await self._prepare()
            if self._plan.initialise_only:
                self._event("macro variables initialised; ended as asked")
                return None
            beside = [] if self._log is None else [self._log.follow()]
            await self._station.supervise(self._prove(), *beside)
        except BaseException as error:
            await self._leave(error)
            raise
        finally:
            await self._station.close()
        record = self._record()
        self._event(f"proved: {', '.join(record.axes)}")
        return record

    def _event(self, text: str) -> None:
        self._history.event("commissioning", text, self._plan.person)

    def _say(self, text: str) -> None:
        self._dialogue.say(text)

    async def _agree(self, question: str) -> None:
        if not await self._dialogue.confirm(question):
            raise CommissioningRefusedError(f"you said no to: {question}")

    # --- preconditions and the variables -------------------------------------------------

    async def _prepare(self) -> None:
        station, configuration = self._station, self._configuration
        await station.connect()
        refuse_clock(station.clock, station.identity)
        self._outcome.identity = station.identity
        sample = await station.look()
        refuse_state(sample, configuration)
        security = "encrypted and signed" if station.secure else "NOT secure (allow_insecure_writes)"
        self._say(f"Control {station.identity}, {security}; O{sample.program}, {sample.mode.value}, {sample.run.value}")
        await self._agree(f"Is this the control of {configuration.machine!r}?")
        sample = await self._initialise(sample)
        refuse_state(sample, configuration)
        station.take_over(sample)

    async def _initialise(self, sample: CncSample) -> CncSample:
        station = self._station
        found = station.block_found(sample)
        if found.foreign:
            await self._overwrite(found)
        elif found.vacant:
            await self._agree(f"Set the vacant variables {_numbers(found.vacant)} to 0?")
        valid_until = self._configuration.cnc.macros.valid_until
        numbers = (*found.vacant, *(number for number in found.foreign if number != valid_until))
        if numbers:
            await station.initialise(numbers, found, self._plan.person)
            self._event(f"initialised {_numbers(numbers)}")
            self._say(f"Initialised: {_numbers(numbers)}")
        else:
            self._say("The macro variables of the block are initialised.")
        return await station.look()

    async def _overwrite(self, found: BlockFound) -> None:
        self._say(
            f"These variables are configured as ours, but hold what nobody here has written: {found.foreign_in_words}. "
            "Another program may use them. They would be set to 0."
        )
        if not self._plan.overwrite_foreign and not await self._dialogue.confirm_expressly("Overwrite them?"):
            raise CommissioningRefusedError(
                f"foreign values were left alone: {found.foreign_in_words}. Choose other numbers in cnc.macros, or, if "
                "nothing uses these, say yes or give --overwrite-foreign"
            )
        self._event(f"foreign values overwritten: {found.foreign_in_words}")

    # --- the proof -----------------------------------------------------------------------

    async def _prove(self) -> None:
        await self._hear_guard()
        await self._start_from_zero()
        for axis in self._plan.axes:
            self._outcome.axes[axis] = await self._prove_axis(axis)
            self._event(f"axis {axis}: {_in_words(self._outcome.axes[axis])}")
        await self._switch_off()

    async def _hear_guard(self) -> None:
        """Wait until the guard has run once with everything off."""
        station = self._station
        await station.next_beat()
        since_s = station.cnc_clock_s
        self._say(f"The guard must run once while nothing is asked of it. {CALL_THE_GUARD}")

        told = False

        def heard() -> bool:
            nonlocal told
            echo = station.echo
            ran = echo.time_s is not None and echo.time_s > since_s
            known = bool(np.all(np.isfinite(echo.applied_um)))
            if ran and not known and not told:
                told = True
                self._say(f"The guard ran, but {NO_MEMORY}.")
            return ran and known

        await self._wait_for_guard(heard, lambda: NO_MEMORY if told else "it has not run")
        guard_version = station.echo.guard_version
        if guard_version is None or guard_version != round(guard_version):
            raise CommissioningRefusedError(
                f"the guard ran, but its version reads {guard_version}: it must echo a whole number in "
                f"#{self._configuration.cnc.macros.echo_guard_version} (cnc.macros.echo_guard_version)"
            )
        self._outcome.guard_version = round(guard_version)
        self._say(f"The guard answers: version {guard_version:g}, status {station.echo.status}.")

    async def _start_from_zero(self) -> None:
        station = self._station
        station.command_um = station.target_um = station.echo.applied_um.copy()
        if station.applied(np.zeros(len(station.axes))) and not any(station.enable):
            return
        found = ", ".join(f"{axis} {um:.2f} um" for axis, um in zip(station.axes, station.echo.applied_um, strict=True))
        await self._agree(f"The guard still applies an offset ({found}). Take it back to zero first?")
        await self._to_zero()
        await self._switch_off()

    async def _prove_axis(self, axis: str) -> CommissionedAxis:
        station, offset_um = self._station, self._plan.offset_um
        index = station.axes.index(axis)
        limits = self._configuration.compensation.axes[axis]
        minutes = abs(offset_um) / limits.slew_um_per_min
        self._say(
            f"Axis {axis}: {offset_um:+g} um, at {limits.slew_um_per_min:g} um/min ({minutes:.1f} min); read by "
            f"{self._instruments.observed_by(axis)}. If the instrument moves by more than twice that, press Ctrl-C."
        )
        await self._agree(f"Is the instrument along {axis} in place, and the tool away from work and fixture?")
        taken = {Moment.BEFORE: await self._read(axis, Moment.BEFORE)}
        station.enable = [other == axis for other in station.axes]
        await self._move(index, offset_um)
        taken[Moment.AT_OFFSET] = await self._read(axis, Moment.AT_OFFSET)
        await self._move(index, 0.0)
        taken[Moment.AFTER] = await self._read(axis, Moment.AFTER)
        found = judge(
            axis,
            offset_um,
            taken,
            accept_reversed=axis in self._plan.accept_reversed,
            accept_scale=axis in self._plan.accept_scale,
        )
        self._say(f"Axis {axis}: {_in_words(found)}")
        return found

    async def _read(self, axis: str, moment: Moment) -> Mapping[str, Reading]:
        readings = await self._instruments.take(axis, moment, self._station.axes)
        refuse_noise(axis, self._plan.offset_um, readings[axis])
        return readings

    async def _move(self, index: int, target_um: float) -> None:
        """Bring one axis to its target, leg by leg, each no larger than the guard's step."""
        station = self._station
        while station.command_um[index] != target_um:
            wanted_um = station.target_um.copy()
            wanted_um[index] = station.next_leg_um(index, target_um)
            station.target_um = wanted_um
            await station.written()
            await self._wait_for_applied(wanted_um)

    async def _wait_for_applied(self, wanted_um: FloatArray) -> None:
        station = self._station
        if not station.applied(wanted_um):
            values = ", ".join(f"{axis} {um:+.2f} um" for axis, um in zip(station.axes, wanted_um, strict=True) if um)
            self._say(f"The CNC holds {values or 'zero'}. {CALL_THE_GUARD}")
        await self._wait_for_guard(lambda: station.applied(wanted_um), lambda: "it has not applied what was asked")

    async def _wait_for_guard(self, done: Callable[[], bool], complaint: Callable[[], str]) -> None:
        """Wait for the guard; say what it says when it refuses, end with a sentence when it never does."""
        station = self._station
        begin_s = station.clock.now().monotonic_s
        said: int | None = 0
        await station.next_beat()
        asked_s = station.cnc_clock_s
        while not done():
            echo = station.echo
            ran = echo.time_s is not None and echo.time_s > asked_s
            if ran and echo.status != said and echo.status not in GUARD_CONTENT:
                said = echo.status
                self._say(f"The guard ran, and {GUARD_SAYS.get(said or -1, f'refused (status {said})')}.")
            if station.clock.now().monotonic_s - begin_s > self._plan.patience_s:
                last = GUARD_SAYS.get(said or -1, "") if said else ""
                raise CommissioningRefusedError(
                    f"waited {self._plan.patience_s:g} s for the guard: {last or complaint()}; "
                    f"{self._echo_in_words()}. Check that the guard is loaded, that "
                    "the program or MDI really calls it, and that cnc.macros names the variables it uses"
                )
            await station.next_beat()

    def _echo_in_words(self) -> str:
        station, echo = self._station, self._station.echo
        pairs = zip(station.axes, station.target_um, echo.applied_um, strict=True)
        return "; ".join(f"{axis}: asked {asked:.2f} um, applied {um:.2f} um" for axis, asked, um in pairs)

    # --- the end -------------------------------------------------------------------------

    async def _to_zero(self) -> None:
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

    async def _switch_off(self) -> None:
        station = self._station
        station.enable = [False] * len(station.axes)
        await station.written()
        await station.next_beat()
        if not station.applied(np.zeros(len(station.axes))) or station.session.enabled:
            raise CommissioningRefusedError(f"not everything is back at zero: {station.whats_left()}")
        station.touched = False
        self._say("Everything is at zero, and the enable word is 0.")

    async def _leave(self, error: BaseException) -> None:
        """Go back to zero after an early end, as far as that is possible, and say what is left."""
        interrupted = isinstance(error, asyncio.CancelledError)
        if interrupted and (task := asyncio.current_task()) is not None:
            task.uncancel()
        why = "interrupted" if interrupted else str(error) or type(error).__name__
        self._event(f"ended early: {why}")
        station = self._station
        if not station.touched:
            self._say("Nothing has been moved.")
            return
        if isinstance(error, ForeignWriterError):
            self._say("Somebody else writes the block, so nothing more is written; the block expires in the CNC.")
        else:
            self._say(f"Stopped ({why}). Going back to zero; press Ctrl-C to leave the machine as it is.")
            try:
                await self._retreat(lost=isinstance(error, DriverError))
            except (CommissioningRefusedError, DriverError, asyncio.CancelledError) as problem:
                self._say(f"The way back to zero broke off: {problem or 'interrupted'}")
        left = station.whats_left()
        self._event(f"left behind: {left or 'nothing'}")
        self._say(
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
            await self._to_zero()
            await self._switch_off()

        station.target_um = station.command_um.copy()
        await station.supervise(back())

    async def _reconnect(self) -> None:
        station = self._station
        for attempt in range(1, RECONNECTS + 1):
            try:
                await station.connect()
                return
            except DriverError as problem:
                self._say(f"No link to the CNC ({problem}); attempt {attempt} of {RECONNECTS}")
                if attempt == RECONNECTS:
                    raise
            await station.clock.sleep(RECONNECTING_S)

    def _record(self) -> CommissioningRecord:
        plan, outcome = self._plan, self._outcome
        return CommissioningRecord(
            cnc_identity=outcome.identity,
            macro_map_sha256=macro_map_digest(self._configuration.cnc.macros),
            guard_version=outcome.guard_version,
            guard_program_sha256=plan.guard_program_sha256,
            person=plan.person,
            date=self._today(),
            machine=self._configuration.machine,
            instrument=plan.instrument,
            software=f"toolpoint {version('toolpoint')}",
            axes=outcome.axes,
        )


def _numbers(numbers: tuple[int, ...]) -> str:
    return ", ".join(f"#{number}" for number in numbers)


def _in_words(found: CommissionedAxis) -> str:
    others = ", ".join(f"{axis} {um:+.2f} um" for axis, um in found.others_um.items())
    return (
        f"{found.written_um:+g} um moved it by {found.measured_um:+.2f} um, sign {found.sign:+d}, "
        f"scale {found.scale:g}; others: {others or 'not observed'}"
    )
