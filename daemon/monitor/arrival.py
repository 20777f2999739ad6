"""Whether temperatures still arrive: each cycle judges the sensors anew, so none does when every line is silent."""

import time

from config.schema import Configuration
from daemon.snapshots import ThermalSnapshot
from models.cleanse import HELD_PERIODS


def too_old(thermal: ThermalSnapshot, configuration: Configuration) -> bool:
    """Return whether the latest cycle of any line was longer ago than a value counts."""
    latest = thermal.temperatures
    age_s = 0.0 if latest is None else time.monotonic() - latest.trace.last_byte.real_s
    period_s = configuration.temperatures.shortest_period_s
    return age_s > max(configuration.temperatures.cleansing.stale_after_s, HELD_PERIODS * period_s)
