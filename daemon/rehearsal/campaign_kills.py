"""When the daemon of a fault campaign is to die, and how much memory it holds while it lives."""

from daemon.rehearsal.campaign_process import DaemonProcess
from drivers.sim.campaign_script import Happening

WARM_UP_S = 3600.0
MEMORY_LOOK_S = 600.0


class KillPlan:
    """Kills at once, or after some groups of a block."""

    def __init__(self, sequence_a: int) -> None:
        self._sequence_a = sequence_a
        self._after_groups: tuple[int, Happening] | None = None
        self.due: Happening | None = None
        """Why the daemon is to die now; None while it may live."""

    def in_write(self, happening: Happening) -> None:
        """Kill after so many groups of the next block."""
        self._after_groups = (int(happening.amount), happening)

    def clear(self) -> None:
        """Forget what is planned: the daemon is dead."""
        self.due = self._after_groups = None

    def before(self, group: tuple[tuple[int, float], ...]) -> bool:
        """Tell whether the daemon is to die before this group."""
        if self._after_groups is None:
            return False
        left, happening = self._after_groups
        begins = group[0][0] == self._sequence_a
        if not begins and left == int(happening.amount):
            return False
        if left == 0:
            self.due = happening
            return True
        self._after_groups = (left - 1, happening)
        return False


class MemoryWatch:
    """Follows the resident memory of each life and each model from the first hour on."""

    def __init__(self, warm_up_s: float) -> None:
        self._warm_up_s = warm_up_s
        self._began_s = self._next_s = 0.0
        self._at_start_mib: float | None = None
        self.rss_mib = 0.0
        self.growth_mib = 0.0
        """The most that it has grown in one life with one model [MiB]."""

    def restarted(self, time_s: float) -> None:
        """A life begins, or the work of another model, which takes memory of its own."""
        self._began_s = self._next_s = time_s
        self._at_start_mib = None

    def due(self, time_s: float) -> bool:
        """Tell whether it is time to look again; if so, the next time is a while later."""
        if time_s < self._next_s:
            return False
        self._next_s = time_s + MEMORY_LOOK_S
        return True

    def look(self, time_s: float, process: DaemonProcess) -> None:
        """Look at the process."""
        if time_s - self._began_s < self._warm_up_s:
            return
        self.rss_mib = process.rss_mib()
        if self._at_start_mib is None:
            self._at_start_mib = self.rss_mib
        self.growth_mib = max(self.growth_mib, self.rss_mib - self._at_start_mib)
