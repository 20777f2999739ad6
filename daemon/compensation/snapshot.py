"""The snapshot of the control task, for status and for commands."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from daemon.cnc.session import CncSession
from daemon.messages import OutputActions
from daemon.snapshots import CncSnapshot, ControlSnapshot, WriteCounts
from models.records import OutputState

if TYPE_CHECKING:
    from daemon.compensation.task import ControlTask

NOTICES_SHOWN = 5


def control_snapshot(control: "ControlTask") -> ControlSnapshot:
    memory, command, limits = control.memory, control.command, control.limits
    count = len(limits.axes)
    unknown = np.full(count, np.nan)
    none = (False,) * count
    return ControlSnapshot(
        state=memory.state if memory is not None else OutputState.OFF,
        reason=memory.reason if memory is not None else control.not_begun,
        since_monotonic_s=memory.since_s if memory is not None else None,
        alarm=control.journal.alarm,
        fault=control.journal.number,
        notices=tuple(control.journal.notices[-NOTICES_SHOWN:]),
        phase=control.phase,
        limits_hit=memory.limits_hit if memory is not None else (),
        weight=memory.weight if memory is not None else None,
        guard_silent_s=control.guard_watch.silent_s,
        axes=limits.axes,
        wanted=memory.wanted if memory is not None else none,
        enabled=command.enable if command is not None else none,
        thermal_error_um=control.thermal_error_um(),
        requested_um=command.requested_um if command is not None else unknown,
        written_um=command.compensation_um if command is not None else unknown,
        applied_um=control.applied_um(),
        baseline_um=memory.baseline_um if memory is not None and memory.reference_id is not None else unknown,
        bound_um=limits.absolute_bound_um,
        slew_um_per_min=limits.slew_um_per_min,
        reference=control.reference,
        reference_ended=control.reference_ended,
        tools_set=tuple(sorted(memory.tools)) if memory is not None else (),
        cnc=_cnc(control.session),
        writes=WriteCounts(**control.writer.counts),
        written_axes=tuple(sorted(control.writer.axes)),
    )


def _cnc(session: CncSession | None) -> CncSnapshot | None:
    if session is None or session.sample is None:
        return None
    return CncSnapshot(
        identity=session.cnc.identity,
        secure=session.cnc.security == "encrypted",
        sample=session.sample,
        echo_status=session.echo.status if session.echo is not None else None,
    )


def output_actions(control: "ControlTask", switch_spindle_speed: Callable[[bool, str], str]) -> OutputActions:
    """Return what a person may ask of the output."""
    return OutputActions(
        request=control.request,
        request_reference=control.requests.put_reference,
        switch_spindle_speed=switch_spindle_speed,
        record_refusal=control.requests.note_refusal,
        carried_out=control.requests.carried_out,
    )
