"""Whether a person has switched the tuning of the spindle speed off; kept over restarts."""

from daemon.output.journal import Journal

STATE = "spindle_speed_off"
"""Key in the store: who switched it off; nothing while it is on."""


class SpeedSwitch:
    """On, until a person says otherwise; owned by the control task."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._off_by = str(journal.kept(STATE) or "")

    @property
    def obstacle(self) -> str:
        """Who has switched it off, in words; '' while it is on."""
        if not self._off_by:
            return ""
        return f"switched off by {self._off_by}; `toolpoint enable --spindle-speed` switches it on"

    def turn(self, *, on: bool, person: str) -> None:
        """Switch on or off; nothing moves by that, the NC takes what follows from it with its next call."""
        self._off_by = "" if on else person
        self._journal.keep(STATE, self._off_by)
        self._journal.event("request", f"{'enable' if on else 'disable'} the tuning of the spindle speed", person)
