"""The steps of a commissioning, each announced and agreed to before it happens."""

import asyncio
import os
import pwd
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version

import numpy as np

from config.records.commissioning import CommissionedAxis, CommissionedSlope, CommissioningRecord, macro_map_digest
from config.schema import Configuration
from config.schema.compensation import AxisConfig
from daemon.commissioning.dialogue import Dialogue
from daemon.commissioning.initialising import BlockFound, CommissioningRefusedError, UnreadError
from daemon.commissioning.judgement import DisprovedError, judge, refuse_noise
from daemon.commissioning.movement import Movement, SafeExit, set_aside
from daemon.commissioning.preconditions import (
    refuse_clock,
    refuse_insecure,
    refuse_offset,
    refuse_other_speed_program,
    refuse_shipped,
    refuse_state,
    refuse_unchecked,
    told_text,
)
from daemon.commissioning.readings import WORDS, DisplacementLog, Instruments, Moment, Reading
from daemon.commissioning.slope import Positions, positions_of, read_at, slope_to_write
from daemon.commissioning.station import UM_PER_MM, Station
from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import WantedAxes
from daemon.state_store.store import StateStore
from models.records import CncSample


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
    positions: Mapping[str, Positions] = field(default_factory=dict)
    """Machine positions of an axis [mm] at which its slope is read, by the slope's name; else a person is asked."""
    guard_program_sha256: str | None = None
    replaces: bool = True
    """The record is to take the place of the configured one, not to lie beside it."""


@dataclass(slots=True)
class Outcome:
    """What has been found so far."""

    identity: str = ""
    guard_version: int | None = None
    moving: str = ""
    """The axis that is being moved and is not proved yet."""
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
        self._say = dialogue.say
        self._instruments = instruments
        self._history = history
        self._today = today
        self._log = log
        version_macro = configuration.cnc.macros.echo_guard_version
        self._movement = Movement(station, dialogue, patience_s=plan.patience_s, version_macro=version_macro)
        self._outcome = Outcome()

    async def run(self) -> CommissioningRecord | None:
        """Go through all steps; None with `initialise_only`.

        Whatever ends it early (a refusal, a lost link, Ctrl-C), the offsets go back to zero first, as far as
        that is possible, and what is left is said. Raises CommissioningRefusedError or DriverError afterwards.
        """
        refuse_insecure(self._configuration)
        if not self._plan.initialise_only:
            refuse_shipped(self._configuration.compensation.commissioning_file)
            refuse_unchecked(self._configuration)
        refuse_offset(self._configuration, self._plan.axes, self._plan.offset_um)
        self._event(f"begun by {_login()}")
        try:
            await self._prepare()
            if self._plan.initialise_only:
                self._event("macro variables initialised; ended as asked")
                return None
            beside = [] if self._log is None else [self._log.follow()]
            await self._station.supervise(self._prove(), *beside)
        except BaseException as error:
            self._set_aside(error)
            await SafeExit(self._station, self._movement, self._dialogue, self._event).leave(error)
            self._set_aside(error)  # on the way back it was seen whether the guard had run meanwhile
            raise
        finally:
            await self._station.control.close()
        record = self._record()
        self._event(f"proved: {', '.join(record.axes)}")
        return record

    def _set_aside(self, error: BaseException) -> None:
        """Let the record of before count no more where it is disproved, or a person may have seen its axis go wrong."""
        moving = self._outcome.moving if self._plan.replaces and self._station.moved else ""
        if isinstance(error, asyncio.CancelledError | UnreadError) and moving:
            error = DisprovedError("a person has broken off what was to prove it", moving)
        if told := set_aside(self._configuration.compensation.commissioning_file, error):
            self._event(told)
            self._say(told)

    def _event(self, text: str) -> None:
        self._history.event("commissioning", text, self._plan.person)

    async def _agree(self, question: str) -> None:
        if not await self._dialogue.confirm(question):
            raise CommissioningRefusedError(f"you said no to: {question}")

    # --- preconditions and the variables -------------------------------------------------

    async def _prepare(self) -> None:
        station, configuration = self._station, self._configuration
        await station.connect()
        refuse_clock(station.clock, station.control.identity)
        self._outcome.identity = station.control.identity
        sample = await station.control.look()
        refuse_state(sample, configuration)
        security = (
            "encrypted and signed" if station.control.security == "encrypted" else "NOT secure (allow_insecure_writes)"
        )
        control = f"Control {station.control.identity}, {security}"
        self._say(f"{control}; O{sample.program}, {sample.mode.value}, {sample.run.value}")
        await self._agree(f"Is this the control of {configuration.machine!r}?")
        sample = await self._initialise(sample)
        refuse_state(sample, configuration)
        if not self._plan.initialise_only and (number := told_text(configuration)) is not None:
            told = (await station.control.read((number,)))[number]
            refuse_other_speed_program(configuration, told)
            self._say(f"The speed program is the configuration's: text {told:g}.")
        station.take_over(sample)
        StateStore(self._history, station.clock).put(WantedAxes(axes=dict.fromkeys(station.axes, False)))

    async def _initialise(self, sample: CncSample) -> CncSample:
        station = self._station
        found = station.control.block_found(sample)
        if found.foreign:
            await self._overwrite(found)
        elif found.vacant:
            await self._agree(f"Set the vacant variables {_numbers(found.vacant)} to 0?")
        speed = self._configuration.spindle_speed
        at_rest = {self._configuration.cnc.macros.valid_until, None if speed is None else speed.macros.valid_until}
        numbers = (*found.vacant, *(number for number in found.foreign if number not in at_rest))
        if numbers:
            await station.control.initialise(numbers, found, self._plan.person)
            self._event(f"initialised {_numbers(numbers)}")
            self._say(f"Initialised: {_numbers(numbers)}")
        else:
            self._say("The macro variables of the block are initialised.")
        return await station.control.look()

    async def _overwrite(self, found: BlockFound) -> None:
        self._say(
            "These variables are configured as ours, but hold values that Toolpoint has not written: "
            f"{found.foreign_in_words}. Another program may use them. They would be set to 0."
        )
        if not self._plan.overwrite_foreign and not await self._dialogue.confirm_expressly("Overwrite them?"):
            raise CommissioningRefusedError(
                f"foreign values were left alone: {found.foreign_in_words}. Choose other numbers in cnc.macros, or, if "
                "nothing uses these, say yes or give --overwrite-foreign"
            )
        self._event(f"foreign values overwritten: {found.foreign_in_words}")

    # --- the proof -----------------------------------------------------------------------

    async def _prove(self) -> None:
        self._outcome.guard_version = await self._movement.hear_guard()
        await self._start_from_zero()
        for axis in self._plan.axes:
            proved = self._outcome.axes[axis] = await self._prove_axis(axis)
            self._outcome.moving = ""
            self._event(f"axis {axis}: {_in_words(proved)}")
            self._set_aside(DisprovedError("it is proved to move so now", axis, proved.measured_um / proved.written_um))
        if self._station.echo.guard_version != self._outcome.guard_version:
            raise CommissioningRefusedError(
                f"the guard was exchanged during the commissioning: version {self._station.echo.guard_version} now, "
                f"{self._outcome.guard_version} at the beginning; begin again"
            )
        await self._movement.switch_off()

    async def _start_from_zero(self) -> None:
        station = self._station
        station.command_um = station.target_um = station.echo.applied_um.copy()
        if station.applied(np.zeros(len(station.axes))) and not any(station.enable):
            return
        found = ", ".join(f"{axis} {um:.2f} um" for axis, um in zip(station.axes, station.echo.applied_um, strict=True))
        await self._agree(f"The guard still applies an offset ({found}). Take it back to zero first?")
        await self._movement.to_zero()
        await self._movement.switch_off()

    async def _prove_axis(self, axis: str) -> CommissionedAxis:
        limits = self._configuration.compensation.outputs[axis]
        if limits.slope is not None:
            return await self._prove_slope(axis, limits)
        station, offset_um = self._station, self._plan.offset_um
        index = station.axes.index(axis)
        minutes = abs(offset_um) / limits.slew_um_per_min
        self._say(
            f"Axis {axis}: {offset_um:+g} um, at {limits.slew_um_per_min:g} um/min ({minutes:.1f} min); read by "
            f"{self._instruments.observed_by(axis)}. If the instrument moves by more than twice that, press Ctrl-C."
        )
        await self._agree(f"Is the instrument along {axis} in place, and the tool away from work and fixture?")
        taken = {Moment.BEFORE: await self._read(axis, Moment.BEFORE)}
        station.enable = [other == axis for other in station.axes]
        self._outcome.moving, station.moved = axis, False
        await self._movement.move(index, offset_um)
        taken[Moment.AT_OFFSET] = await self._read(axis, Moment.AT_OFFSET)
        await self._movement.move(index, 0.0)
        taken[Moment.AFTER] = await self._read(axis, Moment.AFTER)
        return self._judged(axis, offset_um, taken)

    async def _prove_slope(self, axis: str, limits: AxisConfig) -> CommissionedAxis:
        station, plan = self._station, self._plan
        index = station.axes.index(axis)
        positions = await positions_of(axis, limits, plan.positions, self._dialogue)
        increment_um = self._configuration.cnc.guard.increment_mm * UM_PER_MM
        assert limits.slope is not None
        um_per_m = slope_to_write(axis, limits, plan.offset_um, positions, increment_um)
        moves_um = um_per_m * (positions[1] - positions[0]) / 1000.0
        self._say(
            f"Axis {axis}: a slope of {um_per_m:+g} um/m, which moves {positions[1]:g} mm by {moves_um:+.2f} um "
            f"against {positions[0]:g} mm; read at both by {self._instruments.observed_by(axis)}."
        )

        arrived = None if self._configuration.cnc.is_sinumerik else self._movement.arrived

        async def read(moment: Moment) -> dict[str, Reading]:
            self._refuse_motion(axis, moment)
            readings = await read_at(axis, limits, moment, positions, self._instruments, self._dialogue, arrived)
            await station.next_beat()
            self._refuse_motion(axis, moment)
            refuse_noise(axis, moves_um, readings[axis])
            return readings

        taken: dict[Moment, Mapping[str, Reading]] = {Moment.BEFORE: await read(Moment.BEFORE)}
        station.enable = [other == axis for other in station.axes]
        self._outcome.moving, station.moved = axis, False
        await self._movement.move(index, um_per_m)
        taken[Moment.AT_OFFSET] = await read(Moment.AT_OFFSET)
        await self._movement.move(index, 0.0)
        taken[Moment.AFTER] = await read(Moment.AFTER)
        proved = self._judged(axis, moves_um, taken)
        seen = CommissionedSlope(of=limits.slope.of, pivot_mm=limits.slope.pivot_mm, positions_mm=positions)
        return proved.model_copy(update={"slope": seen})

    def _judged(self, axis: str, written_um: float, taken: Mapping[Moment, Mapping[str, Reading]]) -> CommissionedAxis:
        turned, scaled = axis in self._plan.accept_reversed, axis in self._plan.accept_scale
        found = judge(axis, written_um, taken, accept_reversed=turned, accept_scale=scaled)
        self._say(f"Axis {axis}: {_in_words(found)}")
        return found

    async def _read(self, axis: str, moment: Moment) -> Mapping[str, Reading]:
        station = self._station
        self._refuse_motion(axis, moment)
        offsets = [each for each in station.axes if each not in self._configuration.compensation.slopes]
        readings = await self._instruments.take(axis, moment, offsets)
        await station.next_beat()
        self._refuse_motion(axis, moment)
        refuse_noise(axis, self._plan.offset_um, readings[axis])
        return readings

    def _refuse_motion(self, axis: str, moment: Moment) -> None:
        """Refuse a reading, before and after it is taken, unless the guard applies what was asked."""
        station = self._station
        if not station.applied(station.target_um) or np.any(station.command_um != station.target_um):
            raise CommissioningRefusedError(
                f"axis {axis}: the guard did not apply what was asked while the instrument was read {WORDS[moment]}: "
                "the reading proves nothing; find what moves the axis, and begin again"
            )

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


def _login() -> str:
    """Return whose account this runs under, for the audit."""
    uid = os.getuid()
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = "unknown"
    caller = os.environ.get("SUDO_USER")
    return f"{name} (uid {uid}{f', called by {caller}' if caller else ''})"


def _numbers(numbers: tuple[int, ...]) -> str:
    return ", ".join(f"#{number}" for number in numbers)


def _in_words(found: CommissionedAxis) -> str:
    others = ", ".join(f"{axis} {um:+.2f} um" for axis, um in found.others_um.items())
    return (
        f"{found.written_um:+g} um moved it by {found.measured_um:+.2f} um, sign {found.sign:+d}, "
        f"scale {found.scale:g}; others: {others or 'not observed'}"
    )
