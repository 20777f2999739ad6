"""The output's state machine and limits, as a pure step.

`step` takes what is known now and returns what to write. It knows neither clock nor wire, so
that every history of inputs, faults and operator actions can be tested. The table `TRANSITIONS`
is the whole state machine: for each state the conditions that leave it, the first that holds wins.

Sign: thermal error is actual minus nominal; compensation is minus the error, after the limits.
"""

from dataclasses import replace
from enum import StrEnum

import numpy as np

from models.control.baseline import follow_error, follow_reference, follow_tool, request_um, rest_of_tool
from models.control.measured import measured_inhibit
from models.control.probe_values import follow_confidence, take_probe, weight_of
from models.control.state import Inhibit, InhibitCode, OutputInputs, OutputLimits, OutputMemory
from models.records import CompensationCommand, FloatArray, OutputState, Phase

LONGEST_INTERVAL_S = 30.0
"""A step after a longer pause moves no further than after this one [s]."""
ZERO_UM = 1e-6
"""An applied value smaller than this is zero [um]."""


class Condition(StrEnum):
    """What may leave a state."""

    OUTPUT_FAULT = "output not trusted"
    WANTED = "an axis is switched on"
    NONE_WANTED = "every axis is switched off"
    ZERO_FIRST = "the offset is taken out before work is positioned"
    READY = "reference, model, input and links are good"
    BAD_INPUT = "input is not good"
    HELD_TOO_LONG = "held for longer than the limit"
    RETREATED = "the guard applies zero"
    ACKNOWLEDGED = "acknowledged by a person"


TRANSITIONS: dict[OutputState, tuple[tuple[Condition, OutputState], ...]] = {
    OutputState.OFF: (
        (Condition.OUTPUT_FAULT, OutputState.FAULT),
        (Condition.WANTED, OutputState.ARMED),
    ),
    OutputState.ARMED: (
        (Condition.OUTPUT_FAULT, OutputState.FAULT),
        (Condition.NONE_WANTED, OutputState.RETREAT),
        (Condition.ZERO_FIRST, OutputState.RETREAT),
        (Condition.READY, OutputState.ACTIVE),
    ),
    OutputState.ACTIVE: (
        (Condition.OUTPUT_FAULT, OutputState.FAULT),
        (Condition.NONE_WANTED, OutputState.RETREAT),
        (Condition.ZERO_FIRST, OutputState.RETREAT),
        (Condition.BAD_INPUT, OutputState.HOLD),
    ),
    OutputState.HOLD: (
        (Condition.OUTPUT_FAULT, OutputState.FAULT),
        (Condition.NONE_WANTED, OutputState.RETREAT),
        (Condition.ZERO_FIRST, OutputState.RETREAT),
        (Condition.READY, OutputState.ACTIVE),
        (Condition.HELD_TOO_LONG, OutputState.RETREAT),
    ),
    OutputState.RETREAT: (
        (Condition.OUTPUT_FAULT, OutputState.FAULT),
        (Condition.WANTED, OutputState.ARMED),
        (Condition.RETREATED, OutputState.OFF),
    ),
    OutputState.FAULT: ((Condition.ACKNOWLEDGED, OutputState.HOLD),),
}
"""State -> (condition, next state), the first condition that holds wins."""


def initial_memory(
    *, now_s: float, applied_um: FloatArray, wanted: tuple[bool, ...], settled: bool = True
) -> OutputMemory:
    """Return the memory at the start of the daemon: the command begins at the CNC's echo.

    Raises ValueError when an echo is not finite: nothing may start from an unknown position.

    `now_s`: monotonic time [s]. `applied_um`: the guard's echo, shape (n_axes,) [um]; every value must be finite.
    `wanted`: axes that a person had switched on before the restart. `settled`: the echo says what is applied.
    """
    if not np.isfinite(applied_um).all():
        raise ValueError("the CNC's echo is vacant or not a number; commissioning initialises it")
    moved = not settled or bool(np.any(np.abs(applied_um) > ZERO_UM))
    axes = len(applied_um)
    return OutputMemory(
        state=OutputState.HOLD if moved else OutputState.OFF,
        since_s=now_s,
        reason="the CNC still applies an offset from before the start" if moved else "started",
        last_s=now_s,
        command_um=np.array(applied_um, dtype=np.float64),
        baseline_um=np.array(applied_um, dtype=np.float64),
        reference_id=None,
        model_id=None,
        offset_um=np.zeros(axes),
        wanted=wanted,
    )


def begun_at(memory: OutputMemory, applied_um: FloatArray) -> OutputMemory:
    """Return the memory of an output that is OFF or has written nothing yet, begun at a newer echo, (n_axes,) [um]."""
    command_um = np.where(np.isfinite(applied_um), applied_um, memory.command_um)
    begun = initial_memory(now_s=memory.since_s, applied_um=command_um, wanted=memory.wanted)
    now = begun if memory.state is OutputState.OFF and begun.state is not OutputState.OFF else memory
    return replace(memory, command_um=command_um, state=now.state, reason=now.reason)


def step(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> tuple[OutputMemory, CompensationCommand]:
    """Advance the output by one step.

    Result: `memory`, `command`: the new memory, and what is to be written. `command.compensation_um` is finite, never
    leaves the absolute bound by moving, and moves by at most the slew rate [um], except that it returns at once to what
    the guard has applied when a reference is set and when a fault is acknowledged (the tool is already there).

    `memory`: from `initial_memory` or the previous step. `inputs`: what is known now; arrays of shape (n_axes,) in the
    order of `limits.axes`. `limits`: bounds; `n_axes` rows.
    """
    memory = _heed_requests(memory, inputs, limits)
    memory = follow_error(follow_reference(memory, inputs, limits), inputs, limits)
    memory = follow_tool(memory, inputs)
    memory = follow_confidence(take_probe(memory, inputs, limits), inputs, limits)
    memory = _where_withdrawn(_change_state(memory, inputs, limits), inputs)
    requested = _request(memory, inputs)
    command, hit = _limit(memory, inputs, limits, requested)
    memory = replace(memory, command_um=command, last_s=max(inputs.now_s, memory.last_s), limits_hit=hit)
    enable = _enable_bits(memory, inputs)
    return memory, CompensationCommand(
        axes=limits.axes,
        requested_um=requested.copy(),
        compensation_um=command.copy(),
        enable=enable,
        state=memory.state,
        reason=memory.reason,
        write=inputs.link and memory.state is not OutputState.FAULT,
        limits_hit=hit,
    )


def follow_inhibit(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> Inhibit | None:
    """Return the first reason against following: of the estimate, or of what was measured; None when there is none."""
    return first_inhibit(memory, inputs, limits) or measured_inhibit(memory, inputs, limits)


def first_inhibit(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> Inhibit | None:
    """Return the first reason against counting from the estimate, None when there is none."""
    if inputs.inhibits:
        return inputs.inhibits[0]
    if not inputs.link:
        return Inhibit(code=InhibitCode.LINK, text="no link to the CNC")
    if not np.isfinite(inputs.applied_um).all():
        return Inhibit(code=InhibitCode.ECHO, text="the CNC's echo is vacant")
    if inputs.reference_id is None:
        ended = inputs.reference_ended or "the NC program has not passed its positioning"
        return Inhibit(code=InhibitCode.REFERENCE, text=f"no valid reference: {ended}")
    if inputs.estimate_age_s > limits.stale_after_s:
        age = "there is no estimate" if np.isinf(inputs.estimate_age_s) else f"{inputs.estimate_age_s:.0f} s old"
        return Inhibit(code=InhibitCode.STALE, text=f"temperatures are stale ({age})")
    if inputs.estimate_reference_id != inputs.reference_id or memory.reference_id != inputs.reference_id:
        return Inhibit(code=InhibitCode.REFERENCE, text="waiting for the first estimate of this reference")
    return _inhibit_of_estimate(memory, inputs, limits)


def _inhibit_of_estimate(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> Inhibit | None:
    if inputs.confidence < limits.min_confidence:
        why = inputs.inhibit or "sensors missing"
        text = f"confidence {inputs.confidence:.2f} is below {limits.min_confidence:.2f} ({why})"
        return Inhibit(code=InhibitCode.CONFIDENCE, text=text)
    if not inputs.in_domain:
        text = "temperatures are outside the range that the model was trained on"
        return Inhibit(code=InhibitCode.DOMAIN, text=text)
    without = np.array(memory.wanted, dtype=bool) & ~np.isfinite(inputs.error_of_tool_point_um)
    if without.any():
        axes = ", ".join(axis for axis, missing in zip(limits.axes, without, strict=True) if missing)
        return Inhibit(
            code=InhibitCode.NO_ESTIMATE,
            text=f"no estimate for axis {axes}: sensors that its model counts from have no value, or had none when "
            "the work was positioned or the tool came into the spindle",
            remedy="bring them back, then position the work again or change the tool, or switch the axis off",
        )
    in_cut = inputs.phase is Phase.CUTTING and memory.state in (OutputState.ACTIVE, OutputState.HOLD)
    if in_cut and weight_of(inputs.confidence, limits) < memory.weight:
        text = f"confidence fell to {inputs.confidence:.2f} within a cut: frozen until the next safe point"
        return Inhibit(code=InhibitCode.CONFIDENCE, text=text)
    return None


def _heed_requests(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    request = inputs.request
    if request.zero:
        return replace(memory, wanted=(False,) * len(limits.axes), to_zero=True)
    if not (request.enable or request.disable):
        return memory
    wanted = tuple(
        (on or axis in request.enable) and axis not in request.disable
        for axis, on in zip(limits.axes, memory.wanted, strict=True)
    )
    return replace(memory, wanted=wanted, to_zero=memory.to_zero and not any(wanted))


def _change_state(memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits) -> OutputMemory:
    inhibit = follow_inhibit(memory, inputs, limits)
    why = "" if inhibit is None else str(inhibit)
    known = bool(np.isfinite(inputs.applied_um).all())
    any_wanted = any(memory.wanted)
    holds = {
        Condition.OUTPUT_FAULT: inputs.output_fault is not None,
        Condition.WANTED: any_wanted and inputs.link and known and not inputs.zero_first,
        Condition.NONE_WANTED: not any_wanted,
        Condition.ZERO_FIRST: inputs.zero_first,
        Condition.READY: inhibit is None and any_wanted,
        Condition.BAD_INPUT: inhibit is not None,
        Condition.HELD_TOO_LONG: inputs.now_s - memory.since_s > limits.hold_limit_s,
        Condition.RETREATED: memory.state is OutputState.RETREAT and inputs.link and _at_zero(memory, inputs),
        Condition.ACKNOWLEDGED: inputs.request.acknowledge > 0 and inputs.link and known and not inputs.output_fault,
    }
    for condition, target in TRANSITIONS[memory.state]:
        if holds[condition]:
            return _enter(memory, target, condition, why, inputs)
    if memory.state is OutputState.FAULT:
        why = inputs.output_fault or ""
    elif memory.state not in (OutputState.ARMED, OutputState.HOLD):
        return memory
    return memory if why in ("", memory.reason) else replace(memory, reason=why)


def _at_zero(memory: OutputMemory, inputs: OutputInputs) -> bool:
    return bool(inputs.settled and (np.abs(inputs.applied_um) <= ZERO_UM).all() and (memory.command_um == 0.0).all())


def _enter(
    memory: OutputMemory, target: OutputState, condition: Condition, why: str, inputs: OutputInputs
) -> OutputMemory:
    reason = {
        Condition.OUTPUT_FAULT: inputs.output_fault or "",
        Condition.WANTED: why or "switched on",
        Condition.BAD_INPUT: why,
        Condition.READY: "following the estimate",
        Condition.NONE_WANTED: "switched off",
        Condition.HELD_TOO_LONG: "held too long, so a person must switch it on again; the reason then: "
        f"{memory.reason}",
        Condition.RETREATED: memory.reason,
    }.get(condition, str(condition))
    entered = replace(memory, state=target, since_s=inputs.now_s, reason=reason)
    if memory.state is OutputState.FAULT:
        entered = replace(entered, command_um=inputs.applied_um.copy())
    if condition is Condition.HELD_TOO_LONG:
        entered = replace(entered, wanted=(False,) * len(memory.wanted))
    if target is OutputState.OFF:
        entered = replace(entered, to_zero=False)
    return entered


def _where_withdrawn(memory: OutputMemory, inputs: OutputInputs) -> OutputMemory:
    """Let what is not followed begin where the guard has gone after an expiry: only an estimate puts it back."""
    if not inputs.withdrawn or memory.state in (OutputState.OFF, OutputState.FAULT):
        return memory
    rests = np.isfinite(inputs.applied_um) & (np.abs(inputs.applied_um) < np.abs(memory.command_um))
    if memory.state is OutputState.ACTIVE:
        rests &= ~np.array(memory.wanted, dtype=bool)
    return replace(memory, command_um=np.where(rests, inputs.applied_um, memory.command_um)) if rests.any() else memory


def _request(memory: OutputMemory, inputs: OutputInputs) -> FloatArray:
    """Return where each axis should go [um], before any limit."""
    to_zero = memory.to_zero or inputs.zero_first or memory.reference_id is None
    retreat = np.zeros(len(memory.command_um)) if to_zero else rest_of_tool(memory, inputs)[0]
    if memory.state is OutputState.RETREAT:
        return retreat
    if memory.state is OutputState.OFF:
        return np.zeros(len(memory.command_um))
    if memory.state is OutputState.ACTIVE and not memory.settling:
        request = np.where(memory.wanted, request_um(memory, inputs), retreat)
        return np.where(np.isfinite(request), request, memory.command_um)
    frozen = memory.command_um.copy()
    if memory.state is OutputState.FAULT:
        return frozen
    return np.where(memory.wanted, frozen, retreat)


def _limit(
    memory: OutputMemory, inputs: OutputInputs, limits: OutputLimits, requested: FloatArray
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the request after bound, deadband, slew rate and step, and which of them acted."""
    current = memory.command_um
    if memory.state is OutputState.FAULT or not inputs.link:
        return current.copy(), ()
    bounded = np.clip(requested, -limits.absolute_bound_um, limits.absolute_bound_um)
    follows = memory.state is OutputState.ACTIVE
    still = np.abs(bounded - current) < limits.deadband_um
    target = np.where(follows & still & np.array(memory.wanted, dtype=bool), current, bounded)
    elapsed_s = min(max(inputs.now_s - memory.last_s, 0.0), LONGEST_INTERVAL_S)
    reach = limits.slew_um_per_min * (elapsed_s / 60.0)
    slewed = current + np.clip(target - current, -reach, reach)
    lower, upper = inputs.applied_um - limits.step_um, inputs.applied_um + limits.step_um
    lower, upper = np.minimum(lower, current), np.maximum(upper, current)
    stepped = np.where(np.isfinite(inputs.applied_um), np.clip(slewed, lower, upper), current)
    hit = tuple(
        f"{axis}:{name}"
        for name, acted in (
            ("bound", bounded != requested),
            ("slew", slewed != target),
            ("step", stepped != slewed),
        )
        for axis, yes in zip(limits.axes, acted.tolist(), strict=True)
        if yes
    )
    return stepped, hit


def _enable_bits(memory: OutputMemory, inputs: OutputInputs) -> tuple[bool, ...]:
    """Return the enable bit per axis: 1 while it is wanted or still carries an offset."""
    if memory.state in (OutputState.OFF, OutputState.FAULT):
        return (False,) * len(memory.wanted)
    carries = (np.abs(inputs.applied_um) > ZERO_UM) | (memory.command_um != 0.0) | ~np.isfinite(inputs.applied_um)
    return tuple(bool(on or busy) for on, busy in zip(memory.wanted, carries.tolist(), strict=True))
