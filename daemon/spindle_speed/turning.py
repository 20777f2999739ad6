"""Holds the speed at which the spindle turns against the one that the NC has taken; only of that is something known."""

import math

from config.schema.spindle_speed import SpindleSpeedConfig
from daemon.cnc.events import NUMBERS, Journal
from models.records import CncSample, Phase

LASTS_S = 10.0
"""A spindle may take so long to come to its speed, and what is computed of the dynamics may change for so long [s]."""
STANDS_RPM = 1.0
OVER_S = 180.0
"""An alarm that comes back within this is the same one [s]: temperatures and depths tremble at a limit."""


class SpeedAlarms:
    """Records each reason of an alarm when it comes and when it has gone; its numbers may change meanwhile."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._there: dict[str, tuple[str, float]] = {}

    def there(self, text: str, now_s: float, reason: str = "") -> None:
        """Take an alarm of now; `reason`: what it is, whatever its text says, '' where the text without numbers is."""
        reason = reason or NUMBERS.sub("~", text)
        if reason not in self._there:
            self._journal.say("alarm", f"spindle speed: {text}")
        self._there[reason] = self._there.get(reason, (text, now_s))[0], now_s

    def end(self, now_s: float) -> None:
        """Record what has not been there for long enough."""
        for reason, (text, latest_s) in list(self._there.items()):
            if now_s - latest_s >= OVER_S:
                del self._there[reason]
                self._journal.say("speed", f"over for {OVER_S / 60.0:g} min: {text}")


class TurningSpeed:
    """What the spindle does in the operation under way; owned by the control task."""

    def __init__(self, tuning: SpindleSpeedConfig) -> None:
        self._tuning = tuning
        self._taken_rpm: float | None = None
        self._off_since_s = math.nan
        self._as_taken = True
        """It cut last with the speed that was taken."""
        self.cuts = False
        """It cuts now, and with the speed that was taken, or nobody says with which."""
        self.alarm = ""
        """Why what is known of the speed that was taken does not hold for the cut, '' when it does."""

    def update(self, taken_rpm: float | None, sample: CncSample, phase: Phase, stable_rpm: tuple[float, float]) -> None:
        """Take a poll; `taken_rpm`: what the NC has taken for the operation under way [1/min], None where nothing.

        The alarm lasts until the spindle cuts at the speed that was taken, or another one is taken. `stable_rpm`: the
        pocket that the dynamics of now ask for.
        """
        if taken_rpm != self._taken_rpm:
            self._taken_rpm, self._off_since_s, self.alarm = taken_rpm, math.nan, ""
        actual_rpm, now_s = abs(sample.spindle_speed_rpm), sample.time.monotonic_s
        self.cuts = phase is Phase.CUTTING
        if taken_rpm is None or not self.cuts or math.isnan(actual_rpm):
            return
        self.cuts = abs(actual_rpm - taken_rpm) <= self._tuning.tolerance_rpm(taken_rpm)
        if not self.cuts and actual_rpm <= STANDS_RPM:
            return
        why = self._outgrown(taken_rpm, *stable_rpm)
        if not self.cuts:
            why = (
                f"the spindle turns at {actual_rpm:.0f} 1/min and the NC has taken {taken_rpm:.0f}: at that speed "
                "nothing is known of this cut; set the override to 100 %, or see which S the program gives"
            )
        if not why or self.cuts is not self._as_taken:
            self._as_taken, self._off_since_s, self.alarm = self.cuts, math.nan, ""
        if why and math.isnan(self._off_since_s):
            self._off_since_s = now_s
        if not self.alarm and now_s - self._off_since_s >= LASTS_S:
            self.alarm = why

    def _outgrown(self, taken_rpm: float, low_rpm: float, high_rpm: float) -> str:
        """Return why the speed that was taken is not one to cut at now, '' where it is: nothing changes in a cut."""
        verified_rpm = 0.0 if self.alarm and self._as_taken else self._tuning.tolerance_rpm(taken_rpm)
        if low_rpm - verified_rpm <= taken_rpm <= high_rpm + verified_rpm:
            return ""
        return (
            f"the spindle cuts at {taken_rpm:.0f} 1/min, and the stable speeds nearest to the programmed one lie "
            f"between {low_rpm:.0f} and {high_rpm:.0f}: call the speed program twice before each pass, some seconds "
            "apart, or make passes shorter"
        )
