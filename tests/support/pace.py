"""How fast a simulation in several processes may run beside whatever else this computer does."""

import os
import time

SAMPLE_S = 0.1
"""So long it is tried how much of a core is left [s of CPU time]."""
SLOWEST = 4.0
"""Below this speed nothing is gained [s of the simulation per s]."""


def crowding() -> float:
    """Return how much longer work takes here now than on an idle computer, at least 1."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    while time.process_time() - cpu_s < SAMPLE_S:
        pass
    waited = (time.perf_counter() - wall_s) / SAMPLE_S
    return max(1.0, waited, os.getloadavg()[0] / (os.cpu_count() or 1))


def bearable(speed: float) -> float:
    """Return the speed of a simulation at which this computer leaves it as much time as an idle one at `speed`."""
    return max(SLOWEST, speed / crowding())
