"""The alarms of the output, as sentences for the person at the machine."""

from collections.abc import Callable, Iterator

import numpy as np

from config.schema.compensation import OutputConfig
from daemon.cnc.macro_block import UNFINISHED, Echo
from models.control.state import Inhibit, OutputMemory
from models.records import CncRun, CncSample, CompensationCommand, OutputState
from models.thermal.estimation import UNSURE_UM

REFUSALS = 2
"""A single torn read is no alarm: the block was being written."""
BROKEN_OFF_S = 5.0
"""A run of the guard that has begun to apply ends sooner, or has been broken off [s]."""
ASKS_THE_GUARD = (OutputState.ACTIVE, OutputState.HOLD, OutputState.RETREAT)
"""States in which the guard has an offset to bring, to keep or to take out."""


class GuardWatch:
    """Counts the time in which the program runs and the time in the guard's echo stands still."""

    def __init__(self, config: OutputConfig) -> None:
        self.config = config
        self._echo_time_s: float | None = None
        self._previous_s: float | None = None
        self.silent_s = 0.0
        """Time of running program since the guard's last run [s]."""
        self.refusals = 0
        """Runs of the guard, one after the other, that took nothing over."""
        self.nearing = 0
        """Runs, one after the other, that moved a slope by a step, and left it short of where its axis stands."""
        self.unfinished_s = 0.0
        """Time for which a run has not ended that began to apply [s]."""

    def follow(self, echo: Echo, sample: CncSample) -> None:
        now_s = sample.time.monotonic_s
        if echo.time_s != self._echo_time_s:
            self.silent_s = 0.0
            self.refusals = 0 if echo.status in (*GUARD_CONTENT, NEARING) else self.refusals + 1
            self.nearing = self.nearing + 1 if echo.status == NEARING else 0
        elif sample.run is CncRun.START and self._previous_s is not None:
            self.silent_s += now_s - self._previous_s
        ran = echo.status != UNFINISHED or self._previous_s is None
        self.unfinished_s = 0.0 if ran else self.unfinished_s + now_s - (self._previous_s or 0.0)
        self._echo_time_s, self._previous_s = echo.time_s, now_s


def alarm_of(
    memory: OutputMemory,
    command: CompensationCommand | None,
    echo: Echo | None,
    *,
    now_s: float,
    guard: GuardWatch,
    inhibit: Callable[[], Inhibit | None],
) -> str:
    """Return the alarm that the output's state calls for, '' when there is none; `inhibit`: why nothing is followed."""
    if memory.state is OutputState.FAULT:
        return f"FAULT: {memory.reason}; `toolpoint acknowledge` clears it"
    beyond = _beyond_bounds(memory, command) if command is not None else ()
    return "; ".join([*_alarms(memory, echo, now_s, guard, inhibit), *beyond])


def _beyond_bounds(memory: OutputMemory, command: CompensationCommand) -> Iterator[str]:
    """Yield on which axes the estimate asks for more than may be applied: the tool is not where it should be."""
    if memory.state is not OutputState.ACTIVE:
        return
    short_um = np.abs(command.requested_um - command.compensation_um)
    for axis, um, wanted in zip(command.axes, short_um, memory.wanted, strict=True):
        hit = [limit for limit in command.limits_hit if limit.partition(":")[0] == axis]
        if wanted and um > UNSURE_UM and hit == [f"{axis}:bound"]:  # on its way it has met others too
            yield (
                f"axis {axis} has reached its bound: it stands {um:.1f} um short of what the estimate asks for; take "
                "the offset out (`toolpoint disable --zero`), position the work anew and switch on, or see why it goes "
                "so far"
            )


def _alarms(
    memory: OutputMemory,
    echo: Echo | None,
    now_s: float,
    guard: GuardWatch,
    inhibit: Callable[[], Inhibit | None],
) -> Iterator[str]:
    """Yield what is wrong at the guard, and what has been held for too long."""
    config = guard.config
    if memory.state in ASKS_THE_GUARD and guard.unfinished_s > BROKEN_OFF_S:
        yield (
            "a run of the guard was broken off (status 14), so what is applied may be a step further than it says: "
            "call the guard with the tool clear of the work, and position the work after that"
        )
    elif memory.state in ASKS_THE_GUARD and max(guard.refusals, guard.nearing) >= REFUSALS and echo is not None:
        of_slope = SLOPE_SAYS.get(echo.status or 0)
        yield of_slope or f"the guard does not apply the block (status {echo.status}, see docs/reference/macros.md)"
    elif memory.state in (OutputState.ACTIVE, OutputState.RETREAT) and guard.silent_s > config.guard_alarm_after_s:
        yield (
            f"the guard has not run for {config.guard_alarm_after_s / 60:g} min while the program ran, so nothing that "
            "is written reaches the tool: check that the program calls it at its safe points"
        )
    if memory.state is OutputState.HOLD and now_s - memory.since_s > config.alarm_after_s:
        yield f"held for longer than {config.alarm_after_s:g} s: {inhibit() or memory.reason}"


GUARD_CONTENT = (None, 0, 1)
"""Echo status while the guard has nothing against the block: never run, applied, or nothing enabled."""
PLACE, NEARING = 12, 13
SLOPE_SAYS = {
    PLACE: "the guard applies nothing of the block, of any axis: one with a slope stands outside its travel, or the "
    "control does not say where (status 12): call the guard where the work is, or give slope.travel_mm of that axis "
    "its whole travel and load the text that `toolpoint guard` prints",
    NEARING: "the guard applies the block, but a slope is not yet in for where its axis stands (status 13): a call "
    "moves it by one step, and the axis stood elsewhere each time; let the program call the guard again, the axis "
    "standing where the work is, until the status is another",
}
"""What it says by its status where it has a slope to put in for where the axis stands."""
