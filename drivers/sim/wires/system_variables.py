"""System variables that a simulated control shows on more than one wire: clock, calendar, unit, external offset.

Date and time follow from the count of power-ons, one power-on a day, so that they agree with the clock.
"""

import math
import time

from drivers.power_on import CLOCK, DATE, TIME
from drivers.sim.contract import SimulatedNc
from drivers.sim.nc.custom_macro.control import EXTERNAL_OFFSET, TIMER_WRAP_MS

FIRST_POWER_ON_S = 1_600_000_000 // 86_400 * 86_400 + 300.0
"""The simulated control's calendar at its power-on number 0: five minutes past midnight [s]."""
DAY_S = 86_400.0
UNIT_CODE, METRIC = 4006, 21


def system_variable(nc: SimulatedNc, number: int) -> float | None:
    """Return #3001, #3011, #3012, #4006 or #5201.., None for another variable."""
    if number == CLOCK:
        return float(math.floor(nc.clock_s * 1000.0 + 1e-6) % TIMER_WRAP_MS)
    if number == UNIT_CODE:
        return float(METRIC)
    if (axis := number - EXTERNAL_OFFSET - 1) in range(len(nc.external_mm)):
        return nc.external_mm[axis]
    if number not in (DATE, TIME):
        return None
    now = time.gmtime(FIRST_POWER_ON_S + nc.power_on_count * DAY_S + nc.clock_s)
    if number == DATE:
        return float(now.tm_year * 10_000 + now.tm_mon * 100 + now.tm_mday)
    return float(now.tm_hour * 10_000 + now.tm_min * 100 + now.tm_sec)
