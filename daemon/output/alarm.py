"""What a person at the machine must be told about the output."""

from config.schema.compensation import OutputConfig
from daemon.output.macro_block import Echo
from models.output import OutputMemory
from models.records import OutputState

GUARD_CONTENT = (0, 1)
"""Echo status while the guard has nothing against the block: applied, or nothing enabled."""


def alarm_of(
    memory: OutputMemory,
    echo: Echo | None,
    *,
    now_s: float,
    guard_silent_s: float,
    config: OutputConfig,
    obstacle: str,
) -> str:
    """Return the alarm that the output's state calls for, '' when there is none."""
    if memory.state is OutputState.FAULT:
        return f"FAULT: {memory.reason}; `toolpoint acknowledge` clears it"
    status = None if echo is None else echo.status
    if memory.state is OutputState.ACTIVE and status not in (None, *GUARD_CONTENT):
        return f"the guard does not apply the block (status {status}, see docs/reference/macros.md)"
    if memory.state in (OutputState.ACTIVE, OutputState.RETREAT) and guard_silent_s > config.guard_alarm_after_s:
        return (
            f"the guard has not run for {guard_silent_s / 60:.0f} min while the program ran, so nothing that is "
            "written reaches the tool: check that the program calls it at its safe points"
        )
    held_s = now_s - memory.since_s
    if memory.state is OutputState.HOLD and held_s > config.alarm_after_s:
        return f"held for {held_s:.0f} s: {obstacle or memory.reason}"
    return ""
