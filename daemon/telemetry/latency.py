"""Delays: their parts, and percentiles of many.

Waiting for a sensor's turn and for the wire is in the machine's time, which a simulation scales; what the product adds
is on this computer's clock. A total is the sum of its parts, never a difference of two instants.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from config.schema import Configuration
from config.schema.temperatures import LineConfig, SensorConfig
from drivers.latsis.frames import frame_bytes
from drivers.latsis.values import ChainDecoder
from models.records import FloatArray, TemperatureCycle, Trace

KEPT_DELAYS = 8192
"""As many of the latest delays are kept for percentiles."""
PUBLISHED_DELAY_S = {"measurement": 20.0, "feedback": 1.2, "total": 24.7}
"""Means published for another rig, which polls a database (measurement: more than)."""
PUBLISHED_NOTE = (
    "published means of another rig with another CNC and network, database polling included; "
    "measurement: more than 20 s. For orientation, not a comparison"
)
BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""


class DelaySeries:
    """The latest delays of one kind, for percentiles."""

    def __init__(self) -> None:
        self._values = np.zeros(KEPT_DELAYS)
        self._count = 0
        self._summary = (0, summary(self._values[:0]))

    def add(self, delay_s: float) -> None:
        self._values[self._count % KEPT_DELAYS] = delay_s
        self._count += 1

    def latest(self) -> FloatArray:
        """Return the latest delays [s], in no order."""
        return self._values[: min(self._count, KEPT_DELAYS)].copy()

    def summary(self) -> dict[str, float | int | None]:
        """Return mean, percentiles and maximum [s]; None without samples. Worked out anew only after a new delay."""
        if self._summary[0] != self._count:
            found = summary(self._values[: min(self._count, KEPT_DELAYS)])
            self._summary = (self._count, found | {"samples": self._count})
        return dict(self._summary[1])


def warm_up() -> None:
    """Have the first percentiles behind us: they load a part of numpy, which takes as long as a cycle's feedback."""
    summary([0.0])


def summary(delays_s: Iterable[float]) -> dict[str, float | int | None]:
    """Return mean, percentiles and maximum of delays [s]; None without samples."""
    known = np.asarray(list(delays_s) if not isinstance(delays_s, np.ndarray) else delays_s, dtype=np.float64)
    if not known.size:
        return {"mean": None, "p50": None, "p99": None, "p999": None, "max": None, "samples": 0}
    p50, p99, p999 = np.percentile(known, [50, 99, 99.9])
    return {
        "mean": float(known.mean()),
        "p50": float(p50),
        "p99": float(p99),
        "p999": float(p999),
        "max": float(known.max()),
        "samples": int(known.size),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class LineTiming:
    """What one line's configuration says about its times."""

    cycle_period_s: float
    line_time_s: float
    """Bytes of a whole pass at the line's baud rate: the shortest time from first to last byte."""


def line_timings(configuration: Configuration) -> dict[str, LineTiming]:
    """Return the times of each line and source by name; what a source's wire takes is not known beforehand."""
    temperatures = configuration.temperatures
    timings = {line.name: _timing(line, temperatures.sensors) for line in temperatures.lines}
    return timings | {
        source.name: LineTiming(cycle_period_s=source.cycle_period_s, line_time_s=0.0)
        for source in temperatures.sources or ()
    }


def _timing(line: LineConfig, sensors: Sequence[SensorConfig]) -> LineTiming:
    digits = ChainDecoder(line, sensors).value_digits
    size = sum(frame_bytes(line.frame_grammar, count) for count in digits.values())
    return LineTiming(cycle_period_s=line.cycle_period_s, line_time_s=size * BITS_PER_BYTE / line.baud)


@dataclass(frozen=True, slots=True, kw_only=True)
class CycleDelay:
    """The machine's share of the delay of one cycle; all in the machine's seconds."""

    sampling_wait_s: float
    """Half the time since the line's previous pass: the mean wait of a change that came at a random instant."""
    line_time_s: float
    complete: bool

    @property
    def measurement_s(self) -> float:
        """From a change at the sensor to the last byte of the cycle that carries it, in the mean."""
        return self.sampling_wait_s + self.line_time_s


class CycleDelays:
    """Follows the passes of every line.

    On a scaled clock arrivals are only as fine as this computer's scheduling times the speed; there the period and line
    time that the simulated wires have by construction are taken instead.
    """

    def __init__(self, timings: Mapping[str, LineTiming], *, scaled: bool) -> None:
        self._timings = timings
        self._scaled = scaled
        self._latest: dict[str, tuple[float, CycleDelay]] = {}

    def arrived(self, cycle: TemperatureCycle) -> None:
        """Note a cycle before its estimate goes on; costs a microsecond."""
        first_s = cycle.trace.first_byte.monotonic_s
        before = self._latest.get(cycle.line)
        timing = self._timings.get(cycle.line)
        if self._scaled and timing is not None:
            interval_s, line_time_s = timing.cycle_period_s, timing.line_time_s
        else:
            line_time_s = cycle.trace.last_byte.monotonic_s - first_s
            interval_s = first_s - before[0] if before else timing.cycle_period_s if timing else line_time_s
        delay = CycleDelay(sampling_wait_s=interval_s / 2, line_time_s=line_time_s, complete=cycle.complete)
        self._latest[cycle.line] = (first_s, delay)

    def of(self, line: str, trace: Trace) -> CycleDelay | None:
        """Return the delay of a line's latest cycle; None when the trace is of another one."""
        latest = self._latest.get(line)
        return latest[1] if latest is not None and latest[0] == trace.first_byte.monotonic_s else None
