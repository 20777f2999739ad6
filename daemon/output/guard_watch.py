"""How long the program has run without the guard."""

from daemon.output.macro_block import Echo
from models.records import CncRun, CncSample

GUARD_CONTENT = (None, 0, 1)
"""Echo status while the guard has nothing against the block: never run, applied, or nothing enabled."""


class GuardWatch:
    """Counts the time in which the program runs and the time in the guard's echo stands still."""

    def __init__(self) -> None:
        self._echo_time_s: float | None = None
        self._previous_s: float | None = None
        self.silent_s = 0.0
        """Time of running program since the guard's last run [s]."""
        self.refusals = 0
        """Runs of the guard, one after the other, that took nothing over."""

    def follow(self, echo: Echo, sample: CncSample) -> None:
        """Take one poll."""
        now_s = sample.time.monotonic_s
        if echo.time_s != self._echo_time_s:
            self.silent_s = 0.0
            self.refusals = 0 if echo.status in GUARD_CONTENT else self.refusals + 1
        elif sample.run is CncRun.START and self._previous_s is not None:
            self.silent_s += now_s - self._previous_s
        self._echo_time_s, self._previous_s = echo.time_s, now_s
