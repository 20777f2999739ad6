"""What a probe value corrects, when it and a tool setting may count, and what the estimate's confidence is worth."""

from dataclasses import replace

import numpy as np

from models.control.baseline import model_shift_um, request_um
from models.control.measured import known_bias, offset_is_unsure, probe_of_tool_inhibit, with_probed
from models.control.state import Inhibit, InhibitCode, OutputInputs, OutputLimits, OutputMemory
from models.records import FloatArray, OutputState, Phase
from models.thermal.bias import ADVANCED_MIN, BiasFilter, Wander, full_reset

FADED_UM = 0.3
"""Where more of a step is still to fade, nothing that is measured now can be counted from [um]."""


def probe_inhibit(
    memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits, inhibit: Inhibit | None, probe_um: FloatArray
) -> Inhibit | None:
    """Return why a probe value cannot correct the estimate, None when it can.

    `memory`, `inputs`, `limits`: as for `models.control.compensation.step`. `inhibit`: the first reason against
    following the estimate, None when there is none. `probe_um`, shape (n_axes,): deviation per axis, actual minus
    nominal [um]; NaN where not probed.
    """
    probed = np.isfinite(probe_um)
    if not probed.any():
        return Inhibit(code=InhibitCode.PROBE, text="no axis was probed")
    if inhibit is not None:
        return replace(inhibit, text=f"the estimate cannot be corrected: {inhibit.text}")
    if not np.all(np.isfinite(inputs.error_of_tool_point_um[probed])):
        return Inhibit(code=InhibitCode.NO_ESTIMATE, text="the axis has no estimate")
    if why := _in_fault(memory, inputs) or _incomplete(inputs, limits) or probe_of_tool_inhibit(memory, inputs):
        return why
    correction = inputs.applied_um - probe_um - request_um(_weighed_anew(memory, inputs, limits), inputs)
    for axis, change in zip(limits.axes, correction, strict=True):
        if abs(change) > limits.probe_bound_um:
            return Inhibit(
                code=InhibitCode.PROBE,
                text=f"axis {axis}: the probe value would correct the estimate by {abs(change):.4g} um, "
                f"more than the bound of {limits.probe_bound_um:g} um",
            )
    return None


def tool_setting_inhibit(
    memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits, inhibit: Inhibit | None
) -> Inhibit | None:
    """Return why a tool setting cannot count from the estimate, None when it can.

    Its error would stay when the sensors are back, until the tool is set again.

    `memory`, `inputs`, `limits`: as for `models.control.compensation.step`. `inhibit`: the first reason against
    following the estimate, None when there is none.
    """
    if inhibit is not None:
        return replace(inhibit, text=f"the tool cannot be set: {inhibit.text}")
    return _in_fault(memory, inputs) or _incomplete(inputs, limits)


def _in_fault(memory: OutputMemory, inputs: OutputInputs) -> Inhibit | None:
    """Return why nothing that is measured now counts: the program gets no answer, and would not know that it did."""
    if inputs.output_fault is None and memory.state is not OutputState.FAULT:
        return None
    return Inhibit(
        code=InhibitCode.FAULT,
        text="the output is in FAULT: nothing is written, so the program gets no answer",
        remedy="acknowledge the fault, then measure again",
    )


def _incomplete(inputs: OutputInputs, limits: OutputLimits) -> Inhibit | None:
    """Return why what is measured now cannot be counted from: sensors are missing, held, or have only just returned."""
    if inputs.fading_um > FADED_UM:
        return Inhibit(
            code=InhibitCode.CONFIDENCE,
            text=f"sensors have just returned: the estimate goes over to what they say by {inputs.fading_um:.1f} um",
            remedy="measure again in two minutes",
        )
    if inputs.held_s > 0.0 or inputs.estimate_age_s > limits.stale_after_s / 2:
        oldest_s = max(inputs.held_s, inputs.estimate_age_s)
        text = f"sensors are silent: the oldest temperature that counts is from {oldest_s:.0f} s ago"
        return Inhibit(code=InhibitCode.STALE, text=text, remedy="measure again when they are back, or left out")
    if inputs.confidence >= limits.full_confidence:
        return None
    return Inhibit(
        code=InhibitCode.CONFIDENCE,
        text=f"sensors are missing: confidence {inputs.confidence:.2f} is below {limits.full_confidence:.2f}",
        remedy="bring them back and measure again",
    )


def take_probe(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    """Let the request cancel a probe's deviation from now on, as far as the probe is surer than the estimate.

    The offset then makes the request `applied - deviation` on the probed axes, of a probe without noise;
    in a fault it is left out.

    `inputs.probe_um` is what is left with what is applied now [um]; `probe_inhibit` was
    asked before. The noise of a probe is in the limits.
    """
    if inputs.probe_um is None or memory.reference_id is None or inputs.output_fault is not None:
        return _offset_now(memory, inputs, limits)
    memory = _weighed_anew(memory, inputs, limits)
    correction = inputs.applied_um - inputs.probe_um - request_um(memory, inputs)
    probed = replace(known_bias(memory, inputs.now_s), bias_um=-memory.offset_um)
    kalman = _bias_filter(None if offset_is_unsure(memory, inputs) else inputs.probe_wander, limits)
    probed = kalman.correct(probed, inputs.now_s / 60.0, -memory.offset_um - correction, _weighed_um(memory, inputs))
    memory = with_probed(memory, inputs, inputs.probe_um)
    return replace(memory, offset_um=-probed.bias_um, probed=probed)


def _weighed_anew(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    """Return the memory with the weight of the confidence now: a probe counts from what the estimate is worth.

    The weight of before, which a cut may have kept, would be renewed after it, and add what the probe has corrected.
    """
    return replace(memory, weight=weight_of(inputs.confidence, limits))


def _offset_now(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    """Let the offset of earlier probes return, as what the model misses does."""
    probed, now_min = memory.probed, inputs.now_s / 60.0
    if probed is None or inputs.probe_wander is None or not (memory.offset_um.any() or not probed.follows.all()):
        return memory
    ours = memory.reference_id is not None and inputs.estimate_reference_id == memory.reference_id
    if now_min - probed.time_min < ADVANCED_MIN or not ours:
        return memory
    probed = replace(probed, bias_um=-memory.offset_um)
    probed = _bias_filter(inputs.probe_wander, limits).advanced(probed, now_min, _weighed_um(memory, inputs))
    return replace(memory, offset_um=-probed.bias_um, probed=probed)


def _weighed_um(memory: OutputMemory, inputs: OutputInputs) -> FloatArray:
    """Return what the model moves the request by, whatever tool is in the spindle [um]; NaN without an estimate."""
    return np.asarray(memory.weight * (inputs.thermal_error_um + model_shift_um(memory)))


def _bias_filter(wander: Wander | None, limits: OutputLimits) -> BiasFilter:
    """Return how a probe corrects the offset; a model that does not say how it wanders is reset by every probe."""
    if wander is None:
        return full_reset(len(limits.axes))
    nothing = np.zeros(len(limits.axes))
    return BiasFilter(
        wander_um2_per_min=wander.um2_per_min,
        noise_um=nothing + limits.probe_noise_um,
        largest_step_um=nothing + np.inf,
        correlation_min=wander.correlation_min,
    )


def weight_of(confidence: float, limits: OutputLimits) -> float:
    """Return the share of the estimate that a confidence (0..1) is worth.

    It is 0 at the limits' `min_confidence`, 1 from `full_confidence` on, linear between.
    """
    if confidence >= limits.full_confidence:
        return 1.0
    span = limits.full_confidence - limits.min_confidence
    return float(np.clip((confidence - limits.min_confidence) / span, 0.0, 1.0)) if span > 0 else 0.0


def follow_confidence(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    """Renew the weight of the estimate between cuts; while the output follows or holds in a cut it stays."""
    cutting = inputs.phase is Phase.CUTTING and memory.state in (OutputState.ACTIVE, OutputState.HOLD)
    if cutting or inputs.confidence < limits.min_confidence:
        return memory
    weight = weight_of(inputs.confidence, limits)
    return memory if weight == memory.weight else replace(memory, weight=weight)
