"""The records of `models.control.compensation` (inputs, memory, limits), and the reasons that inhibit the output."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from models.records import FloatArray, OutputState, Phase
from models.thermal.bias import BiasState, Wander


class InhibitCode(StrEnum):
    """What inhibits switching an axis on, following the estimate, or writing at all."""

    NOT_BEGUN = "not begun"
    CLOCK = "clock"
    CONTROL = "control"
    COMMISSIONING = "commissioning"
    SECURITY = "security"
    UNKNOWN_AXIS = "unknown axis"
    MODEL = "model"
    OUTAGE = "outage"
    HARM = "harm"
    LINK = "link"
    ECHO = "echo"
    REFERENCE = "reference"
    STALE = "stale"
    CONFIDENCE = "confidence"
    DOMAIN = "domain"
    NO_ESTIMATE = "no estimate"
    PROBE = "probe"
    FAULT = "fault"


@dataclass(frozen=True, slots=True, kw_only=True)
class Inhibit:
    """One reason, and what a person can do about it."""

    code: InhibitCode
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputLimits:
    """What bounds the output, per axis and in time."""

    axes: tuple[str, ...]
    absolute_bound_um: FloatArray
    slew_um_per_min: FloatArray
    step_um: FloatArray
    """Largest distance between what is written and what the guard has applied [um]."""
    rounding_um: FloatArray
    """What may lie between the two because the control rounds to its least increment [um]."""
    deadband_um: FloatArray
    stale_after_s: float
    hold_limit_s: float
    min_confidence: float
    """Below this the output holds."""
    full_confidence: float = 1.0
    """From here on the estimate counts whole; between the two its weight falls to 0."""
    probe_bound_um: float = 0.0
    """A probe value that would correct the estimate by more is refused [um]."""
    probe_noise_um: float = float("nan")
    """Standard deviation of a probe value [um]; NaN: repeat readings tell it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorRequest:
    """What a person asked for since the last step."""

    enable: frozenset[str] = frozenset()
    disable: frozenset[str] = frozenset()
    zero: bool = False
    """Disable every axis and retreat to zero, not to the baseline."""
    acknowledge: int = 0
    """Number of the FAULT that is acknowledged; 0: none."""


NO_REQUEST = OperatorRequest()


UNKNOWN_UM = 1e3
"""Stands for an amount that nobody knows: more than any tool moves [um]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolBaseline:
    """Where the request of a tool counts from on the axes that were set with this tool."""

    baseline_um: FloatArray
    """What was applied at the tool setting [um], NaN on axes that were not set."""
    error_um: FloatArray
    """Estimate at the tool setting, since the work's reference and without the tool [um]."""
    offset_um: FloatArray
    """Offset of probes and changes of model at the tool setting [um]."""
    found_wrong_um: FloatArray | None = None
    """`OutputMemory.found_wrong_um` at the tool setting, per axis; None: 0."""

    def found(self, like: FloatArray) -> FloatArray:
        """Return `found_wrong_um` per axis, of the shape of `like` [um]."""
        return np.zeros(len(like)) if self.found_wrong_um is None else self.found_wrong_um


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputInputs:
    """Everything that one step may depend on."""

    now_s: float
    """Monotonic time [s]."""
    phase: Phase
    link: bool
    """The CNC answered lately and may be written to."""
    applied_um: FloatArray
    """The guard's echo per axis [um]; NaN where it is unknown."""
    settled: bool = True
    """The echo says what is applied; False while a run of the guard that was broken off may have moved further."""
    written_um: FloatArray | None = None
    """What the block held at the latest read-back or poll [um]; None where it is not watched."""
    withdrawn: bool = False
    """The guard may have taken the offset of an expired block out, and has not put it back."""
    thermal_error_um: FloatArray
    """Estimated error per axis since the reference, without the tool [um]; NaN where there is none."""
    tool_term_um: FloatArray | None = None
    """The tool's own expansion since its term began [um]; None where no tool is modelled."""
    estimate_age_s: float
    """Age of the estimate [s], inf when there is none."""
    confidence: float
    in_domain: bool
    fading_um: float = 0.0
    """What the estimate is still off for the step that a sensor's return would have been [um]."""
    inhibit: str = ""
    """Why confidence is low when no sensor is missing: states that are not filled yet."""
    held_s: float = 0.0
    """Age of the oldest temperature that is held because its sensor has missed cycles [s]; 0 where none has."""
    found_wrong_um: float = 0.0
    """What sensors that were found wrong since the reference were worth then, all together [um]."""
    reference_id: str | None
    """The valid reference; None when there is none."""
    reference_ended: str = ""
    """Why there is none, '' where that is not known."""
    estimate_reference_id: str | None
    """The reference that the estimate is relative to."""
    kept_reference_id: str | None = None
    """The latest reference, valid or ended, that estimates and tool settings count from; None when none may."""
    model_id: str | None = None
    follows: tuple[str, FloatArray] | None = None
    """The model before, and how much more it made of the same temperatures per axis, NaN where unknown [um]."""
    output_fault: str | None = None
    """Why the output is not trusted (read-back differs, foreign value, exception)."""
    inhibits: tuple[Inhibit, ...] = ()
    """What inhibits ACTIVE: no model, no commissioning record, insecure link, ..."""
    request: OperatorRequest = NO_REQUEST
    zero_first: bool = False
    """The offset is to be taken out before the next work positioning."""
    tool_number: int = 0
    tools_in_question: tuple[int, ...] = ()
    """The tools of which one is in the spindle, where it is not known which."""
    tool_setting: tuple[bool, ...] | None = None
    """Axes that were set with the tool in the spindle since the last step."""
    probe_um: FloatArray | None = None
    """A probe's deviation per axis, actual minus nominal with what is applied [um]; NaN where not probed."""
    probe_wander: Wander | None = None
    """How what the model misses wanders, per axis; None: a probe resets the offset."""

    @property
    def error_of_tool_point_um(self) -> FloatArray:
        """Estimate and tool term together [um], shape (n_axes,)."""
        return self.thermal_error_um if self.tool_term_um is None else self.thermal_error_um + self.tool_term_um


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputMemory:
    """Memory of the output from step to step."""

    state: OutputState
    since_s: float
    reason: str
    last_s: float
    command_um: FloatArray
    """Last value commanded [um]."""
    baseline_um: FloatArray
    """What was applied when the reference was set [um]."""
    reference_id: str | None
    model_id: str | None
    offset_um: FloatArray
    """Added to the request so that it cancels what a probe has measured [um]."""
    wanted: tuple[bool, ...]
    """Axes that a person switched on."""
    to_zero: bool = False
    """The retreat goes to zero even while the reference is valid."""
    limits_hit: tuple[str, ...] = field(default=())
    weight: float = 1.0
    """Multiplies the estimate since the reference; changes only between cuts."""
    pending_um: FloatArray | None = None
    """What the block held when the reference was set [um]."""
    settling: bool = False
    """A reference or a tool was set, and the CNC does not hold its value yet."""
    settling_axes: tuple[bool, ...] = ()
    """Axes for which that holds; empty: all of them."""
    model_shift_um: FloatArray | None = None
    """Added to the estimate so that a change of model moves nothing [um]; None before any, NaN until one is there."""
    error_um: FloatArray | None = None
    """The last finite estimate since `error_reference_id`, shifted so, without the tool [um]."""
    error_s: float = 0.0
    """Time of that estimate [s]."""
    probed: BiasState | None = None
    """How well the offset of probes is known since the reference; None before the first reference of this run."""
    error_reference_id: str | None = None
    """The reference that this estimate and the tool settings count from; it may have ended."""
    found_wrong_um: float = 0.0
    """What sensors that were found wrong since that reference were worth, at that estimate [um]."""
    unsure_um: float = 0.0
    """By how much that estimate was off for the step that a sensor's return would have been; `UNKNOWN_UM` where it was
    not followed [um]."""
    counted_found_um: FloatArray | None = None
    """The same when a probe or a change of model was counted last, per axis; NaN, None: neither was."""
    tools: Mapping[int, ToolBaseline] = field(default_factory=lambda: MappingProxyType({}))
    """Tool settings by tool number."""
