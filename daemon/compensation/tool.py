"""The tool in the spindle: its number, and since when its own expansion counts."""

from collections.abc import Sequence

from daemon.history.writer import HistoryWriter
from models.control.axis_map import AxisSource, tool_terms_um
from models.records import FloatArray, ThermalErrorEstimate


class ToolInSpindle:
    """Restarts the tool term at a tool change, a tool setting and a new reference; owned by the control task."""

    def __init__(self, sources: Sequence[AxisSource], history: HistoryWriter) -> None:
        self._sources = tuple(sources)
        self._history = history
        self._begin_degc: dict[str, float] = {}
        self._reference_id: str | None = None
        self._seen: int | None = None
        self.number = 0

    def follow(self, seen: int, estimate: ThermalErrorEstimate | None) -> None:
        """Take the tool number of a poll: another one is a tool change."""
        if self._seen is None:
            self._seen = self.number = seen
        elif seen != self._seen:
            self._seen = seen
            self.begin(seen, estimate)

    def begin(self, number: int, estimate: ThermalErrorEstimate | None) -> None:
        """Let the tool term of this tool count from now."""
        self.number = number
        self._begin_degc = dict(estimate.label_increment_degc) if estimate is not None else {}
        self._reference_id = estimate.reference_id if estimate is not None else None
        kept = {"number": number, "begin_degc": self._begin_degc, "reference_id": self._reference_id}
        self._history.put_state("tool", kept)

    def take_up(self, reference_id: str) -> None:
        """Go on with the tool's term of the previous run, when it is the same tool since the same reference."""
        kept = self._history.get_state("tool")
        if kept is not None and kept["reference_id"] == reference_id and kept["number"] == self.number:
            self._begin_degc, self._reference_id = kept["begin_degc"], reference_id

    def term_um(self, estimate: ThermalErrorEstimate) -> FloatArray:
        """Return the tool's expansion per axis [um]; since the reference when the tool was in the spindle then."""
        begin = self._begin_degc if self._reference_id == estimate.reference_id else {}
        return tool_terms_um(self._sources, estimate.label_increment_degc, begin)
