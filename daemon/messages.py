"""The messages between the tasks, both ways through the other's inbox, and the requests of people."""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field

from models.control.reference_records import ReferenceEnded, ReferenceRequest, ReferenceTakenUp, SensorsSinceReference
from models.control.state import OperatorRequest
from models.records import Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputActions:
    """What a person may ask of the output; each takes the person's name and returns a refusal, '' when it is taken."""

    request: Callable[[OperatorRequest, str], str]
    request_reference: Callable[[str, Callable[[str], None]], str]
    """Takes besides what is told later what became of it: '' in force, else why not."""
    switch_spindle_speed: Callable[[bool, str], str]
    record_refusal: Callable[[str, str], None]
    """Takes what was refused and why, and who asked."""
    carried_out: Callable[[], Awaitable[None]]
    """Returns when everything that was asked for before has been decided on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimateComing:
    """A cycle has arrived that leads to an estimate: what stands in the control can be looked at meanwhile."""

    line: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRefused:
    """A reference that was asked for cannot be set."""

    reference_id: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRebased:
    """The reference in use, with which sensors that returned go on from where they were imputed."""

    reference: Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleSpeed:
    """What a poll of the CNC said."""

    monotonic_s: float
    rpm: float
    positions_mm: Mapping[str, float] = field(default_factory=dict)
    """Machine positions of the axes that the configuration names [mm]; NaN where the control gives none."""
    no_position: str = ""
    """Why the control gives no axis position, '' where it does."""


@dataclass(frozen=True, slots=True)
class TemperaturesTrusted:
    """A person says that all temperatures are right as they are."""

    person: str


__all__ = ["ReferenceEnded", "ReferenceRequest", "ReferenceTakenUp", "SensorsSinceReference"]
