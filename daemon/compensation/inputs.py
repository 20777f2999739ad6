"""Builds the inputs of one step of the output from what the control task knows."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from models.control.axis_map import AxisSource, nose_errors_um, probe_wander, tool_terms_um
from models.control.reference import tool_origin
from models.control.reference_records import ReferenceMemory
from models.records import FloatArray, ThermalErrorEstimate


def of_estimate(
    sources: tuple[AxisSource, ...],
    estimate: ThermalErrorEstimate | None,
    reference: ReferenceMemory,
    tool_number: int,
    now_s: float,
) -> dict[str, Any]:
    """Return what the next step of the output takes from the estimate, by the names of `OutputInputs`."""
    if estimate is None:
        nothing = {"estimate_age_s": np.inf, "confidence": 0.0, "in_domain": False, "estimate_reference_id": None}
        return {"thermal_error_um": np.full(len(sources), np.nan), **nothing}
    return {
        "thermal_error_um": nose_errors_um(sources, estimate),
        "tool_term_um": tool_term_um(sources, estimate, reference, tool_number),
        "estimate_age_s": now_s - estimate.trace.first_byte.monotonic_s,
        "confidence": estimate.confidence,
        "inhibit": estimate.inhibit,
        "held_s": estimate.held_s,
        "in_domain": estimate.in_domain,
        "fading_um": estimate.fading_um,
        "found_wrong_um": estimate.found_wrong_um,
        "estimate_reference_id": estimate.reference_id,
        "model_id": estimate.model_id,
        "follows": _follows(sources, estimate),
        "probe_wander": probe_wander(sources, estimate),
    }


def tool_term_um(
    sources: tuple[AxisSource, ...], estimate: ThermalErrorEstimate, reference: ReferenceMemory, tool_number: int
) -> FloatArray:
    """Return the tool's expansion per axis [um]; since the reference when the tool was in the spindle then."""
    origin = tool_origin(reference, tool_number, estimate.reference_id)
    return tool_terms_um(sources, estimate.label_increment_degc, origin.begin_degc, origin.before_um)


def error_of_tool_point_um(
    sources: tuple[AxisSource, ...], estimate: ThermalErrorEstimate | None, reference: ReferenceMemory, tool_number: int
) -> FloatArray:
    """Return the estimated error per axis since the reference, tool included [um]; NaN without an estimate."""
    if estimate is None:
        return np.full(len(sources), np.nan)
    return nose_errors_um(sources, estimate) + tool_term_um(sources, estimate, reference, tool_number)


def _follows(sources: Sequence[AxisSource], estimate: ThermalErrorEstimate) -> tuple[str, FloatArray] | None:
    if estimate.follows is None:
        return None
    model_id, more_um = estimate.follows
    return model_id, nose_errors_um(sources, replace(estimate, thermal_error_um=more_um))
