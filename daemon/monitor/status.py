"""Makes the daemon's status, ready for JSON, from the snapshots of its tasks."""

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from config.schema import Configuration
from daemon.snapshots import ControlSnapshot, ModelSnapshot, SnapshotBoard, ThermalSnapshot
from drivers.clock import Clock
from models.json_values import plain
from models.quality import Quality, describe

SHOWN_SENSORS = 20
"""At most so many sensors that are not good are named."""
SHOWN_FAULTS = 5
"""At most so many faults of a line's latest cycle are named."""


class StatusBoard:
    """Makes the status from the latest snapshots; holds no task."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        snapshots: SnapshotBoard,
        latency: Callable[[], dict[str, object]],
    ) -> None:
        """`latency` returns the percentiles of the delays."""
        self._configuration = configuration
        self._clock = clock
        self._snapshots = snapshots
        self._latency = latency

    def picture(self) -> dict[str, Any]:
        """Return everything at once, with None where a number is not known."""
        now, board = self._clock.now(), self._snapshots
        thermal, control = board.thermal, board.control
        picture = {
            "machine": self._configuration.machine,
            "time_utc_s": now.utc_s,
            "clock_speed": self._clock.speed,
            "output": self._output(control, now.monotonic_s),
            "axes": self._axes(control),
            "reference": reference_document(control, now.monotonic_s),
            "reference_ended": control.reference_ended,
            "tools_set": list(control.tools_set),
            "model": (_model(board.model) or {}) | {"waits": thermal.model_waits},
            "estimate": self._estimate(thermal),
            "cnc": _cnc(control),
            "spindle_speed": self._spindle_speed(),
            "bearing_model": _model(board.bearing_model),
            "links": [asdict(link) for link in board.links],
            "temperatures": self._temperatures(thermal),
            "displacements": self._displacements(),
            "displacement_rows": self._displacement_rows(),
            "cycles": {"received": thermal.cycles_received, "incomplete": thermal.cycles_incomplete},
            "estimates": thermal.estimates,
            "writes": asdict(control.writes),
            "written_axes": list(control.written_axes),
            "latency_s": self._latency(),
            "history": {"acknowledged": dict(board.history.acknowledged), "problem": board.history.problem},
            "jobs": [asdict(job) for job in board.jobs],
        }
        return plain(picture)

    def _output(self, control: ControlSnapshot, now_s: float) -> dict[str, Any]:
        since_s = control.since_monotonic_s
        return {
            "state": control.state.value,
            "reason": control.reason,
            "since_s": now_s - since_s if since_s is not None else None,
            "alarm": control.alarm,
            "fault": control.fault,
            "phase": control.phase.value,
            "limits_hit": list(control.limits_hit),
            "weight": control.weight,
            "guard_silent_s": control.guard_silent_s,
            "notices": list(control.notices),
            "insecure_writes": self._configuration.cnc.allow_insecure_writes,
            "writable_model_directory": self._configuration.compensation.allow_writable_model_directory,
        }

    def _axes(self, control: ControlSnapshot) -> dict[str, Any]:
        return {
            axis: {
                "estimate_from": self._configuration.compensation.axes[axis].estimate,
                "wanted": control.wanted[i],
                "enabled": control.enabled[i],
                "thermal_error_um": control.thermal_error_um[i],
                "requested_um": control.requested_um[i],
                "written_um": control.written_um[i],
                "applied_um": control.applied_um[i],
                "bound_um": control.bound_um[i],
                "baseline_um": control.baseline_um[i],
                "slew_um_per_min": control.slew_um_per_min[i],
                **self._configuration.compensation.unit_of(axis),
                **self._configuration.compensation.pivot_of(axis),
            }
            for i, axis in enumerate(control.axes)
        }

    def _estimate(self, thermal: ThermalSnapshot) -> dict[str, Any] | None:
        estimate = thermal.estimate
        if estimate is None:
            return None
        return {
            "model": estimate.model_id,
            "channels": dict(zip(estimate.channels, estimate.thermal_error_um, strict=True)),
            "band_um": dict(zip(estimate.channels, estimate.band_um, strict=True)),
            "confidence": estimate.confidence,
            "in_domain": estimate.in_domain,
            "imputed": list(estimate.imputed[:SHOWN_SENSORS]),
            "filter_delay_s": self._configuration.compensation.reference.mean_s / 2.0,
        }

    def _spindle_speed(self) -> dict[str, Any] | None:
        speed = self._snapshots.spindle_speed
        if speed is None:
            return None
        picture = asdict(replace(speed, diagram=None))
        del picture["stands_off"], picture["diagram"]
        return picture | {"wished_rpm": speed.target_rpm}  # its name in 0.1.0

    def _temperatures(self, thermal: ThermalSnapshot) -> dict[str, Any] | None:
        latest = thermal.temperatures
        if latest is None:
            return None
        ids = self._configuration.temperatures.sensor_ids
        bad = np.flatnonzero(latest.quality != Quality.GOOD)
        labels: dict[str, float] = {}
        for label, indices in self._configuration.temperatures.labels.items():
            known = latest.degc[list(indices)]
            labels[label] = float(np.nanmean(known)) if np.isfinite(known).any() else math.nan
        return {
            "usable": int(np.isfinite(latest.degc).sum()),
            "total": len(ids),
            "labels_degc": labels,
            "not_good": {str(ids[i]): describe(int(latest.reason[i])) for i in bad[:SHOWN_SENSORS]},
            "not_good_count": int(bad.size),
            "line_faults": {
                line: list(faults[:SHOWN_FAULTS]) for line, faults in thermal.line_faults.items() if faults
            },
        }

    def _displacements(self) -> dict[str, Any] | None:
        sample, displacements = self._snapshots.displacements.latest, self._configuration.displacements
        if sample is None or displacements is None:
            return None
        names = [channel.name for channel in displacements.every_channel]
        return {"utc_s": sample.utc_s, "um": dict(zip(names, sample.um, strict=True))}

    def _displacement_rows(self) -> dict[str, Any] | None:
        """Return how many rows of the logger's files were read, and what could not be; None without displacements."""
        if self._configuration.displacements is None:
            return None
        found = self._snapshots.displacements
        return {
            "read": found.rows_read,
            "problems": found.problems,
            "last_problem": found.last_problem,
            "last_problem_utc_s": found.last_problem_utc_s,
        }


def reference_document(control: ControlSnapshot, now_s: float) -> dict[str, Any] | None:
    """Return the reference in force at a monotonic time [s]; None without one."""
    reference = control.reference
    if reference is None:
        return None
    return {
        "id": reference.reference_id,
        "source": reference.source,
        "age_s": now_s - reference.time.monotonic_s,
        "set_utc_s": reference.time.utc_s,
        "program": reference.program,
        "work_offset": reference.work_offset,
    }


def _cnc(control: ControlSnapshot) -> dict[str, Any] | None:
    cnc = control.cnc
    if cnc is None:
        return None
    sample = cnc.sample
    return {
        "identity": cnc.identity,
        "secure": cnc.secure,
        "mode": sample.mode.value,
        "run": sample.run.value,
        "alarm": sample.alarm,
        "program": sample.program,
        "sequence_number": sample.sequence_number,
        "spindle_speed_rpm": sample.spindle_speed_rpm,
        "motor_temperature_degc": sample.motor_temperature_degc,
        "tool_number": sample.tool_number,
        "work_offset": sample.work_offset,
        "power_on_count": sample.power_on_count,
        "echo_status": cnc.echo_status,
    }


def _model(model: ModelSnapshot | None) -> dict[str, Any] | None:
    return None if model is None else asdict(model)
