"""The messages between the daemon and the process that plans the spindle speed, one JSON text a line."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Protocol

from pydantic import TypeAdapter

from daemon.snapshots import ModelSnapshot, SpeedDiagram
from models.spindle_speed.tuning import SpeedPlan


@dataclass(frozen=True, slots=True, kw_only=True)
class CalledOperation:
    """What the NC program says of the operation that it begins."""

    tool_number: int
    program: int
    speed_rpm: float
    feed_mm_min: float
    depth_mm: float
    """0: the configured one."""
    radial_mm: float
    """0: that of the case."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest:
    """Readings since the request before, and the operation under way."""

    readings: tuple[tuple[float, tuple[float, ...]], ...]
    """Time [s] and all sensors [degC], NaN where one has no value."""
    time_s: float
    """Of the latest reading [s]."""
    called: CalledOperation | None
    place: int | None
    """Of the operation in the configuration; None: nothing is to be planned."""
    doubted: Mapping[int, str]
    """Index of each sensor that is not believed, and why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedSpeed:
    """The latest plan of an operation, or why there is none."""

    called: CalledOperation
    time_s: float
    """Of the temperatures [s]."""
    plan: SpeedPlan | None
    problem: str
    resonance_hz: dict[str, float]
    change_per_step_rpm: dict[str, float]
    """Signal -> how far one step of its sensors moves the target [1/min]."""
    diagram: SpeedDiagram | None = None
    """What it was made from; it changes once a minute."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedModel:
    """Which bearing model the planning follows, or why it follows none."""

    inhibit: str
    """'' where speeds can be planned."""
    words: str
    """One sentence for the audit; '' where the planner before has said the same."""
    model: ModelSnapshot
    """The same for status."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What the planning process answers to one line."""

    opened: OpenedModel | None = None
    """To the first line, the configuration."""
    planned: PlannedSpeed | None = None
    """To a request; None where nothing was to be planned."""
    defect: str = ""
    """Why it ends."""


REQUEST: TypeAdapter[PlanRequest] = TypeAdapter(PlanRequest)
REPLY: TypeAdapter[Reply] = TypeAdapter(Reply)


def to_line(message: PlanRequest | Reply) -> bytes:
    """Return a message as one line; numbers that are none stay what they are."""
    return json.dumps(asdict(message)).encode() + b"\n"


class Planner(Protocol):
    """Plans speeds; the worker asks for one plan at a time."""

    @property
    def inhibit(self) -> str:
        """Why no speed can be planned now, '' when it can."""

    async def plan(self, request: PlanRequest) -> PlannedSpeed | None:
        """Return the plan; raises LinkError when the planner is lost before it has answered."""
