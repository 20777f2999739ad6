"""The tool in the spindle: its number, and since when its own expansion counts."""

from collections.abc import Sequence

import numpy as np

from models.axis_map import AxisSource, tool_terms_um
from models.records import FloatArray, ThermalErrorEstimate


class ToolInSpindle:
    """Restarts the tool term at a tool change, a tool setting and a new reference; owned by the control task."""

    def __init__(self, sources: Sequence[AxisSource]) -> None:
        self._sources = tuple(sources)
        self._begin_degc: dict[str, float] = {}
        self._reference_id: str | None = None
        self._seen = 0
        self.number = 0

    def follow(self, seen: int, estimate: ThermalErrorEstimate | None) -> None:
        """Take the tool number of a poll: another one is a tool change."""
        if seen != self._seen:
            self._seen = seen
            self.begin(seen, estimate)

    def begin(self, number: int, estimate: ThermalErrorEstimate | None) -> None:
        """Let the tool term of this tool count from now."""
        self.number = number
        self._begin_degc = dict(estimate.label_increment_degc) if estimate is not None else {}
        self._reference_id = estimate.reference_id if estimate is not None else None

    def term_um(self, estimate: ThermalErrorEstimate) -> FloatArray:
        """Return the tool's expansion per axis [um]; since the reference when the tool was in the spindle then."""
        begin = self._begin_degc if self._reference_id == estimate.reference_id else {}
        term = tool_terms_um(self._sources, estimate.label_increment_degc, begin)
        return np.where(np.isfinite(term), term, np.nan)
