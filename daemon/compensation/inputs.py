"""Builds the inputs of one step of the output from what the control task knows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from daemon.compensation.tool import ToolInSpindle
from models.control.axis_map import AxisSource, nose_errors_um, probe_wander, tool_terms_um
from models.control.reference import tool_begin_degc
from models.control.reference_records import ReferenceMemory
from models.control.state import Inhibit, OperatorRequest, OutputInputs
from models.records import FloatArray, Phase, ThermalErrorEstimate


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputView:
    """What the control task knows when it decides."""

    now_s: float
    phase: Phase
    link: bool
    """The CNC answers, its echo is known, and it may be written to."""
    applied_um: FloatArray
    written_um: FloatArray | None
    withdrawn: bool
    sources: tuple[AxisSource, ...]
    estimate: ThermalErrorEstimate | None
    reference: ReferenceMemory
    zero_first: bool
    fault: str | None
    inhibits: tuple[Inhibit, ...]
    request: OperatorRequest
    tool: ToolInSpindle
    tool_setting: tuple[bool, ...] | None
    probe_um: FloatArray | None


def output_inputs(view: OutputView) -> OutputInputs:
    """Return everything that the next step of the output may depend on."""
    estimate, record = view.estimate, view.reference.record
    reference = view.reference.in_force
    return OutputInputs(
        now_s=view.now_s,
        phase=view.phase,
        link=view.link,
        applied_um=view.applied_um,
        written_um=view.written_um,
        withdrawn=view.withdrawn,
        thermal_error_um=nose_errors_um(view.sources, estimate)
        if estimate is not None
        else np.full(len(view.sources), np.nan),
        tool_term_um=tool_term_um(view.sources, estimate, view.reference, view.tool.number)
        if estimate is not None
        else None,
        estimate_age_s=view.now_s - estimate.trace.first_byte.monotonic_s if estimate is not None else np.inf,
        confidence=estimate.confidence if estimate is not None else 0.0,
        inhibit=estimate.inhibit if estimate is not None else "",
        held_s=estimate.held_s if estimate is not None else 0.0,
        in_domain=estimate.in_domain if estimate is not None else False,
        fading_um=estimate.fading_um if estimate is not None else 0.0,
        found_wrong_um=estimate.found_wrong_um if estimate is not None else 0.0,
        reference_id=reference.reference_id if reference is not None else None,
        reference_ended=view.reference.ended,
        estimate_reference_id=estimate.reference_id if estimate is not None else None,
        kept_reference_id=record.reference_id if record is not None else None,
        model_id=estimate.model_id if estimate is not None else None,
        follows=_follows(view.sources, estimate),
        output_fault=view.fault,
        inhibits=view.inhibits,
        request=view.request,
        zero_first=view.zero_first,
        tool_number=view.tool.number,
        tools_in_question=view.tool.in_question,
        tool_setting=view.tool_setting,
        probe_um=view.probe_um,
        probe_wander=probe_wander(view.sources, estimate),
    )


def tool_term_um(
    sources: tuple[AxisSource, ...], estimate: ThermalErrorEstimate, reference: ReferenceMemory, tool_number: int
) -> FloatArray:
    """Return the tool's expansion per axis [um]; since the reference when the tool was in the spindle then."""
    begin = tool_begin_degc(reference, tool_number, estimate.reference_id)
    return tool_terms_um(sources, estimate.label_increment_degc, begin)


def error_of_tool_point_um(
    sources: tuple[AxisSource, ...], estimate: ThermalErrorEstimate | None, reference: ReferenceMemory, tool_number: int
) -> FloatArray:
    """Return the estimated error per axis since the reference, tool included [um]; NaN without an estimate."""
    if estimate is None:
        return np.full(len(sources), np.nan)
    return nose_errors_um(sources, estimate) + tool_term_um(sources, estimate, reference, tool_number)


def _follows(sources: Sequence[AxisSource], estimate: ThermalErrorEstimate | None) -> tuple[str, FloatArray] | None:
    if estimate is None or estimate.follows is None:
        return None
    model_id, more_um = estimate.follows
    return model_id, nose_errors_um(sources, replace(estimate, thermal_error_um=more_um))
