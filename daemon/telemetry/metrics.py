"""The metrics for Prometheus: delays of every cycle, writes, states, links."""

import ctypes
from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
import structlog
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from daemon.telemetry.latency import PUBLISHED_DELAY_S, PUBLISHED_NOTE, CycleDelays, DelaySeries, LineTiming, warm_up
from models.records import CompensationCommand, FloatArray, OutputState, Receipt, TemperatureCycle, Trace

log = structlog.get_logger(__name__)

DELAY_BUCKETS_S = (
    0.001,
    0.002,
    0.003,
    0.005,
    0.01,
    0.02,
    0.05,
    0.1,
    0.25,
    0.5,
    1.0,
    2.5,
    5.0,
    7.5,
    10.0,
    15.0,
    25.0,
    60.0,
)
ECHO_BUCKETS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
PARTS = ("sampling_wait", "line_time", "measurement", "feedback", "total")
LOG_PERIOD_S = 600.0
"""Time between two lines in the log about delays [s of the wall clock]."""


class Telemetry:
    """Metrics of one daemon, in a registry of its own."""

    def __init__(self, timings: Mapping[str, LineTiming] | None = None, *, scaled: bool = False) -> None:
        """Prepare the metrics; `timings` by line, `scaled` when the machine's clock is not the computer's."""
        self.registry = CollectorRegistry()
        registry = self.registry
        warm_up()
        self._cycle_delays = CycleDelays(timings or {}, scaled=scaled)
        self.delays = {part: DelaySeries() for part in PARTS}
        self.incomplete = {part: DelaySeries() for part in PARTS}
        """The same of cycles in which a sensor was missing or doubled."""
        self.echo = DelaySeries()
        self.latest: tuple[str, Trace] | None = None
        """Line and trace of the latest cycle that went all the way to the read-back."""
        self._report_at_real_s: float | None = None
        self._shown_state: OutputState | None = None
        self._output: tuple[FloatArray, FloatArray, FloatArray] | None = None  # requested, written, applied
        self._degc: FloatArray = np.array([])
        self._series: Callable[..., Any] = cache(lambda metric, *labels: metric.labels(*labels))
        self._register_delays(registry)
        self._register_output(registry)

    def _register_delays(self, registry: CollectorRegistry) -> None:
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
            "measurement: a change at a sensor to the last byte of its cycle, that is sampling_wait (half the time "
            "since the line's previous pass) and line_time (first to last byte), in the machine's time; feedback: "
            "last byte to read-back, in wall time; total: their sum. "
            f"Published {', '.join(f'{part} {value:g} s' for part, value in PUBLISHED_DELAY_S.items())}: "
            f"{PUBLISHED_NOTE}",
            ["part", "complete"],
            buckets=DELAY_BUCKETS_S,
            registry=registry,
        )
        self._echo = Histogram(
            "toolpoint_echo_seconds",
            "Last byte of a cycle to the first poll that shows the written value applied in full, in the machine's "
            "time: the wait for a safe point, to within the poll's period",
            buckets=ECHO_BUCKETS_S,
            registry=registry,
        )
        self._superseded = Counter(
            "toolpoint_writes_superseded",
            "Values that a newer one replaced before the guard took them",
            registry=registry,
        )
        self._published = Gauge(
            "toolpoint_published_delay_seconds", f"Published means: {PUBLISHED_NOTE}", ["part"], registry=registry
        )
        for part, seconds in PUBLISHED_DELAY_S.items():
            self._published.labels(part).set(seconds)
        self._last = Gauge(
            "toolpoint_last_cycle_seconds",
            "The latest traced cycle: wall time from its last byte to each stage; echoed: in the machine's time",
            ["line", "stage"],
            registry=registry,
        )
        self._temperature_macro = Histogram(
            "toolpoint_temperature_macro_seconds",
            "Last byte of a cycle to the read-back of the temperature macro (cnc.temperature_macro), in wall time",
            buckets=DELAY_BUCKETS_S,
            registry=registry,
        )

    def _register_output(self, registry: CollectorRegistry) -> None:
        self._writes = Counter("toolpoint_writes", "Macro block writes", ["outcome"], registry=registry)
        state = Gauge("toolpoint_output_state", "1 for the present output state", ["state"], registry=registry)
        self._state = {member: state.labels(member.value) for member in OutputState}
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
        sensors = Gauge("toolpoint_sensors_usable", "Sensors with an accepted or held value", registry=registry)
        sensors.set_function(lambda: float(np.isfinite(self._degc).sum()))
        self._acknowledged = Gauge(
            "toolpoint_history_acknowledged_cycle", "Number of the last committed cycle", ["line"], registry=registry
        )
        self._history_problems = Counter("toolpoint_history_problems", "Errors of the store", registry=registry)

    def arrived(self, cycle: TemperatureCycle) -> None:
        """Note a cycle before its estimate goes on."""
        self._cycle_delays.arrived(cycle)

    def cycle(self, cycle: TemperatureCycle) -> None:
        """Count a cycle that has arrived, and what the machine's side of its delay was."""
        self._series(self._cycles, cycle.line, _word(cycle.complete)).inc()
        delay = self._cycle_delays.of(cycle.line, cycle.trace)
        if delay is not None:
            self._observe("sampling_wait", delay.sampling_wait_s, delay.complete)
            self._observe("line_time", delay.line_time_s, delay.complete)
            self._observe("measurement", delay.measurement_s, delay.complete)

    def stages(self, line: str, trace: Trace) -> None:
        """Record one cycle that went all the way to the read-back.

        An estimate that was made anew on an earlier cycle, for a new reference, carries no cleansing of its
        own: how long it took says nothing about a cycle.
        """
        if trace.cleansed is None:
            return
        last = trace.last_byte
        for stage in ("cleansed", "estimated", "written", "read_back"):
            instant = getattr(trace, stage)
            if instant is not None:
                self._series(self._stage, stage).observe(instant.real_s - last.real_s)
                self._series(self._last, line, stage).set(instant.real_s - last.real_s)
        delay = self._cycle_delays.of(line, trace)
        if trace.read_back is None:
            return
        self.latest = (line, trace)
        feedback_s = trace.read_back.real_s - last.real_s
        self._observe("feedback", feedback_s, delay is None or delay.complete)
        if delay is not None:
            self._observe("total", delay.measurement_s + feedback_s, delay.complete)

    def _observe(self, part: str, seconds: float, complete: bool) -> None:
        (self.delays if complete else self.incomplete)[part].add(seconds)
        self._series(self._delay, part, _word(complete)).observe(seconds)

    def echoed(self, line: str, trace: Trace) -> None:
        """Record that the guard has applied what this cycle's estimate led to."""
        if trace.echoed is not None:
            seconds = trace.echoed.monotonic_s - trace.last_byte.monotonic_s
            self.latest = (line, trace)
            self.echo.add(seconds)
            self._echo.observe(seconds)
            self._last.labels(line, "echoed").set(seconds)

    def temperature_shown(self, trace: Trace) -> None:
        """Record that a cycle's temperature was written into its own macro and read back."""
        if trace.read_back is not None:
            self._temperature_macro.observe(trace.read_back.real_s - trace.last_byte.real_s)

    def superseded(self) -> None:
        """Count a value that was replaced before the guard had applied it."""
        self._superseded.inc()

    def picture(self) -> dict[str, object]:
        """Return every delay's percentiles [s], those of incomplete cycles apart, beside the published means."""
        return {
            **{part: series.summary() for part, series in self.delays.items()},
            "echo": self.echo.summary(),
            "incomplete": {part: series.summary() for part, series in self.incomplete.items()},
            "published": PUBLISHED_DELAY_S,
            "published_note": PUBLISHED_NOTE,
        }

    def report(self, real_s: float) -> None:
        """Write the delays into the log when it is time again; the first time after one period."""
        if self._report_at_real_s is None:
            self._report_at_real_s = real_s + LOG_PERIOD_S
        if real_s < self._report_at_real_s:
            return
        self._report_at_real_s = real_s + LOG_PERIOD_S
        log.info(
            "delays",
            **{f"{part}_s": _rounded(self.delays[part]) for part in PARTS},
            incomplete_cycles={f"{part}_s": _rounded(series) for part, series in self.incomplete.items()}
            if self.incomplete["measurement"].summary()["samples"]
            else 0,
            echo_s=_rounded(self.echo),
            published_s=PUBLISHED_DELAY_S,
            note=PUBLISHED_NOTE,
        )

    def write(self, receipt: Receipt) -> None:
        self._series(self._writes, receipt.outcome.name.lower()).inc()

    def output(self, command: CompensationCommand, applied_um: FloatArray) -> None:
        if command.state is not self._shown_state:
            self._shown_state = command.state
            for state, gauge in self._state.items():
                gauge.set(1.0 if state is command.state else 0.0)
        first, self._output = self._output is None, (command.requested_um, command.compensation_um, applied_um)
        if first:
            for index, axis in enumerate(command.axes):
                for place, what in enumerate(("requested", "written", "applied")):
                    self._axis.labels(axis, what).set_function(partial(self._output_um, place, index))
        for hit in command.limits_hit:
            axis, _, limit = hit.partition(":")
            self._series(self._limits, axis, limit).inc()

    def _output_um(self, what: int, axis: int) -> float:
        assert self._output is not None
        return float(self._output[what][axis])

    def links(self, up: Iterable[tuple[str, bool]]) -> None:
        for name, is_up in up:
            self._series(self._link, name).set(1.0 if is_up else 0.0)

    def sensors_usable(self, degc: FloatArray) -> None:
        self._degc = degc

    def acknowledged(self, line: str, number: int) -> None:
        self._acknowledged.labels(line).set(number)

    def history_problem(self) -> None:
        self._history_problems.inc()


def _word(complete: bool) -> str:
    return "yes" if complete else "no"


def _rounded(series: DelaySeries) -> dict[str, float | int | None]:
    return {key: None if value is None else round(value, 5) for key, value in series.summary().items()}


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""Of `mallopt`, from glibc's malloc.h."""
LARGE_BYTES = 1 << 20


def keep_one_heap() -> None:
    """Let all threads share one heap, and what is large have pages of its own (glibc); call it before threads.

    Else each thread keeps what it has freed, and the heap keeps up to 64 MiB once something large was freed.
    """
    choose = getattr(ctypes.CDLL(None), "mallopt", None)
    if choose is not None:
        choose(_M_ARENA_MAX, 1)
        choose(_M_MMAP_THRESHOLD, LARGE_BYTES)
        choose(_M_TRIM_THRESHOLD, LARGE_BYTES)


def give_memory_back() -> None:
    """Return freed memory to the system, where the C library keeps it and can be asked to (glibc)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
