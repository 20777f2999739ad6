"""The snapshot of the tuning: the operation, its plan and the command, for status."""

from daemon.snapshots import SpindleSpeedSnapshot
from daemon.spindle_speed.calls import SpeedOperation
from daemon.spindle_speed.macro_block import SpeedPair
from daemon.spindle_speed.messages import PlannedSpeed


def speed_snapshot(
    *,
    state: str,
    reason: str,
    alarm: str,
    switched_on: bool,
    stands_off: bool,
    applied_rpm: float | None,
    nc_status: int | None,
    operation: SpeedOperation | None,
    planned: PlannedSpeed | None,
    followed: SpeedPair | None,
) -> SpindleSpeedSnapshot:
    """Return operation, plan and command, None where there is none; `followed`: the pair that the NC may take."""
    called = operation.called if operation is not None else None
    plan = planned.plan if planned is not None and planned.called == called else None
    return SpindleSpeedSnapshot(
        state=state,
        reason=reason,
        alarm=alarm,
        switched_on=switched_on,
        stands_off=stands_off,
        applied_rpm=applied_rpm,
        nc_status=nc_status,
        operation=str(operation.made_for) if operation is not None else None,
        tool_number=called.tool_number if called is not None else None,
        programmed_rpm=called.speed_rpm if called is not None else None,
        commanded_rpm=followed.speed_rpm if followed is not None else None,
        commanded_feed_mm_min=followed.feed_mm_min if followed is not None else None,
        target_rpm=plan.choice.speed_rpm if plan is not None else None,
        limiting_depth_mm=plan.choice.limiting_depth_mm if plan is not None else None,
        margin_met=plan.choice.margin_met if plan is not None else None,
        flagged_span_rpm=plan.flagged_span_rpm if plan is not None else None,
        resonance_hz=planned.resonance_hz if planned is not None else {},
        change_per_sensor_step_rpm=planned.change_per_step_rpm if planned is not None else {},
        diagram=planned.diagram if planned is not None else None,
    )
