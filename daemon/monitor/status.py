"""What the daemon tells people and programs about itself: one JSON-able picture."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from config.schema import Configuration
from daemon.compensation.task import ControlTask
from daemon.estimation.task import ThermalTask
from daemon.supervisor import LinkHealth
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from models.quality import Quality, describe
from models.records import DisplacementSample

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SHOWN_SENSORS = 20
"""At most so many sensors that are not good are named."""
SHOWN_FAULTS = 5
"""At most so many faults of a line's latest cycle are named."""


class StatusBoard:
    """Reads the tasks' latest frozen records; owns nothing."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        thermal: ThermalTask,
        control: ControlTask,
        telemetry: Telemetry,
        links: "Sequence[LinkHealth]",
    ) -> None:
        self._configuration = configuration
        self._clock = clock
        self._thermal = thermal
        self._control = control
        self._telemetry = telemetry
        self._links = links
        self.displacement: DisplacementSample | None = None
        self.acknowledged: dict[str, int] = {}
        self.history_problem = ""
        self.model: dict[str, Any] = {}

    def picture(self) -> dict[str, Any]:
        """Return everything at once, with None where a number is not known."""
        now = self._clock.now()
        thermal, control = self._thermal, self._control
        picture = {
            "machine": self._configuration.machine,
            "time_utc_s": now.utc_s,
            "clock_speed": self._clock.speed,
            "output": self._output(now.monotonic_s),
            "axes": self._axes(),
            "reference": self._reference(now.monotonic_s),
            "tools_set": sorted(control.memory.tools) if control.memory else [],
            "model": self.model,
            "estimate": self._estimate(),
            "cnc": self._cnc(),
            "spindle_speed": control.side.speed.picture(),
            "bearing_model": None if (bearings := control.side.speed.worker.model) is None else bearings.picture(),
            "links": [
                {"name": h.name, "up": h.up, "problem": h.problem, "attempts": h.attempts, "failures": h.failures}
                for h in self._links
            ],
            "temperatures": self._temperatures(),
            "displacements": self._displacements(),
            "cycles": {"received": thermal.cycles_received, "incomplete": thermal.cycles_incomplete},
            "estimates": thermal.estimates,
            "writes": dict(control.writer.counts),
            "written_axes": sorted(control.writer.axes),
            "latency_s": self._telemetry.picture(),
            "history": {"acknowledged": dict(self.acknowledged), "problem": self.history_problem},
        }
        cleaned = without_nan(picture)
        assert isinstance(cleaned, dict)
        return cleaned

    def _output(self, now_s: float) -> dict[str, Any]:
        control, memory = self._control, self._control.memory
        return {
            "state": memory.state.value if memory else "OFF",
            "reason": memory.reason if memory else control.not_begun,
            "since_s": now_s - memory.since_s if memory else None,
            "alarm": control.journal.alarm,
            "phase": control.phase.value,
            "limits_hit": list(memory.limits_hit) if memory else [],
            "weight": memory.weight if memory else None,
            "guard_silent_s": control.guard_silent_s,
            "notices": control.journal.notices[-5:],
            "insecure_writes": self._configuration.cnc.allow_insecure_writes,
            "writable_model_directory": self._configuration.compensation.allow_writable_model_directory,
        }

    def _axes(self) -> dict[str, Any]:
        control = self._control
        memory, command, limits = control.memory, control.command, control.limits
        errors = control.thermal_error_um()
        applied = control.applied_um()
        return {
            axis: {
                "estimate_from": self._configuration.compensation.axes[axis].estimate,
                "wanted": memory.wanted[i] if memory else False,
                "enabled": command.enable[i] if command else False,
                "thermal_error_um": errors[i],
                "requested_um": command.requested_um[i] if command else None,
                "written_um": command.compensation_um[i] if command else None,
                "applied_um": applied[i],
                "bound_um": limits.absolute_bound_um[i],
                "slew_um_per_min": limits.slew_um_per_min[i],
            }
            for i, axis in enumerate(limits.axes)
        }

    def _reference(self, now_s: float) -> dict[str, Any] | None:
        reference = self._control.reference
        if reference is None:
            return None
        return {
            "id": reference.reference_id,
            "source": reference.source,
            "age_s": now_s - reference.time.monotonic_s,
            "set_utc_s": reference.time.utc_s,
        }

    def _estimate(self) -> dict[str, Any] | None:
        estimate = self._thermal.latest_estimate
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

    def _cnc(self) -> dict[str, Any] | None:
        session = self._control.session
        if session is None or session.sample is None:
            return None
        sample = session.sample
        return {
            "identity": session.cnc.identity,
            "secure": session.cnc.security == "encrypted",
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
            "echo_status": session.echo.status if session.echo else None,
        }

    def _temperatures(self) -> dict[str, Any] | None:
        latest = self._thermal.latest
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
                line: list(faults[:SHOWN_FAULTS]) for line, faults in self._thermal.line_faults.items() if faults
            },
        }

    def _displacements(self) -> dict[str, Any] | None:
        sample, displacements = self.displacement, self._configuration.displacements
        if sample is None or displacements is None:
            return None
        names = [channel.name for channel in displacements.channels]
        return {"utc_s": sample.utc_s, "um": dict(zip(names, sample.um, strict=True))}


def without_nan(value: "Mapping[str, Any] | Sequence[Any] | Any") -> Any:
    """Return plain JSON values: numpy numbers as Python's, NaN and infinities as None."""
    if isinstance(value, dict):
        return {str(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
