"""Where the request counts from: the baseline of a reference, of a tool setting, and of a probe value.

request = baseline + offset - weight (estimate + shift of the model - estimate at the tool setting + tool term)

Setting a reference, setting a tool and changing the model never move the output; a probe value
does, and the limits of `models.control.compensation` bound how fast.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from models.control.measured import carried_over, known_bias, with_model
from models.control.state import (
    UNKNOWN_UM,
    OutputInputs,
    OutputLimits,
    OutputMemory,
    ToolBaseline,
)
from models.records import FloatArray, OutputState

SETTLING_STATES = (OutputState.ARMED, OutputState.ACTIVE, OutputState.HOLD)
"""States in which the output is meant to stay where the reference found it."""
ROUNDED_UM = 1.0
"""A guard that is so near counts as on the way, however finely its control rounds [um]."""
SETTLED_UM = 3e-3
"""The CNC holds a value that was read back so near [um]: it counts to a nanometre, which may move an axis by five."""


def follow_reference(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    """Make what is applied the baseline of a new reference; keep the output where it is.

    While the CNC does not yet hold the new command, the guard may still apply the old one: what
    it then applied is the baseline, because moving back would be a second step on the part.

    The memory has the reference of the inputs, or the old one while the echo is unknown.

    `memory`: from the previous step. `limits`: how far a control rounds, and from when on an estimate does not tell
    how far the machine has gone until a new reference.
    """
    if inputs.reference_id != memory.reference_id:
        return _new_reference(memory, inputs, limits.stale_after_s)
    if memory.reference_id is None:
        return _without_reference(memory, inputs)
    return _follow_model(_settle(memory, inputs, limits.rounding_um) if memory.settling else memory, inputs)


def follow_tool(memory: OutputMemory, inputs: OutputInputs) -> OutputMemory:
    """Keep what is applied as the baseline of a tool on the axes that were set with it.

    The memory is unchanged without a setting, without a valid reference, without an echo, or in a fault.

    `memory`: after `follow_reference`. `inputs`: `tool_setting` tells the axes, `tool_number` the tool [-].
    """
    axes = inputs.tool_setting
    if axes is None or memory.reference_id is None or not np.isfinite(inputs.applied_um).all():
        return memory
    if inputs.output_fault is not None:
        return memory
    error = memory.error_um if memory.error_um is not None else np.zeros(len(memory.command_um))
    before = memory.tools.get(inputs.tool_number)
    unset = np.full_like(memory.command_um, np.nan)
    chosen = np.array(axes, dtype=bool)
    rest = ToolBaseline(
        baseline_um=np.where(chosen, inputs.applied_um, before.baseline_um if before else unset),
        error_um=np.where(chosen, error, before.error_um if before else 0.0),
        offset_um=np.where(chosen, memory.offset_um, before.offset_um if before else 0.0),
        found_wrong_um=np.where(chosen, memory.found_wrong_um, before.found(error) if before else 0.0),
    )
    command = np.where(chosen, inputs.applied_um, memory.command_um)
    return replace(
        memory,
        tools=MappingProxyType({**memory.tools, inputs.tool_number: rest}),
        command_um=memory.command_um if memory.state is OutputState.FAULT else command,
        settling=memory.state in SETTLING_STATES,
        settling_axes=_also_settling(memory, axes),
        pending_um=inputs.written_um,
    )


def _also_settling(memory: OutputMemory, axes: tuple[bool, ...]) -> tuple[bool, ...]:
    """Return the axes that settle when these are set too; where others go on following, their baseline stays."""
    if not memory.settling:
        return axes
    if not memory.settling_axes:
        return ()
    return tuple(before or now for before, now in zip(memory.settling_axes, axes, strict=True))


def rest_of_tool(memory: OutputMemory, inputs: OutputInputs) -> tuple[FloatArray, FloatArray]:
    """Return where the request counts from with the tool in the spindle.

    Result: `baseline_um`, `error_um`, shape (n_axes,): baseline [um], and the estimate that belongs to it [um].

    `inputs.tool_number` selects the tool's setting.
    """
    tool = memory.tools.get(inputs.tool_number)
    if tool is None:
        return memory.baseline_um, np.zeros(len(memory.baseline_um))
    own = np.isfinite(tool.baseline_um)
    return np.where(own, tool.baseline_um, memory.baseline_um), np.where(own, tool.error_um, 0.0)


def model_shift_um(memory: OutputMemory) -> FloatArray:
    """Return what is added to the estimate so that changes of model move nothing, shape (n_axes,) [um]."""
    return np.zeros(len(memory.command_um)) if memory.model_shift_um is None else memory.model_shift_um


def request_um(memory: OutputMemory, inputs: OutputInputs) -> FloatArray:
    """Return what follows from the estimate.

    Result: of shape (n_axes,): baseline + offset since the setting - weight (estimate since the setting + tool term)
    [um]; NaN without an estimate.

    `memory`: baselines, offset and weight.
    """
    baseline, error = rest_of_tool(memory, inputs)
    tool = memory.tools.get(inputs.tool_number)
    before = 0.0 if tool is None else np.where(np.isfinite(tool.baseline_um), tool.offset_um, 0.0)
    counted = inputs.error_of_tool_point_um + model_shift_um(memory) - error
    request: FloatArray = baseline + memory.offset_um - before - memory.weight * counted
    return request


def follow_error(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    """Remember the latest estimate, from which a new reference tells how far the machine had gone until then.

    Each axis that has one keeps it, when it counts from the latest reference.

    `memory`: from the previous step. `inputs`: estimate and what it counts from. `limits`: an estimate of less than the
    least confidence is not followed.
    """
    if inputs.estimate_reference_id is None or inputs.estimate_reference_id != memory.error_reference_id:
        return memory
    error_um = inputs.thermal_error_um + model_shift_um(memory)
    known = np.isfinite(error_um)
    if not known.any() or not np.isfinite(inputs.estimate_age_s):
        return memory
    before = memory.error_um if memory.error_um is not None else np.zeros(len(inputs.thermal_error_um))
    trusted = inputs.in_domain and inputs.confidence >= limits.min_confidence
    return replace(
        memory,
        error_um=np.where(known, error_um, before),
        error_s=inputs.now_s - inputs.estimate_age_s,
        found_wrong_um=inputs.found_wrong_um,
        unsure_um=inputs.fading_um if trusted else UNKNOWN_UM,
    )


def _without_reference(memory: OutputMemory, inputs: OutputInputs) -> OutputMemory:
    """Keep the tool settings while no reference is valid; without what they count from they end.

    Another model goes on from how far the machine has gone since the reference that has ended.
    """
    if memory.error_reference_id is None:
        return memory
    if inputs.kept_reference_id != memory.error_reference_id:
        return replace(memory, error_um=None, error_reference_id=None, tools=MappingProxyType({}))
    return _follow_model(memory, inputs)


def _new_reference(memory: OutputMemory, inputs: OutputInputs, stale_after_s: float) -> OutputMemory:
    if inputs.reference_id is None:
        return _without_reference(replace(memory, reference_id=None, settling=False), inputs)
    if not (inputs.link and np.isfinite(inputs.applied_um).all()):
        return memory
    return replace(
        memory,
        reference_id=inputs.reference_id,
        model_id=inputs.model_id,
        baseline_um=inputs.applied_um.copy(),
        offset_um=np.zeros(len(memory.offset_um)),
        probed=known_bias(memory, inputs.now_s).begin(inputs.now_s / 60.0),
        command_um=memory.command_um if memory.state is OutputState.FAULT else inputs.applied_um.copy(),
        settling=memory.state in SETTLING_STATES,
        settling_axes=(),
        pending_um=inputs.written_um,
        model_shift_um=None,
        error_um=np.zeros(len(memory.command_um)),
        error_s=inputs.now_s,
        error_reference_id=inputs.reference_id,
        found_wrong_um=0.0,
        unsure_um=0.0,
        counted_found_um=None,
        tools=_tools_since(memory, inputs, stale_after_s),
    )


def _tools_since(
    memory: OutputMemory, inputs: OutputInputs, stale_after_s: float
) -> MappingProxyType[int, ToolBaseline]:
    """Return the tool settings counted from a new reference; the tool in the spindle is set anew by it.

    Where it is not known which is there, those that may be are in doubt.
    """
    if memory.error_um is None or inputs.now_s - memory.error_s > stale_after_s:
        return MappingProxyType({})
    kept = {number: carried_over(memory, number, tool) for number, tool in memory.tools.items()}
    tools = dict(_counted_from(kept, memory.error_um, memory.offset_um))
    for number in inputs.tools_in_question:
        if (unsure := tools.get(number)) is not None:
            tools[number] = replace(unsure, found_wrong_um=np.full_like(memory.command_um, -UNKNOWN_UM))
    if not inputs.tools_in_question and (here := tools.get(inputs.tool_number)) is not None:
        nothing = np.zeros(len(memory.command_um))
        baseline = np.where(np.isfinite(here.baseline_um), inputs.applied_um, np.nan)
        tools[inputs.tool_number] = ToolBaseline(baseline_um=baseline, error_um=nothing, offset_um=nothing)
    return MappingProxyType(tools)


def _counted_from(
    tools: Mapping[int, ToolBaseline], error_um: FloatArray, offset_um: FloatArray | float
) -> MappingProxyType[int, ToolBaseline]:
    """Return tool settings counted from where estimate and offset were these [um]."""
    return MappingProxyType(
        {
            number: replace(rest, error_um=rest.error_um - error_um, offset_um=rest.offset_um - offset_um)
            for number, rest in tools.items()
        }
    )


def _settle(memory: OutputMemory, inputs: OutputInputs, rounding_um: FloatArray) -> OutputMemory:
    if memory.state not in SETTLING_STATES or memory.to_zero or inputs.zero_first:
        return replace(memory, settling=False)
    applied = inputs.applied_um
    if not (inputs.link and np.isfinite(applied).all()):
        return memory
    moved = (np.abs(applied - memory.command_um) > SETTLED_UM) & _on_the_way(memory, applied, rounding_um)
    if memory.settling_axes:
        moved &= np.array(memory.settling_axes, dtype=bool)
    if moved.any():
        return replace(_rest_at(memory, inputs, moved), command_um=np.where(moved, applied, memory.command_um))
    held = inputs.written_um is None or bool(np.all(np.abs(inputs.written_um - memory.command_um) <= SETTLED_UM))
    return replace(memory, settling=not held)


def _on_the_way(memory: OutputMemory, applied_um: FloatArray, rounding_um: FloatArray) -> npt.NDArray[np.bool_]:
    """Return on which axes the guard has gone from the baseline towards what the block held at the reference."""
    if memory.pending_um is None:
        return np.ones(len(applied_um), dtype=np.bool_)
    pending = np.where(np.isfinite(memory.pending_um), memory.pending_um, memory.command_um)
    lowest, highest = np.minimum(memory.command_um, pending), np.maximum(memory.command_um, pending)
    near_um = np.maximum(rounding_um, ROUNDED_UM)
    return np.asarray((applied_um >= lowest - near_um) & (applied_um <= highest + near_um))


def _rest_at(memory: OutputMemory, inputs: OutputInputs, moved: npt.NDArray[np.bool_]) -> OutputMemory:
    """Return the memory with the baseline moved to what the guard applied meanwhile."""
    tool = memory.tools.get(inputs.tool_number)
    own = np.isfinite(tool.baseline_um) if tool is not None else np.zeros(len(moved), dtype=bool)
    tools = dict(memory.tools)
    if tool is not None:
        tools[inputs.tool_number] = replace(
            tool, baseline_um=np.where(moved & own, inputs.applied_um, tool.baseline_um)
        )
    baseline = np.where(moved & ~own, inputs.applied_um, memory.baseline_um)
    return replace(memory, baseline_um=baseline, tools=MappingProxyType(tools))


def _follow_model(memory: OutputMemory, inputs: OutputInputs) -> OutputMemory:
    """Let another model count on from where the one before it was, axis by axis, once it has an estimate.

    Where it is known what both make of the same temperatures, what these changed since is no difference of the models.
    Weight, tool term, probes and a command that lags behind the request have no part in it.
    """
    if memory.model_id is None:
        return replace(memory, model_id=inputs.model_id)
    if inputs.model_id is None or inputs.estimate_reference_id != memory.error_reference_id:
        return memory
    another, shift = inputs.model_id != memory.model_id, model_shift_um(memory)
    if another:
        shift = np.full_like(memory.command_um, np.nan)
    begins = np.isnan(shift) & np.isfinite(inputs.thermal_error_um)
    if not another and not begins.any():  # an axis without a model never begins, and says nothing of the others
        return memory
    before = memory.error_um if memory.error_um is not None else np.zeros(len(memory.command_um))
    goes_on = before - inputs.thermal_error_um
    if inputs.follows is not None and inputs.follows[0] == memory.model_id:
        more = model_shift_um(memory) + inputs.follows[1]
        goes_on = np.where(np.isfinite(more), more, goes_on)
    shift = np.where(begins, goes_on, shift)
    return replace(with_model(memory, begins | another), model_id=inputs.model_id, model_shift_um=shift)
