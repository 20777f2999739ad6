"""What a person at the machine must be told about the output."""

from collections.abc import Iterator

from config.schema.compensation import OutputConfig
from daemon.output.guard_watch import GuardWatch
from daemon.output.macro_block import Echo
from models.output import OutputMemory
from models.records import OutputState

REFUSALS = 2
"""A single torn read is no alarm: the block was being written."""
ASKS_THE_GUARD = (OutputState.ACTIVE, OutputState.HOLD, OutputState.RETREAT)
"""States in which the guard has an offset to bring, to keep or to take out."""


def alarm_of(
    memory: OutputMemory,
    echo: Echo | None,
    *,
    now_s: float,
    guard: GuardWatch,
    config: OutputConfig,
    obstacle: str,
) -> str:
    """Return the alarm that the output's state calls for, '' when there is none."""
    if memory.state is OutputState.FAULT:
        return f"FAULT: {memory.reason}; `toolpoint acknowledge` clears it"
    return "; ".join(_alarms(memory, echo, now_s, guard, config, obstacle))


def _alarms(
    memory: OutputMemory, echo: Echo | None, now_s: float, guard: GuardWatch, config: OutputConfig, obstacle: str
) -> Iterator[str]:
    """Yield what is wrong at the guard, and what has been held for too long."""
    if memory.state in ASKS_THE_GUARD and guard.refusals >= REFUSALS and echo is not None:
        yield f"the guard does not apply the block (status {echo.status}, see docs/reference/macros.md)"
    elif memory.state in (OutputState.ACTIVE, OutputState.RETREAT) and guard.silent_s > config.guard_alarm_after_s:
        yield (
            f"the guard has not run for {config.guard_alarm_after_s / 60:g} min while the program ran, so nothing that "
            "is written reaches the tool: check that the program calls it at its safe points"
        )
    if memory.state is OutputState.HOLD and now_s - memory.since_s > config.alarm_after_s:
        yield f"held for longer than {config.alarm_after_s:g} s: {obstacle or memory.reason}"
