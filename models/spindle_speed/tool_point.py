"""The tool point as the tuning of the spindle speed needs it, whatever estimates it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from models.records import FloatArray
from models.stability.response import ToolPointResponse


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatedToolPoint:
    """The dynamics of the tool point as estimated from temperatures at one moment."""

    response: ToolPointResponse
    resonance_hz: Mapping[str, float]
    """The followed resonance per axis [Hz]; a rigid axis has none."""
    flagged_ends: "tuple[EstimatedToolPoint | None, ...]" = ()
    """The same with each flagged property at both ends of its physical range; None: the mode is lost there."""
    inhibit: str = ""
    """Why it should not be followed, '' when it can be."""


class ToolPointEstimator(Protocol):
    """Anything that turns temperatures into the dynamics of the tool point."""

    def renew(self, time_s: float, degc: FloatArray) -> EstimatedToolPoint | None:
        """Return the dynamics when the sensors read `degc` [degC], shape (n,); None before there are any.

        `time_s`: time of the reading, never before that of the last call [s]. `degc`: one value for each sensor of the
        machine [degC], NaN where there is none.
        """
