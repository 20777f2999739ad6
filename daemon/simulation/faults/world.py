"""The simulated machine's side of a fault campaign: it owns time, the wires, the CNC's face and the incidents."""

import heapq
import itertools
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from config.schema import Configuration
from config.schema.temperatures import LineConfig
from daemon.simulation.faults.cnc import NO_REQUESTS, CncFace
from daemon.simulation.faults.script import Happening, Incident, wire_faults
from drivers.sim.faults import Fault, FaultKind
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.wires.displacement_wire import DisplacementCsv
from drivers.sim.wires.latsis_encoding import LineTransmitter
from drivers.sim.wires.latsis_wire import PHASE_STEP

Arrival = tuple[float, str, bytes | None]
"""When, on which line, which bytes; None: the port is gone."""
ROW_S = 60.0
SAFE_LOOK_S = 0.5
"""At a safe point the tool is looked at this often: more often than the guard runs [s]."""


class Watcher(Protocol):
    """What observes the machine."""

    def cycle(self, time_s: float, line: str, *, whole: bool, heard: bool) -> None:
        """A pass over a line has ended; `heard`: a listener got bytes of it, `whole`: all of them, undisturbed."""

    def applied(self, time_s: float, applied_um: dict[str, float], cutting: bool) -> None:
        """What the NC applies, and whether the tool is in the work."""

    def asked(
        self, time_s: float, counter: int, kind: int, axis: int, value_mm: float, *, nonsense: bool = False
    ) -> None:
        """The NC program has asked for something."""

    def begun(self, time_s: float, happening: Happening) -> None:
        """Something happens."""

    def ended(self, time_s: float, happening: Happening) -> None: ...


@dataclass(order=True, slots=True)
class _Event:
    time_s: float
    order: int
    outward: bool = field(compare=False)
    """The daemon may notice it: it is told the time then."""
    run: Callable[[], None] = field(compare=False)


class _Line:
    """One line: its transmitter, and its listener."""

    def __init__(self, transmitter: LineTransmitter) -> None:
        self.transmitter = transmitter
        self.listening_since_s = math.inf
        self.disturbed = 0
        self.heard = False


class CampaignWorld:
    """Moves the machine on in simulated time and lets happen what the script says."""

    def __init__(
        self,
        machine: CfrpMachine,
        configuration: Configuration,
        happenings: Sequence[Happening],
        watcher: Watcher,
        *,
        epoch_utc_s: float,
        seed: int,
    ) -> None:
        self.machine = machine
        self.time_s = 0.0
        self.utc_step_s = 0.0
        self.active: set[Happening] = set()
        self.cnc = CncFace(machine, configuration.cnc.macros, seed)
        self._watcher = watcher
        self._request = configuration.cnc.macros.request
        self._request_counter = 0
        self._order = itertools.count()
        self._events: list[_Event] = []
        self._outward: list[float] = []
        self._arrivals: list[Arrival] = []
        self._random = random.Random(f"wires {seed}")
        lines = configuration.temperatures.lines
        faults = wire_faults(happenings, lines)
        devices: dict[int, str] = {sensor.id: sensor.device for sensor in configuration.temperatures.sensors}
        self._lines: dict[str, _Line] = {}
        for index, line in enumerate(lines):
            self._add_line(line, index, devices, faults, seed)
        if configuration.displacements is not None:
            self._logger = DisplacementCsv(
                configuration.displacements, machine.displacement_um, lambda t: epoch_utc_s + t, faults=faults
            )
            self._at(0.0, self._write_row)
        for happening in happenings:
            self._at(happening.at_s, partial(self._begin, happening), outward=True)

    # --- time ----------------------------------------------------------------------------

    @property
    def quiet_until_s(self) -> float:
        """Before this nothing happens that the daemon could notice by itself [s]."""
        return self._outward[0] if self._outward else math.inf

    def at(self, time_s: float, run: Callable[[], None]) -> None:
        """Have something done at a time, noticed by the daemon."""
        self._at(time_s, run, outward=True)

    def every(self, period_s: float, run: Callable[[], None]) -> None:
        """Have something done again and again that the daemon does not notice, on a machine that is up to date."""

        def do() -> None:
            self.move_machine()
            run()
            self._at(self.time_s + period_s, do)

        self._at(self.time_s, do)

    def advance(self, until_s: float) -> None:
        """Move on to `until_s`, or to the first event before it that the daemon may notice."""
        while self._events and self._events[0].time_s <= until_s:
            if self._run_next():
                return
        self.time_s = max(self.time_s, until_s)

    def settle(self, time_s: float) -> None:
        """Let happen what the daemon could not notice before a time at which it asks for something."""
        while self._events and self._events[0].time_s <= time_s and not self._events[0].outward:
            self._run_next()
        self.time_s = max(self.time_s, time_s)

    def arrivals(self) -> list[Arrival]:
        """Return what arrives on the lines, as far as it is known and has not been returned yet."""
        found, self._arrivals = self._arrivals, []
        return found

    def move_machine(self) -> None:
        """Move the machine on to now, and have the tool looked at wherever the guard may have moved it."""
        machine = self.machine
        while machine.time_s < self.time_s:
            at_safe_point = machine.body.block.kind == "safe"
            to_s = min(self.time_s, machine.body.block_end_s, machine.time_s + (SAFE_LOOK_S if at_safe_point else 1e9))
            machine.advance(to_s if to_s > machine.time_s else self.time_s)
            self._watcher.applied(machine.time_s, machine.guard.applied_um, machine.body.block.kind == "cut")
            self._look_for_request()

    def _look_for_request(self) -> None:
        request, macros = self._request, self.machine.nc.macros
        if request is None or (counter := round(macros.get(request.counter) or 0.0)) == self._request_counter:
            return
        self._request_counter = counter
        kind, axis, value_mm = (macros.get(number) for number in (request.kind, request.axis, request.value_mm))
        nonsense = (kind, axis, value_mm) in NO_REQUESTS
        kind, axis, value_mm = kind or 0.0, axis or 0.0, value_mm or 0.0
        self._watcher.asked(self.machine.time_s, counter, round(kind), round(axis), value_mm, nonsense=nonsense)

    def _at(self, time_s: float, run: Callable[[], None], *, outward: bool = False) -> None:
        heapq.heappush(self._events, _Event(time_s, next(self._order), outward, run))
        if outward:
            heapq.heappush(self._outward, time_s)

    def _run_next(self) -> bool:
        event = heapq.heappop(self._events)
        self.time_s = max(self.time_s, event.time_s)
        if event.outward:
            heapq.heappop(self._outward)
        event.run()
        return event.outward

    # --- wires ---------------------------------------------------------------------------

    def _add_line(
        self, line: LineConfig, index: int, devices: dict[int, str], faults: Sequence[Fault], seed: int
    ) -> None:
        phase_s = 1.0 + index * PHASE_STEP % 1 * line.cycle_period_s
        transmitter = LineTransmitter(
            line, devices, self.machine.register_codes, phase_s=phase_s, faults=faults, seed=seed
        )
        state = self._lines[line.name] = _Line(transmitter)
        for fault in faults:
            if fault.kind is FaultKind.UNPLUGGED and fault.target == line.name:
                self._at(fault.at_s, lambda: self._unplug(line.name), outward=True)
        self._plan_pass(line, state, phase_s)

    def _plan_pass(self, line: LineConfig, state: _Line, start_s: float) -> None:
        """Plan a pass: its bytes are read in two pieces, cut anywhere."""
        end_s = start_s + state.transmitter.pass_s + 1e-4
        middle_s = start_s + self._random.uniform(0.02, 0.98) * state.transmitter.pass_s
        self._at(start_s, lambda: self._begin_pass(state, start_s))
        self._at(middle_s, lambda: self._send(line.name, state, (middle_s, end_s)), outward=True)
        self._at(end_s, lambda: self._end_pass(line, state, start_s))

    def _begin_pass(self, state: _Line, start_s: float) -> None:
        self.move_machine()
        state.transmitter.advance(start_s)

    def _send(self, name: str, state: _Line, times_s: tuple[float, ...]) -> None:
        """Send what has left the line by these times, the later ones ahead: nothing that is done here changes it."""
        for at_s in times_s:
            data = state.transmitter.advance(at_s)
            if data and state.listening_since_s <= self.time_s and state.transmitter.plugged(at_s):
                self._arrivals.append((at_s, name, data))
                state.heard = True

    def _end_pass(self, line: LineConfig, state: _Line, start_s: float) -> None:
        undisturbed = state.transmitter.cycles_disturbed == state.disturbed
        state.disturbed = state.transmitter.cycles_disturbed
        listened = state.listening_since_s <= start_s
        self._watcher.cycle(self.time_s, line.name, whole=listened and undisturbed, heard=state.heard)
        state.heard = False
        self._plan_pass(line, state, start_s + line.cycle_period_s)

    def listen(self, name: str) -> bool:
        """Open a line's port; False when it is not there."""
        state = self._lines[name]
        if not state.transmitter.plugged(self.time_s):
            return False
        state.listening_since_s = self.time_s
        return True

    def leave(self, name: str) -> None:
        self._lines[name].listening_since_s = math.inf

    def desert(self) -> None:
        """The daemon's process has ended."""
        for name in self._lines:
            self.leave(name)
        self.cnc.forget_connection()

    def _unplug(self, name: str) -> None:
        if self._lines[name].listening_since_s < math.inf:
            self._arrivals.append((self.time_s, name, None))
        self.leave(name)

    def _write_row(self) -> None:
        self.move_machine()
        self._logger.step(self.time_s)
        self._at(self.time_s + ROW_S / 2, self._write_row)

    # --- incidents -----------------------------------------------------------------------

    def _begin(self, happening: Happening) -> None:
        self.move_machine()
        self.active.add(happening)
        self._watcher.begun(self.time_s, happening)
        if happening.kind is Incident.CLOCK_STEP:
            self.utc_step_s += happening.amount
        else:
            self.cnc.begin(happening, self.time_s)
            self._look_for_request()
        self._at(happening.end_s, lambda: self._end(happening), outward=True)

    def _end(self, happening: Happening) -> None:
        self.move_machine()
        self.active.discard(happening)
        self.cnc.end(happening)
        self._watcher.ended(self.time_s, happening)
