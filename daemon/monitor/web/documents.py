"""The documents of the API that show the present, made from the snapshots of the daemon's tasks."""

import math
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np

from config.schema import Configuration
from config.schema.compensation import ToolTermConfig
from daemon.monitor.status import reference_document
from daemon.snapshots import ControlSnapshot, SnapshotBoard
from daemon.telemetry.latency import PUBLISHED_DELAY_S, PUBLISHED_NOTE, DelaySeries
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from models.json_values import finite_or_none, plain
from models.quality import Quality, describe
from models.records import OutputState

VERSION = version("toolpoint")
COLUMNS = 40
STATES = {state: number for number, state in enumerate(OutputState)}
"""Each state of the output as a number, for charts and metrics."""


class Documents:
    """Makes the documents; holds no task."""

    def __init__(self, configuration: Configuration, clock: Clock, board: SnapshotBoard, telemetry: Telemetry) -> None:
        self._configuration, self._clock, self._board, self._telemetry = configuration, clock, board, telemetry

    # --- the state of everything --------------------------------------------------------

    def status(self) -> dict[str, Any]:
        control, now = self._board.control, self._clock.now()
        since_s = control.since_monotonic_s
        document = {
            "machine": self._configuration.machine,
            "version": VERSION,
            "time": now.utc_s,
            "clock_speed": self._clock.speed,
            "age_s": self.age_s(),
            "state": control.state.value,
            "reason": control.reason,
            "since_s": None if since_s is None else now.monotonic_s - since_s,
            "phase": control.phase.value,
            "alarm": control.alarm,
            "fault": control.fault,
            "problems": self.problems(),
            "notices": list(control.notices),
            "axes": self.axes(),
            "reference": _reference(control, now.monotonic_s),
            "reference_ended": control.reference_ended,
            "spindle_speed": self._spindle_speed(control),
            "links": [
                {
                    "name": link.name,
                    "up": link.up,
                    "problem": link.problem,
                    "losses": link.losses,
                    "last_problem": link.last_problem,
                    "last_problem_time": link.last_problem_utc_s,
                }
                for link in self._board.links
            ],
            "model": None if self._board.model is None else asdict(self._board.model),
            "sensors": self._sensor_counts(),
            "writes": asdict(control.writes),
            "latency": self.latency_summary(),
        }
        return plain(document)

    def age_s(self) -> float | None:
        """Return the age of the newest temperatures [s]; None before the first."""
        latest, now_s = self._board.thermal.temperatures, self._clock.now().monotonic_s
        return None if latest is None else max(0.0, now_s - latest.trace.last_byte.monotonic_s)

    def axes(self) -> dict[str, dict[str, Any]]:
        """Return the compensation of each axis beside its bound."""
        control, estimate = self._board.control, self._board.thermal.estimate
        remaining_um = control.thermal_error_um + control.applied_um - control.baseline_um
        axes: dict[str, dict[str, Any]] = {}
        for i, axis in enumerate(control.axes):
            channel = self._configuration.compensation.axes[axis].estimate
            band_um = math.nan
            if estimate is not None and channel in estimate.channels:
                band_um = float(estimate.band_um[estimate.channels.index(channel)])
            axes[axis] = {
                "channel": channel,
                "estimated_um": control.thermal_error_um[i],
                "remaining_um": remaining_um[i],
                "requested_um": control.requested_um[i],
                "written_um": control.written_um[i],
                "applied_um": control.applied_um[i],
                "band_um": band_um,
                "bound_um": control.bound_um[i],
                "baseline_um": control.baseline_um[i],
                "tool_um_per_k": _tool_um_per_k(self._configuration.compensation.axes[axis].tool_term),
                "wanted": control.wanted[i],
                "enabled": control.enabled[i],
                "confidence": estimate.confidence if estimate is not None and channel else None,
                "limits_hit": [hit.partition(":")[2] for hit in control.limits_hit if hit.startswith(f"{axis}:")],
                **self._configuration.compensation.unit_of(axis),
                **self._configuration.compensation.pivot_of(axis),
            }
        return axes

    def _spindle_speed(self, control: ControlSnapshot) -> dict[str, Any]:
        speed, cnc = self._board.spindle_speed, control.cnc
        actual_rpm = cnc.sample.spindle_speed_rpm if cnc is not None else None
        if speed is None:
            why = "not configured: the section spindle_speed of the configuration makes the speed follow the lobes"
            return {"configured": False, "actual_rpm": actual_rpm, "why": why}
        return {
            "configured": True,
            "state": speed.state,
            "switched_on": speed.switched_on,
            "actual_rpm": actual_rpm,
            "programmed_rpm": speed.programmed_rpm,
            "written_rpm": speed.commanded_rpm,
            "target_rpm": speed.target_rpm,
            "why": speed.alarm or speed.reason,
        }

    def problems(self) -> list[str]:
        """Return what a person should look at, the gravest first."""
        board, control = self._board, self._board.control
        problems = [control.alarm] if control.alarm else []
        problems += [f"link {link.name}: {link.problem}" for link in board.links if not link.up]
        if control.state is not OutputState.ACTIVE:  # a disturbed pass now and then holds nothing
            problems += [faults[0] for faults in board.thermal.line_faults.values() if faults]
        problems += [board.history.problem] if board.history.problem else []
        models = [model for model in (board.model, board.bearing_model) if model is not None]
        problems += [words for model in models for words in (model.problem, model.warning) if words]
        problems += [board.thermal.model_waits] if board.thermal.model_waits else []
        problems += [f"{job.name}: {job.problem}" for job in board.jobs if job.problem]
        return problems

    def unhealthy(self) -> str:
        """Return why the health is bad, '' when the output may act and every link is up."""
        control = self._board.control
        reasons = [f"FAULT: {control.alarm or control.reason}"] if control.state is OutputState.FAULT else []
        reasons += [
            f"link {link.name} is down: {link.problem or 'not up yet'}" for link in self._board.links if not link.up
        ]
        return "; ".join(reasons)

    def _sensor_counts(self) -> dict[str, int]:
        latest, total = self._board.thermal.temperatures, len(self._configuration.temperatures.sensor_ids)
        usable = 0 if latest is None else int(np.isfinite(latest.degc).sum())
        good = 0 if latest is None else int((latest.quality == Quality.GOOD).sum())
        return {"total": total, "usable": usable, "good": good}

    # --- temperatures -------------------------------------------------------------------

    def sensors(self) -> dict[str, Any]:
        """Return every sensor's newest temperature, its quality and the reason."""
        latest, temperatures = self._board.thermal.temperatures, self._configuration.temperatures
        rows = []
        for i, sensor in enumerate(temperatures.every_sensor):
            row: dict[str, Any] = {
                "name": f"temperature.{sensor.id}",
                "id": sensor.id,
                "component": sensor.component,
                "part": None if sensor.part == "-" else sensor.part,
                "label": sensor.label,
                "degc": None,
                "measured_degc": None,
                "quality": "missing",
                "reason": "nothing has arrived yet",
                "age_s": None,
            }
            if latest is not None:
                quality = Quality(int(latest.quality[i]))
                row |= {
                    "degc": finite_or_none(float(latest.degc[i]), 3),
                    "measured_degc": finite_or_none(float(latest.measured_degc[i]), 3),
                    "quality": quality.name.lower(),
                    "reason": "" if quality is Quality.GOOD else describe(int(latest.reason[i])),
                    "age_s": finite_or_none(float(latest.age_s[i]), 1),
                }
            rows.append(row)
        faults = {line: list(found) for line, found in self._board.thermal.line_faults.items() if found}
        return {
            "time": None if latest is None else latest.trace.last_byte.utc_s,
            "sensors": rows,
            "line_faults": faults,
        }

    def cycle(self) -> dict[str, Any]:
        """Return the newest temperatures alone, in the order of `sensors`, for the live events."""
        latest = self._board.thermal.temperatures
        if latest is None:
            return {"time": None, "degc": [], "quality": []}
        degc = np.round(latest.degc, 3)
        return {
            "time": latest.trace.last_byte.utc_s,
            "line": latest.line,
            "degc": plain(degc),
            "quality": latest.quality.tolist(),
        }

    # --- delays -------------------------------------------------------------------------

    def latency_summary(self) -> dict[str, Any]:
        """Return the delay beside the published one."""
        delays = self._telemetry.picture()
        return {
            "measurement": delays["measurement"],
            "feedback": delays["feedback"],
            "total": delays["total"],
            "published_s": PUBLISHED_DELAY_S["total"],
        }

    def latency(self) -> dict[str, Any]:
        """Return every stage's percentiles beside the published means."""
        delays = self._telemetry.picture()
        series = self._telemetry.delays | {"echo": self._telemetry.echo}
        document = {
            "stages": {name: delays[name] for name in series},
            "published_s": dict(PUBLISHED_DELAY_S),
            "published_note": PUBLISHED_NOTE,
            "histograms": {name: histogram(each) for name, each in series.items()},
        }
        return plain(document)


def _reference(control: ControlSnapshot, now_s: float) -> dict[str, Any] | None:
    found = reference_document(control, now_s)
    if found is not None:
        found["time"] = found.pop("set_utc_s")
    return found


def _tool_um_per_k(term: ToolTermConfig | None) -> dict[str, float]:
    """Return what 1 K of each label adds to the axis by the tool's own growth [um/K]."""
    if term is None:
        return {}
    um_per_k = term.direction * term.expansion_um_per_m_k * term.length_mm * 1e-3
    return {label: um_per_k * weight for label, weight in term.temperatures.items()}


def histogram(delays: DelaySeries) -> dict[str, list[float] | list[int]]:
    """Return how many of the latest delays lie between each two edges [s]; the largest thousandth lies in the last."""
    values = delays.latest()
    if not values.size:
        return {"edges": [], "counts": []}
    low, high = float(values.min()), float(np.percentile(values, 99.9))
    counts, edges = np.histogram(np.minimum(values, high), COLUMNS, (low, high if high > low else low + 1e-6))
    return {"edges": np.round(edges, 6).tolist(), "counts": counts.tolist()}
