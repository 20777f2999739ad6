"""What was measured while a sensor was wrong: tool settings, probes and changes of model before it was found.

The estimate goes back when a sensor is found wrong, because it is left out since the reference. What was measured
before holds the estimate of then: it may be off by as much as the sensor was worth when it was found.
"""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from models.control.state import (
    UNKNOWN_UM,
    Inhibit,
    InhibitCode,
    OutputInputs,
    OutputLimits,
    OutputMemory,
    ToolBaseline,
)
from models.records import FloatArray
from models.thermal.bias import BiasState, unknown_bias
from models.thermal.estimation import UNSURE_UM


def tool_unsure_um(memory: OutputMemory, tool_number: int, found_wrong_um: float) -> FloatArray:
    """Return by how much a tool's own setting may be off, shape (n_axes,) [um]; 0 on axes that it was not set on.

    `found_wrong_um`: what sensors that were found wrong since the reference were worth until now [um].
    """
    tool = memory.tools.get(tool_number)
    if tool is None:
        return np.zeros(len(memory.command_um))
    return np.where(np.isfinite(tool.baseline_um), found_wrong_um - tool.found(memory.command_um), 0.0)


def _offset_unsure_um(memory: OutputMemory, tool_number: int, found_wrong_um: float) -> FloatArray:
    """Return by how much probes and changes of model may be off, shape (n_axes,) [um]."""
    if memory.counted_found_um is None:
        return np.zeros(len(memory.command_um))
    unsure_um = np.where(np.isnan(memory.counted_found_um), 0.0, found_wrong_um - memory.counted_found_um)
    tool = memory.tools.get(tool_number)
    if tool is None:
        return unsure_um
    before = np.isfinite(tool.baseline_um) & (memory.counted_found_um < tool.found(memory.command_um))
    return np.where(before, np.minimum(unsure_um, np.abs(memory.offset_um - tool.offset_um)), unsure_um)


def measured_inhibit(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> Inhibit | None:
    """Return why what the request counts from is not trusted, None when it is.

    `memory`, `inputs`, `limits`: as for `models.control.compensation.step`; the estimate counts from the output's
    reference.
    """
    of_tool_um = tool_unsure_um(memory, inputs.tool_number, inputs.found_wrong_um)
    unsure_um = np.maximum(of_tool_um, _offset_unsure_um(memory, inputs.tool_number, inputs.found_wrong_um))
    unsure = (unsure_um > UNSURE_UM) & memory.wanted
    if not unsure.any():
        return None
    places = np.flatnonzero(unsure)
    worst = int(places[np.argmax(unsure_um[places])])
    what = f"tool T{inputs.tool_number} was set" if of_tool_um[worst] > UNSURE_UM else "a probe or a new model counted"
    return Inhibit(
        code=InhibitCode.CONFIDENCE,
        text=f"axis {limits.axes[worst]}: {what} with a sensor that was found wrong later, or before a positioning at "
        f"which the estimate was in doubt: it may be {_amount(float(unsure_um[worst]))} off",
        remedy="set the tool again, then probe, or position the work again",
    )


def _amount(um: float) -> str:
    return f"{um:.1f} um" if um < UNKNOWN_UM else "any number of um"


def probe_of_tool_inhibit(memory: OutputMemory, inputs: OutputInputs) -> Inhibit | None:
    """Return why a probe with the tool in the spindle corrects nothing: its setting would go into what others count."""
    if not (tool_unsure_um(memory, inputs.tool_number, inputs.found_wrong_um) > UNSURE_UM).any():
        return None
    return Inhibit(
        code=InhibitCode.CONFIDENCE,
        text=f"tool T{inputs.tool_number} was set with a sensor that was found wrong later, or before a positioning at "
        "which the estimate was in doubt",
        remedy="set the tool again, then probe",
    )


def offset_is_unsure(memory: OutputMemory, inputs: OutputInputs) -> bool:
    """Whether the offset holds probes that are to be replaced, not corrected."""
    return bool((_offset_unsure_um(memory, inputs.tool_number, inputs.found_wrong_um) > UNSURE_UM).any())


def with_probed(memory: OutputMemory, inputs: OutputInputs, probed: FloatArray) -> OutputMemory:
    """Return the memory after a probe of some axes (NaN elsewhere): what they count from is right with this tool.

    A setting of another tool that holds the offset of before is in doubt by what that was.
    """
    before, now_um, axes = memory.counted_found_um, inputs.found_wrong_um, np.isfinite(probed)
    unset = np.full_like(memory.command_um, np.nan) if before is None else before
    tools = dict(memory.tools)
    for number, tool in memory.tools.items():
        if number != inputs.tool_number and (axes & (unset < now_um)).any():
            found_um = tool.found(memory.command_um)
            tools[number] = replace(tool, found_wrong_um=np.where(axes, np.fmin(found_um, unset), found_um))
    return replace(memory, tools=MappingProxyType(tools), counted_found_um=np.where(axes, now_um, unset))


def with_model(memory: OutputMemory, axes: npt.NDArray[np.bool_]) -> OutputMemory:
    """Return the memory after a change of model, which goes on on these axes from the latest estimate of before.

    Where that was not trusted, or there was none since a restart, everything that they count from is in doubt.
    """
    before, unsure_um = memory.counted_found_um, UNKNOWN_UM if memory.error_um is None else memory.unsure_um
    at_risk_um = np.where(axes, unsure_um if unsure_um > UNSURE_UM else 0.0, 0.0)
    unset = np.full_like(memory.command_um, np.nan) if before is None else before
    counted_um = np.where(axes, np.fmin(unset, memory.found_wrong_um - at_risk_um), unset)
    tools = {n: replace(t, found_wrong_um=t.found(memory.command_um) - at_risk_um) for n, t in memory.tools.items()}
    return replace(memory, tools=MappingProxyType(tools), counted_found_um=counted_um)


def carried_over(memory: OutputMemory, tool_number: int, tool: ToolBaseline) -> ToolBaseline:
    """Return a tool's setting at a new reference: what is in doubt of it stays so, the estimate's doubt comes to it."""
    of_tool_um = tool_unsure_um(memory, tool_number, memory.found_wrong_um)
    unsure_um = np.maximum(of_tool_um, _offset_unsure_um(memory, tool_number, memory.found_wrong_um))
    return replace(tool, found_wrong_um=-unsure_um - memory.unsure_um)


def known_bias(memory: OutputMemory, now_s: float) -> BiasState:
    """Return what is known of the offset of probes: nothing after a start of the daemon."""
    return unknown_bias(len(memory.offset_um), now_s / 60.0) if memory.probed is None else memory.probed
