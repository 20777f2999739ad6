"""The simulated CNC of a fault campaign: answers as a healthy one, or slowly, wrongly or not at all."""

import random
from collections.abc import Callable, Sequence
from typing import Any

from config.schema.cnc import MacroMapConfig
from daemon.simulation.faults.script import Happening, Incident
from drivers.sim.faults import FaultKind
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.program import POSITIONING

Answer = tuple[str, float, Any]
"""Verdict (ok, lost, silent, refused), delay [s], content."""

FOREIGN_UM = 7.3
"""What a foreign program adds to a value [um]."""
LIE_UM = 2.0
"""By so much a lying CNC's variable differs from what was written [um]."""
FOREIGN_PROGRAM = 7777
LAST_REQUEST = 999_999
NO_REQUESTS: tuple[tuple[float | None, float | None, float | None], ...] = (
    (2.0, 3.0, None),
    (3.0, 0.0, None),
    (2.5, 3.0, 0.001),
    (2.0, 3.4, 0.001),
    (1.0, 3.4, 0.0),
    (3.0, 0.0, 2.5),
    (3.0, 0.0, 1e300),
    (2.0, 3.0, 1e300),
    (None, 0.0, 0.0),
    (1e9, 0.0, 0.0),
)
"""Kind, axis and value of requests that are none."""


class CncFace:
    """Answers the daemon's calls; records foreign writes, so that the campaign can check that they are found."""

    def __init__(self, machine: CfrpMachine, macros: MacroMapConfig, seed: int) -> None:
        self._machine = machine
        self._map = macros
        self._random = random.Random(f"cnc {seed}")
        self._modes: dict[str, Happening] = {}
        self._dropped = True
        self._cut: Happening | None = None
        self._groups = 0
        self._program = machine.nc.program
        self._passed = 0
        """The block that the program showed before a positioning that nobody saw."""
        self._tampered: dict[int, tuple[float | None, float | None]] = {}
        self.proof = ""
        """What the daemon has been shown that it must not trust, '' when there is nothing."""

    @property
    def reachable(self) -> bool:
        """A call would be answered."""
        return not ({FaultKind.FROZEN_CNC, FaultKind.KILLED_CNC} & self._modes.keys())

    # --- calls ---------------------------------------------------------------------------

    def connect(self) -> Answer:
        verdict = self._trouble(new=True)
        if verdict == "ok":
            self._dropped, self._cut = False, None  # what would have cut the connection before cuts no other
        return verdict, self._delay_s(), None

    def read(self, numbers: Sequence[int]) -> Answer:
        """Answer a poll: the NC's state and macro variables."""
        nc = self._machine.nc
        state = (
            int(nc.mode),
            int(nc.run),
            nc.alarm,
            nc.program,
            nc.sequence_number,
            nc.spindle_speed_rpm,
            nc.motor_temperature_degc,
            nc.clock_s,
            nc.power_on_count,
            nc.work_offset,
            nc.tool_number,
        )
        return self._shown(numbers, lambda values: (state, values))

    def read_macros(self, numbers: Sequence[int]) -> Answer:
        return self._shown(numbers, lambda values: values)

    def read_back(self) -> dict[int, float | None]:
        """Return our macros and the echo, for a daemon that reads them back at once; nothing when it must ask."""
        if self._modes or self._dropped:
            return {}
        shown = {number: self._machine.nc.macros.get(number) for number in self._map.block}
        self._note_what_is_shown(shown)
        return shown

    def write(self, group: Sequence[tuple[int, float]]) -> Answer:
        """Take one group of a block, or do not; the content says whether it was taken, whatever the daemon hears."""
        if group[0][0] == self._map.sequence_a:
            self._groups = 0
        verdict = self._trouble()
        if verdict != "ok":
            return verdict, self._delay_s(), False
        if self._cut is not None and self._groups >= int(self._cut.amount):
            arrives = int(self._cut.target or 0) % 2 == 0
            self._cut, self._dropped = None, True
            if arrives:
                self._store(group)
            return "lost", 0.0, arrives
        self._groups += 1
        values = set(self._map.values.values())
        ours = [number for number, _ in group if number in values]
        if ours and Incident.REFUSING_CNC in self._modes:
            self.proof = self.proof or "a write was refused"
            return "refused", self._delay_s(), f"macro variable #{ours[0]}: BadUserAccessDenied"
        self._store(group)
        if ours and Incident.LYING_CNC in self._modes:
            number = ours[int(self._modes[Incident.LYING_CNC].target or 0) % len(ours)]
            self._tamper(number, (self._machine.nc.macros.get(number) or 0.0) + LIE_UM / self._map.unit_um)
        return "ok", self._delay_s(), True

    def forget_connection(self) -> None:
        """No client is connected any more."""
        self._dropped = True

    def _store(self, group: Sequence[tuple[int, float]]) -> None:
        for number, value in group:
            self._tampered.pop(number, None)
            self._machine.nc.macros.set(number, value)

    def _trouble(self, *, new: bool = False) -> str:
        if FaultKind.FROZEN_CNC in self._modes:
            return "silent"
        if FaultKind.KILLED_CNC in self._modes or (self._dropped and not new):
            return "lost"
        return "ok"

    def _delay_s(self) -> float:
        slow = self._modes.get(Incident.SLOW_CNC)
        return 0.0 if slow is None else self._random.uniform(0.0, slow.amount)

    def _shown(self, numbers: Sequence[int], content: Callable[[tuple[float | None, ...]], Any]) -> Answer:
        verdict = self._trouble()
        if verdict != "ok":
            return verdict, self._delay_s(), None
        values = tuple(self._machine.nc.macros.get(number) for number in numbers)
        self._note_what_is_shown(dict(zip(numbers, values, strict=True)))
        return "ok", self._delay_s(), content(values)

    # --- incidents -----------------------------------------------------------------------

    def begin(self, happening: Happening, time_s: float) -> None:
        """Let an incident of the CNC begin; others are not for here."""
        kind, which = happening.kind, happening.target
        macros = self._machine.nc.macros
        block = self._map
        ours = (*block.values.values(), block.enable, block.sequence_b, *([] if block.check is None else [block.check]))
        match kind:
            case (
                FaultKind.FROZEN_CNC
                | FaultKind.KILLED_CNC
                | Incident.SLOW_CNC
                | Incident.REFUSING_CNC
                | Incident.LYING_CNC
            ):
                self._modes[kind] = happening
                self._dropped |= kind is FaultKind.KILLED_CNC
            case Incident.CUT_WRITE if not self._dropped:
                self._cut = happening
            case Incident.FOREIGN_WRITE:
                number = ours[int(which or 0) % len(ours)]
                change = FOREIGN_UM / self._map.unit_um if number in self._map.values.values() else 17.0
                self._tamper(number, (macros.get(number) or 0.0) + change)
            case Incident.VACANT_MACRO:
                self._tamper(ours[int(which or 0) % len(ours)], None)
            case Incident.ECHO_VACANT | Incident.ECHO_NONSENSE:
                self._falsify_echo(happening)
            case Incident.POWER_CYCLE:
                self._machine.power_cycle()
                self._dropped = True
            case Incident.OTHER_PROGRAM:
                self._machine.nc.program = FOREIGN_PROGRAM
            case Incident.WORK_OFFSET:
                self._machine.nc.work_offset += 1
            case Incident.MISSED_POSITIONING:
                self._modes[FaultKind.FROZEN_CNC] = happening
                self._passed = self._machine.nc.sequence_number
                self._machine.nc.sequence_number = POSITIONING
            case Incident.FOREIGN_REQUEST:
                self._ask_nonsense(int(which or 0))

    def end(self, happening: Happening) -> None:
        kind = happening.kind
        if self._modes.get(kind) is happening:
            del self._modes[kind]
        if kind is Incident.MISSED_POSITIONING:
            self._modes.pop(FaultKind.FROZEN_CNC, None)
            if self._machine.nc.sequence_number == POSITIONING:
                self._machine.nc.sequence_number = self._passed
        if kind is Incident.OTHER_PROGRAM:
            self._machine.nc.program = self._program
        if kind is Incident.WORK_OFFSET:
            self._machine.nc.work_offset -= 1
        if kind in (Incident.ECHO_VACANT, Incident.ECHO_NONSENSE):
            for axis, number in self._map.echo_applied.items():
                self._machine.nc.macros.set(number, self._machine.guard.applied_um[axis] / self._map.unit_um)

    def repair(self) -> None:
        """Have a person fill what is vacant, as commissioning does."""
        for number, (value, before) in self._tampered.items():
            if value is None and self._machine.nc.macros.get(number) is None:
                self._machine.nc.macros.set(number, before)

    def forgiven(self) -> None:
        """A person has acknowledged: what the CNC holds now counts as known."""
        self._tampered.clear()
        self.proof = ""

    def _tamper(self, number: int, value: float | None) -> None:
        macros = self._machine.nc.macros
        self._tampered[number] = (value, macros.get(number))
        macros.set(number, value)

    def _ask_nonsense(self, which: int) -> None:
        """Let the NC program ask for what is no request, unless it waits for the answer to another one."""
        request, macros = self._map.request, self._machine.nc.macros
        if request is None:
            return
        counter = macros.get(request.counter) or 0.0
        if abs(macros.get(request.acknowledge) or 0.0) != counter:
            return
        kind, axis, value_mm = NO_REQUESTS[which % len(NO_REQUESTS)]
        for number, value in ((request.kind, kind), (request.axis, axis), (request.value_mm, value_mm)):
            macros.set(number, value)
        macros.set(request.counter, counter % LAST_REQUEST + 1.0)

    def _falsify_echo(self, happening: Happening) -> None:
        axes = list(self._map.echo_applied)
        number = self._map.echo_applied[axes[int(happening.target or 0) % len(axes)]]
        macros = self._machine.nc.macros
        if happening.kind is Incident.ECHO_VACANT:
            macros.set(number, None)
        else:
            self._tamper(number, (macros.get(number) or 0.0) + 2000.0 / self._map.unit_um)

    def _note_what_is_shown(self, shown: dict[int, float | None]) -> None:
        for number, (value, _) in list(self._tampered.items()):
            if number not in shown:
                continue
            if shown[number] == value:
                self.proof = self.proof or f"macro #{number} showed {value}"
            else:
                del self._tampered[number]
