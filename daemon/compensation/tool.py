"""Follows the tool in the spindle: its number, and from when its own expansion counts."""

from daemon.compensation.references import References
from models.control.reference_records import ToolOrigin
from models.records import ThermalErrorEstimate


class ToolInSpindle:
    """Restarts the tool term at a tool change and a tool setting; owned by the control task."""

    def __init__(self, references: References) -> None:
        self._references = references
        self._seen: int | None = None
        self.number = 0

    def on_sample(self, seen: int, estimate: ThermalErrorEstimate | None) -> None:
        """Take the tool number of a poll: another one is a tool change."""
        if self._seen is None:
            self._seen = self.number = seen
        elif seen != self._seen:
            self._seen = seen
            self.begin(seen, estimate)

    def begin(self, number: int, estimate: ThermalErrorEstimate | None) -> None:
        """Let the tool term of this tool count from now."""
        self.number = number
        increments = dict(estimate.label_increment_degc) if estimate is not None else {}
        counted_from = estimate.reference_id if estimate is not None else None
        self._references.tool_begins(ToolOrigin(number=number, begin_degc=increments), counted_from)
