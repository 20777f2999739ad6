"""The records of the reference: its memory, what a restart takes up again, and its messages to other parts."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from models.control.state import ToolBaseline
from models.records import CncSample, FloatArray, Reference


class ReferenceState(StrEnum):
    """Where the reference stands."""

    NONE = "none"
    """Nothing is in force, nothing is asked for, and nothing counts from an earlier one."""
    REQUESTED = "requested"
    """None is in force, and one is asked for; tool settings may still count from an earlier one."""
    VALID = "valid"
    """One is in force; the next may be asked for."""
    ENDED = "ended"
    """None is in force; tool settings count from the one that has ended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRules:
    """What the configuration says of work positioning."""

    program: int | None = None
    """O number whose sequence numbers count; None: any program."""
    sequence_numbers: frozenset[int] = frozenset()
    """Blocks at which the work has just been positioned."""
    zero_first: bool = False
    """The offset is taken out before the work is positioned."""
    retreat_sequence_numbers: frozenset[int] = frozenset()
    positioning_dwell_s: float = 1.0
    """It stands at a positioning block at least for this long [s]; a shorter gap between two polls hides none."""
    positioning_counter: int | None = None
    """Macro that the program raises before every positioning; None: there is none."""
    answer_within_s: float = 5.0
    """Work that was positioned has no reference when none has come within this time [s]."""
    max_outage_s: float = 600.0
    """After a longer outage of the daemon nothing is resumed [s]."""
    guard_programs: frozenset[int] = frozenset()
    """Programs that part programs call for us."""
    guard_blocks: range = range(0)
    """N numbers that occur in these programs alone."""
    counts_with: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    """What a reference is worth nothing without, in words, each with a text that changes when it does."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RequestedReference:
    """A reference that was asked for and has not come yet."""

    reference_id: str
    positioning: bool
    """The work was positioned; False: a person asked."""
    handshake: bool
    """The NC program asked, and waits for the answer."""
    asked_s: float
    """When it was asked for [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputBaseline:
    """What the request counts from since the reference."""

    axes: tuple[str, ...]
    model_id: str | None
    baseline_um: FloatArray
    """What was applied when the reference was set, per axis [um]."""
    offset_um: FloatArray
    """Added so that probes move as they should [um]."""
    weight: float
    """Share of the estimate that counts."""
    tools: Mapping[int, ToolBaseline] = field(default_factory=lambda: MappingProxyType({}))
    """Tool settings by tool number."""
    model_shift_um: FloatArray | None = None
    """Added to the estimate so that changes of model move nothing [um]; None before any."""
    counted_found_um: FloatArray | None = None
    """See `OutputMemory`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolOrigin:
    """Since when the expansion of the tool in the spindle counts."""

    number: int
    begin_degc: Mapping[str, float]
    """Mean increment of each label when the tool came into the spindle [K]."""
    before_um: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """By axis, how far it had expanded already, where it was set since it came, on another axis [um]."""
    unheard: tuple[str, ...] = ()
    """Labels that had been silent when it came and have not spoken since: only this run knows what to begin at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolSeen:
    """Which tool was in the spindle at the latest poll, and who said so."""

    number: int
    shown: int
    """What the control showed."""
    named_by: int | None = None
    """The program that had named it; None: the control's word counted."""
    shown_when_named: int | None = None
    shown_since: tuple[int, ...] = ()
    """Other tools that the control has shown since then."""
    count: float | None = None
    """How many had come, by the NC's own count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelOrigin:
    """What the mean of a label's sensors counts from; None where a sensor has no value."""

    sensor_ids: tuple[int, ...]
    reference_degc: tuple[float | None, ...]
    counted: tuple[bool, ...]
    offset_k: tuple[float | None, ...]
    rest_k: tuple[float, ...] = (0.0, 0.0)
    """The step of the latest return that was not made at once [K], and how long after the reference it was [min]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorsSinceReference:
    """The sensors since the reference: which are missing, which must not count, what returned ones count from."""

    reference_id: str
    absent: tuple[int, ...] = ()
    excluded: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))
    """Sensors that must not count until the next reference, and the sign by which each was found."""
    of_model: Mapping[str, Any] | None = None
    """What the thermal model keeps of sensors that returned."""
    rest_um: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: MappingProxyType({}))
    """By channel the step of the latest return that was not made at once [um], how long after the reference [min]."""
    labels: Mapping[str, LabelOrigin] = field(default_factory=lambda: MappingProxyType({}))
    found_wrong_um: float = 0.0
    """What those that were found wrong since were worth when they were found, all together [um]."""
    wrong_in_tool_um: float = 0.0
    """What they have made of the tool term at most [um]."""
    positions_mm: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Where the axes stood at the reference, by name and what was read under it [mm]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRecord:
    """One reference with all that counts from it."""

    reference: Reference
    """Identity, temperatures of the origin, and what it is bound to: program, work offset, power-on count."""
    by_handshake: bool = False
    """The NC program asked for it, so the handshake's counter tells whether anything was missed since."""
    baseline: OutputBaseline | None = None
    """None until the output has counted from it."""
    tool: ToolOrigin | None = None
    sensors: SensorsSinceReference | None = None

    @property
    def reference_id(self) -> str:
        """Its identity."""
        return self.reference.reference_id


@dataclass(frozen=True, slots=True, kw_only=True)
class CncSeen:
    """What a poll said of the program, as far as it tells whether the program has moved on since."""

    utc_s: float
    clock_s: float
    """The CNC's own clock [s]."""
    sequence_number: int
    idle: bool
    positioning_count: float | None = None
    """Value of the macro that counts positionings; None where there is none or where it is vacant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceDocument:
    """What a restart takes up again."""

    state: ReferenceState
    record: ReferenceRecord | None = None
    ended: str = ""
    """Why none is in force."""
    request_counter: int | None = None
    """The handshake's counter when this was kept."""
    seen: CncSeen | None = None
    """The latest poll that was kept."""
    counts_with: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    """`ReferenceRules.counts_with` of the run that kept it."""
    tool: ToolSeen | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceMemory:
    """The memory from event to event."""

    state: ReferenceState = ReferenceState.NONE
    record: ReferenceRecord | None = None
    """The reference in force or, when it has ended, the one that tool settings still count from."""
    requests: tuple[RequestedReference, ...] = ()
    ended: str = ""
    """Why none is in force, as far as that is known."""
    outcome: tuple[str, str] = ("", "")
    """Identity of the latest reference that came or was refused, and why it was refused, '' when it is in force."""
    sample: CncSample | None = None
    """The latest poll, with the part program's block while a program of the guard runs."""
    asked_s: float = 0.0
    """When the control was asked for it: what it shows is no older [s]."""
    retreating: bool = False
    """Under zero_first, the retreat block has passed."""
    positioning_seen: bool = False
    """A positioning block was polled since the handshake last reported one."""
    count_ahead: int = 0
    """1: the program's counter was raised and its positioning block not yet seen; -1: the other way round."""
    tool_began_s: float = -math.inf
    """When the expansion of the tool in the spindle began to count [s]."""
    labels_left_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Since when sensors of a label have been away [s]."""

    @property
    def in_force(self) -> Reference | None:
        """The reference in force."""
        return self.record.reference if self.record is not None and self.state is ReferenceState.VALID else None

    @property
    def tools_set(self) -> tuple[int, ...]:
        """Numbers of the tools that were set."""
        baseline = None if self.record is None else self.record.baseline
        return () if baseline is None else tuple(baseline.tools)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRequest:
    """Ask for a reference now, with what it is bound to."""

    reference_id: str
    source: str
    program: int
    work_offset: int
    power_on_count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceEnded:
    """A reference is valid no longer."""

    reference_id: str
    for_good: bool = True
    """False: it is still estimated how far the machine has gone since, because tool settings count from it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceTakenUp:
    """Go on from a reference of before, with what was known of the sensors since."""

    reference: Reference
    sensors: SensorsSinceReference | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Announcement:
    """What is recorded, and shown to people when it is a notice."""

    kind: str
    text: str


Effect = ReferenceRequest | ReferenceEnded | ReferenceTakenUp | Announcement
"""What follows from an event: a message to the estimation, or something to record."""
