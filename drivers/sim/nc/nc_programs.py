"""When the simulated NC runs which of its programs: the guard at safe points, a request where the program asks."""

from collections import deque
from collections.abc import Callable

import numpy as np

from drivers.sim.nc.nc import NumericalControl
from drivers.sim.nc.program import Block
from drivers.sim.nc.safe_point import SafePointApplication

GUARD_PERIOD_S = 1.0
"""In a safe point the guard is called on entry and then once in this time [s]."""
REFERENCE, PROBE, TOOL_CHANGE = 1.0, 2.0, 3.0
"""Kinds of request."""
MACRO_ALARM = 3000
"""#3000 = n shows as alarm 3000 + n."""
UM_PER_MM = 1000.0


class NcPrograms:
    """Runs the NC's macro programs over simulated time, block of the part program by block."""

    def __init__(
        self, application: SafePointApplication, nc: NumericalControl, turn: Callable[[float, float, float], None]
    ) -> None:
        """`turn(time_s, programmed_rpm, taken_rpm)` is called at the end of the speed program."""
        self._application = application
        self._nc = nc
        self._turn = turn
        self._called_rpm: float | None = None
        """Speed that the speed program was called for, while it is under way [1/min]."""
        self._axis_number = {axis: float(n) for n, axis in enumerate(application.axes, start=1)}
        self._queue: deque[tuple[int, dict[str, float]]] = deque()
        """Programs that the present block still has to begin, with their arguments."""
        self._resume_s = np.inf
        """When the program that waits goes on, or the next one begins."""
        self._next_guard_s = np.inf
        self._at_safe_point = False

    @property
    def waits_until_s(self) -> float | None:
        """When the program that is under way looks again [s]; None while none is."""
        return self._resume_s if self._busy else None

    @property
    def _busy(self) -> bool:
        return self._application.interpreter.running or bool(self._queue)

    def enter(self, block: Block, time_s: float, *, probed_um: float | None) -> None:
        """Begin a block of the part program: what it asks for, the guard at a safe point; an alarm has ended."""
        programs = self._application.programs
        self._nc.alarm = 0
        self._application.control.alarm = None
        self._next_guard_s = np.inf
        self._resume_s = time_s
        if self._at_safe_point and programs.leave is not None:
            self._queue.append((programs.leave, {}))
        self._at_safe_point = block.kind == "safe"
        if block.kind == "positioning":
            self._request(K=REFERENCE)
        if block.tool_number is not None:
            self._request(K=TOOL_CHANGE, V=float(block.tool_number))
        if block.tool_setting is not None:
            self._request(K=REFERENCE, A=self._axis_number[block.tool_setting])
        if block.probe is not None and probed_um is not None:
            self._request(K=PROBE, A=self._axis_number[block.probe], V=probed_um / UM_PER_MM)
        if self._at_safe_point:
            self._queue.append((programs.guard if programs.enter is None else programs.enter, {}))
            self._next_guard_s = time_s + GUARD_PERIOD_S
        if block.speed_call is not None and (speed := self._application.speed_program) is not None:
            call = block.speed_call
            arguments = {"S": call.speed_rpm, "F": call.feed_mm_min, "D": call.depth_mm, "E": call.radial_mm}
            self._queue.append((speed.number, arguments))

    def run_until(self, end_s: float) -> None:
        """Do everything that falls due before `end_s` [s]."""
        while True:
            if not self._busy and self._next_guard_s < end_s:
                self._resume_s = self._next_guard_s
                self._queue.append((self._application.programs.guard, {}))
            if not self._busy or self._resume_s >= end_s:
                return
            self._go_on()

    def power_cycle(self) -> None:
        """Forget what was under way."""
        self._queue.clear()
        self._called_rpm = None
        self._resume_s = self._next_guard_s = np.inf
        self._at_safe_point = False
        self._application.power_cycle()
        if (start := self._application.programs.start) is not None:  # as the control calls it after power-on
            self._queue.append((start, {}))

    def _request(self, **arguments: float) -> None:
        if self._application.programs.request is not None:
            self._queue.append((self._application.programs.request, arguments))

    def _go_on(self) -> None:
        """Run to the next dwell or to the end of the program."""
        at_s = self._resume_s
        interpreter = self._application.at(self._nc.macros, self._nc.clock_at(at_s))
        self._application.control.tool_number = self._nc.tool_number
        if not interpreter.running:
            number, arguments = self._queue.popleft()
            interpreter.start(number, **arguments)
            speed = self._application.speed_program
            self._called_rpm = arguments["S"] if speed is not None and number == speed.number else None
            if number in (self._application.programs.guard, self._application.programs.enter):
                self._next_guard_s = at_s + GUARD_PERIOD_S
        self._resume_s = at_s + (interpreter.wait() or 0.0)
        if (alarm := self._application.control.alarm) is not None:
            self._nc.alarm = MACRO_ALARM + alarm[0]
            self._queue.clear()
            self._next_guard_s = np.inf
        elif self._called_rpm is not None and not interpreter.running:
            self._turn(at_s, self._called_rpm, self._application.control.spindle_rpm)
            self._called_rpm = None
