"""Follows the tool in the spindle: its number, and from when its own expansion counts."""

from daemon.compensation.references import References
from models.control.reference_records import ToolOrigin
from models.records import ThermalErrorEstimate


class ToolInSpindle:
    """Restarts the tool term at a tool change and a tool setting; owned by the control task."""

    def __init__(self, references: References) -> None:
        self._references = references
        self._seen: int | None = None
        self._counted_from: str | None = None
        self._increments_degc: dict[str, float] = {}
        """The latest increment of each label since this reference: of one whose sensors are away, what it had."""
        self.number = 0

    def on_sample(self, seen: int, estimate: ThermalErrorEstimate | None) -> None:
        """Take the tool number of a poll: another one is a tool change."""
        self._follow(estimate)
        if self._seen is None:
            self._seen = self.number = seen
        elif seen != self._seen:
            self._seen = seen
            self.begin(seen, estimate)

    def begin(self, number: int, estimate: ThermalErrorEstimate | None) -> None:
        """Let the tool term of this tool count from now."""
        self.number = number
        self._follow(estimate)
        counted_from = estimate.reference_id if estimate is not None else None
        self._references.tool_begins(ToolOrigin(number=number, begin_degc=dict(self._increments_degc)), counted_from)

    def _follow(self, estimate: ThermalErrorEstimate | None) -> None:
        if estimate is None:
            return
        if estimate.reference_id != self._counted_from:
            self._counted_from, self._increments_degc = estimate.reference_id, {}
        self._increments_degc |= estimate.label_increment_degc
