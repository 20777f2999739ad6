"""Where the time of every cycle goes, and what else Prometheus should see."""

from collections.abc import Iterable

import numpy as np
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from models.records import (
    CompensationCommand,
    FloatArray,
    OutputState,
    Receipt,
    TemperatureCycle,
    Trace,
)

DELAY_BUCKETS_S = (0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0)
KEPT_DELAYS = 32768
"""As many of the latest delays are kept for percentiles."""
PUBLISHED_DELAY_S = {"measurement": 20.0, "feedback": 1.2, "total": 24.7}
"""Means published for the source's chain (measurement: more than); another rig, with database polling."""


class DelaySeries:
    """The latest delays of one kind, for percentiles."""

    def __init__(self) -> None:
        self._values = np.zeros(KEPT_DELAYS)
        self._count = 0

    def add(self, delay_s: float) -> None:
        self._values[self._count % KEPT_DELAYS] = delay_s
        self._count += 1

    def summary(self) -> dict[str, float | int | None]:
        """Return mean, percentiles and maximum [s]; None without samples."""
        known = self._values[: min(self._count, KEPT_DELAYS)]
        if not known.size:
            return {"mean": None, "p50": None, "p99": None, "p999": None, "max": None, "samples": 0}
        p50, p99, p999 = np.percentile(known, [50, 99, 99.9])
        return {
            "mean": float(known.mean()),
            "p50": float(p50),
            "p99": float(p99),
            "p999": float(p999),
            "max": float(known.max()),
            "samples": self._count,
        }


class Telemetry:
    """Metrics of one daemon, in a registry of its own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        registry = self.registry
        self.feedback = DelaySeries()
        self.total = DelaySeries()
        self.line_time = DelaySeries()
        self._cycles = Counter("toolpoint_cycles", "Line cycles received", ["line", "complete"], registry=registry)
        self._stage = Histogram(
            "toolpoint_stage_seconds",
            "Wall time from the last byte of a line's cycle to each stage",
            ["stage"],
            buckets=DELAY_BUCKETS_S,
            registry=registry,
        )
        self._delay = Histogram(
            "toolpoint_delay_seconds",
            "line_time: first to last byte (machine time); feedback: last byte to read-back (wall time); "
            "total: their sum. Published for the source's rig: 1.2 s feedback, 24.7 s total",
            ["part"],
            buckets=DELAY_BUCKETS_S,
            registry=registry,
        )
        self._published = Gauge(
            "toolpoint_published_delay_seconds",
            "Means published for the source's chain (another rig, database polling included)",
            ["part"],
            registry=registry,
        )
        for part, seconds in PUBLISHED_DELAY_S.items():
            self._published.labels(part).set(seconds)
        self._last = Gauge(
            "toolpoint_last_cycle_seconds",
            "The latest traced cycle: wall time of each stage after its first byte",
            ["line", "stage"],
            registry=registry,
        )
        self._writes = Counter("toolpoint_writes", "Macro block writes", ["outcome"], registry=registry)
        self._state = Gauge("toolpoint_output_state", "1 for the present output state", ["state"], registry=registry)
        self._axis = Gauge(
            "toolpoint_compensation_micrometres",
            "Compensation per axis: requested, written (after limits), applied (the guard's echo)",
            ["axis", "what"],
            registry=registry,
        )
        self._limits = Counter(
            "toolpoint_limit_hits", "Steps in which a limit acted", ["axis", "limit"], registry=registry
        )
        self._link = Gauge("toolpoint_link_up", "1 while the link is up", ["link"], registry=registry)
        self._sensors = Gauge("toolpoint_sensors_usable", "Sensors with an accepted or held value", registry=registry)
        self._acknowledged = Gauge(
            "toolpoint_history_acknowledged_cycle", "Number of the last committed cycle", ["line"], registry=registry
        )
        self._history_problems = Counter("toolpoint_history_problems", "Errors of the store", registry=registry)

    def cycle(self, cycle: TemperatureCycle) -> None:
        self._cycles.labels(cycle.line, "yes" if cycle.complete else "no").inc()

    def stages(self, line: str, trace: Trace) -> None:
        """Record one cycle that went all the way to the read-back."""
        last = trace.last_byte
        for stage in ("cleansed", "estimated", "written", "read_back"):
            instant = getattr(trace, stage)
            if instant is not None:
                self._stage.labels(stage).observe(instant.real_s - last.real_s)
                self._last.labels(line, stage).set(instant.real_s - trace.first_byte.real_s)
        if trace.read_back is None:
            return
        line_time_s = last.monotonic_s - trace.first_byte.monotonic_s
        feedback_s = trace.read_back.real_s - last.real_s
        for part, series, seconds in (
            ("line_time", self.line_time, line_time_s),
            ("feedback", self.feedback, feedback_s),
            ("total", self.total, line_time_s + feedback_s),
        ):
            series.add(seconds)
            self._delay.labels(part).observe(seconds)

    def write(self, receipt: Receipt) -> None:
        self._writes.labels(receipt.outcome.name.lower()).inc()

    def output(self, command: CompensationCommand, applied_um: FloatArray) -> None:
        for state in OutputState:
            self._state.labels(state.value).set(1.0 if state is command.state else 0.0)
        for index, axis in enumerate(command.axes):
            self._axis.labels(axis, "requested").set(command.requested_um[index])
            self._axis.labels(axis, "written").set(command.compensation_um[index])
            self._axis.labels(axis, "applied").set(applied_um[index])
        for hit in command.limits_hit:
            axis, _, limit = hit.partition(":")
            self._limits.labels(axis, limit).inc()

    def links(self, up: Iterable[tuple[str, bool]]) -> None:
        for name, is_up in up:
            self._link.labels(name).set(1.0 if is_up else 0.0)

    def sensors_usable(self, count: int) -> None:
        self._sensors.set(count)

    def acknowledged(self, line: str, number: int) -> None:
        self._acknowledged.labels(line).set(number)

    def history_problem(self) -> None:
        self._history_problems.inc()
