"""The instant of a control's power-on from its own calendar and clock, for protocols that count no power-ons."""

import calendar
import math

CLOCK, DATE, TIME = 3001, 3011, 3012
"""System variables of a custom macro: ms since power-on, date, time of the day."""
POWER_ON_BIN_S = 600
"""The instant of power-on is known to this [s]: date and time have 1 s, and a clock is set now and then."""
POWER_ON_SLACK_S = 60
"""Within a connection it may wander so far out of its bin before it counts as another [s]."""
DAY_S = 86_400


class CalendarError(ValueError):
    """The control's date or time is none."""


def power_on_utc_s(date: float, time: float, clock_ms: float) -> float:
    """Return when the control was switched on, by its own calendar [s]; raises CalendarError for no date."""
    if not (date.is_integer() and time.is_integer()):
        raise CalendarError(f"#{DATE} = {date} and #{TIME} = {time} are no date and time")
    year, month, day = int(date) // 10_000, int(date) // 100 % 100, int(date) % 100
    hour, minute, second = int(time) // 10_000, int(time) // 100 % 100, int(time) % 100
    if not (1970 <= year <= 2200 and 1 <= month <= 12 and 1 <= day <= calendar.monthrange(year, month)[1]):
        raise CalendarError(f"#{DATE} = {date:.0f} is no date")
    if not (hour < 24 and minute < 60 and second < 61):
        raise CalendarError(f"#{TIME} = {time:.0f} is no time of the day")
    return calendar.timegm((year, month, day, hour, minute, second)) - clock_ms / 1000.0


def power_on_count(at_s: float, before: int | None) -> int:
    """Return the number of the bin of the power-on; it stays near a bin's edges, and over midnight."""
    if before is not None:
        began_s = at_s - before * POWER_ON_BIN_S
        if any(-POWER_ON_SLACK_S <= s < POWER_ON_BIN_S + POWER_ON_SLACK_S for s in (began_s, began_s + DAY_S)):
            return before
    return math.floor(at_s / POWER_ON_BIN_S)
