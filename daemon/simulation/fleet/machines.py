"""The machines of a simulated fleet: the simulated machine's physics, recorded by the daemon's own store writer.

Each on a day of its own, which differs by up to 20 % in every parameter. No estimator runs: an estimate is the true
displacement with a gain error of its own.
"""

import itertools
import signal
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from config.loader import load_configuration
from config.machines import shipped_file
from config.schema import Configuration
from daemon.ending import set_by_signals
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from drivers.sim.machine.body import MachineBody
from drivers.sim.machine.day import Day
from drivers.sim.nc.program import demo_program
from models.records import (
    CncMode,
    CncRun,
    CncSample,
    CompensationCommand,
    DisplacementSample,
    Instant,
    OutputState,
    Receipt,
    Reference,
    TemperatureCycle,
    ThermalErrorEstimate,
    Trace,
    WriteOutcome,
)

PERIOD_S = 10.0
"""From one pass over a machine's lines to the next."""
GAIN = (0.7, 1.1)
"""Range of what a machine's estimate is of its true error."""
BAND_UM = 3.0
STAGES_S = (0.001, 0.002, 0.004, 0.006)
"""From the last byte of a cycle to cleansed, estimated, written, read back [s]."""
ECHO_S = 0.5
LINE_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetPlan:
    """A run: how many machines, how long, how fast, where their stores stand."""

    folder: Path
    machines: int
    minutes: float
    """Simulated."""
    speed: float
    """Simulated seconds per second."""
    start_utc_s: float
    """Simulated time at the beginning, in whole seconds."""

    @property
    def names(self) -> tuple[str, ...]:
        """The machines' names, which the systems of others see."""
        width = len(str(self.machines))
        return tuple(f"simulated {number:0{width}}" for number in range(1, self.machines + 1))

    def store(self, number: int) -> Path:
        """Return where the history of a machine (from 0) stands."""
        return self.folder / f"{number + 1:04}" / "history.sqlite"

    @property
    def cycles(self) -> int:
        """Passes over every line; the first is there before the senders, and tells of no delay."""
        return max(2, round(self.minutes * 60.0 / PERIOD_S))


@dataclass(frozen=True, slots=True, kw_only=True)
class Committed:
    """When a cycle of a line was committed in its machine's store."""

    machine: int
    line: str
    utc_ms: int
    monotonic_s: float
    """On this computer's clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    commits: list[Committed]
    rows: int
    dropped: int
    """Records that a store refused."""
    behind_s: float
    """Most by which the machines were late, because this computer was busy."""
    cpu_s: float


def fleet_configuration() -> Configuration:
    """Return the configuration that every machine has: the published machine with its 302 sensors."""
    return load_configuration(shipped_file("cfrpmt.yaml"))


class _Clock:
    """Simulated time as the store's writer asks for it."""

    speed = 1.0

    def __init__(self, utc_s: float) -> None:
        self.utc_s = utc_s
        self._start_s = utc_s

    def now(self) -> Instant:
        elapsed_s = self.utc_s - self._start_s
        return Instant(monotonic_s=elapsed_s, utc_s=self.utc_s, real_s=elapsed_s)

    async def sleep(self, duration_s: float) -> None:
        raise NotImplementedError("nothing waits on this clock")


class FleetMachine:
    def __init__(self, plan: FleetPlan, number: int, configuration: Configuration) -> None:
        self.rows = 0
        self.commits: list[Committed] = []
        self._number, self._configuration = number, configuration
        self._layout = MachineLayout.from_configuration(configuration)
        self._clock = _Clock(plan.start_utc_s)
        self._start_s = plan.start_utc_s
        day = Day.draw(1 + number, start="cold")
        sensors = configuration.temperatures.sensors
        self._body = MachineBody(day, demo_program(), sensors, machine_seed=1 + number)
        self._gain = float(np.random.default_rng([number, 14]).uniform(*GAIN))
        labels = sorted({sensor.label for sensor in sensors if sensor.label})
        self._labels = {name: [i for i, each in enumerate(sensors) if each.label == name] for name in labels}
        self._label_zero: dict[str, float] = {}
        self._applied_um = np.zeros(len(self._layout.axes))
        self._polled_s = 0.0
        self._waiting: dict[str, deque[tuple[int, int]]] = {line: deque() for line in self._layout.lines}
        plan.store(number).parent.mkdir(parents=True, exist_ok=True)
        self._writer = HistoryWriter(
            plan.store(number), clock=self._clock, machine=self._layout, on_acknowledged=self._committed
        )

    def start(self) -> None:
        """Open the store and note the beginning."""
        self._writer.start()
        degc = self._degc()
        self._label_zero = {name: float(degc[at].mean()) for name, at in self._labels.items()}
        self._writer.event("note", "a simulated machine of a fleet begins; its estimates are made up")
        self._writer.reference(
            Reference(
                reference_id="ref-1",
                time=self._clock.now(),
                source="O1000 N10",
                degc=degc,
                program=1000,
                work_offset=54,
                power_on_count=1,
            )
        )
        self.rows += 2

    def close(self) -> None:
        self._writer.close()

    @property
    def dropped(self) -> int:
        """Records that the store did not take."""
        return self._writer.dropped.total()

    def cycle(self, line: str, number: int, time_s: float) -> None:
        """Record one pass over a line, and with the first line of a machine all that goes with it."""
        self._body.advance(time_s, leaving=lambda _end_s: None, entered=lambda: None)
        self._clock.utc_s = self._start_s + time_s
        degc = self._degc()[self._layout.line_positions[line]]
        first = self._clock.now()
        trace = Trace(first_byte=first, last_byte=_after(first, LINE_S))
        self._waiting[line].append((number, round(first.utc_s * 1e3)))
        codes = np.zeros(degc.size, dtype=np.uint8)
        if line == next(iter(self._layout.lines)):
            self._polls(time_s)
            self._estimate_and_write(line, trace, number)
        record = TemperatureCycle(
            line=line, number=number, degc=degc, quality=codes, reason=codes.copy(), complete=True, trace=trace
        )
        self._writer.temperatures(None, record)
        self.rows += 1

    def _committed(self, line: str, number: int) -> None:
        """Note in the writer's thread when the cycles up to this one were committed."""
        now_s, waiting = time.monotonic(), self._waiting[line]
        while waiting and waiting[0][0] <= number:
            first, utc_ms = waiting.popleft()
            if first == 1:
                continue  # it was there before the senders
            self.commits.append(Committed(machine=self._number, line=line, utc_ms=utc_ms, monotonic_s=now_s))

    def _degc(self) -> np.ndarray:
        return self._body.sensors.degc(self._body.register_codes())

    def _polls(self, time_s: float) -> None:
        """Record the polls of the CNC since the last cycle."""
        block, echo = self._body.block, self._configuration.cnc.macros.echo_applied
        macros: dict[int, float | None] = dict(zip(echo.values(), self._applied_um.tolist(), strict=True))
        while self._polled_s <= time_s:
            self._writer.cnc_sample(
                CncSample(
                    time=self._at(self._polled_s),
                    mode=CncMode.MEMORY,
                    run=(CncRun.START if block.feeding else CncRun.STOP),
                    alarm=False,
                    program=self._body.program.number,
                    sequence_number=block.sequence_number,
                    spindle_speed_rpm=self._body.spindle_speed_rpm,
                    motor_temperature_degc=self._body.motor_degc,
                    clock_s=self._polled_s,
                    power_on_count=1,
                    work_offset=54,
                    tool_number=1,
                    macros=macros,
                )
            )
            self._polled_s += self._configuration.cnc.poll_period_s
            self.rows += 1

    def _at(self, time_s: float) -> Instant:
        return Instant(monotonic_s=time_s, utc_s=self._start_s + time_s, real_s=time_s)

    def _estimate_and_write(self, line: str, trace: Trace, number: int) -> None:
        channels, axes = self._layout.displacement_channels, self._layout.axes
        um = self._body.displacement_um()
        measured = np.array([um[name] for name in channels])
        cleansed, estimated, written, read_back = (_after(trace.last_byte, each) for each in STAGES_S)
        degc = self._degc()
        label_degc = {name: float(degc[at].mean()) for name, at in self._labels.items()}
        error_um = self._gain * measured
        self._writer.displacement(
            DisplacementSample(
                utc_s=trace.first_byte.utc_s,
                um=measured,
                reason=np.zeros(len(channels), dtype=np.uint8),
                source=f"simulated:{number}",
            )
        )
        trace = replace(trace, cleansed=cleansed, estimated=estimated)
        self._writer.estimate(
            ThermalErrorEstimate(
                channels=channels,
                thermal_error_um=error_um,
                band_um=np.full(len(channels), BAND_UM),
                label_degc=label_degc,
                label_increment_degc={name: label_degc[name] - self._label_zero[name] for name in label_degc},
                in_domain=True,
                confidence=0.9,
                imputed=(),
                model_id="made up",
                reference_id="ref-1",
                line=line,
                trace=trace,
            )
        )
        followed = {axis: config.estimate for axis, config in self._configuration.compensation.axes.items()}
        by_channel = dict(zip(channels, error_um.tolist(), strict=True))
        self._applied_um = np.array([by_channel[name] if (name := followed[axis]) else 0.0 for axis in axes])
        block = tuple((500 + position, value / 1e3) for position, value in enumerate(self._applied_um.tolist()))
        command = CompensationCommand(
            axes=axes,
            requested_um=self._applied_um,
            compensation_um=self._applied_um,
            enable=tuple(followed[axis] is not None for axis in axes),
            state=OutputState.ACTIVE,
            reason="following",
            write=True,
        )
        write_id = self._writer.write_intent(command, block, "cycle", kept=True)
        trace = replace(trace, written=written, read_back=read_back, echoed=_after(trace.last_byte, ECHO_S))
        receipt = Receipt(
            sequence=number % 10_000,
            macros=block,
            outcome=WriteOutcome.VERIFIED,
            detail="",
            read_back=tuple(value for _, value in block),
            applied_um=self._applied_um,
            trace=trace,
        )
        self._writer.write_outcome(write_id, receipt)
        self._writer.write_echoed(write_id, trace)
        self.rows += 3


def _after(instant: Instant, duration_s: float) -> Instant:
    return Instant(
        monotonic_s=instant.monotonic_s + duration_s,
        utc_s=instant.utc_s + duration_s,
        real_s=instant.real_s + duration_s,
    )


def _turns(plan: FleetPlan, lines: Sequence[str]) -> Iterator[tuple[float, int, str, int]]:
    """Yield simulated time [s], machine, line and number of every cycle; machines and lines take turns evenly."""
    step_s = PERIOD_S / len(lines)
    turns = sorted(
        ((position + machine / plan.machines) * step_s, machine, line)
        for machine in range(plan.machines)
        for position, line in enumerate(lines)
    )
    for number in range(plan.cycles):
        for offset_s, machine, line in turns:
            yield number * PERIOD_S + offset_s, machine, line, number + 1


def run_machines(plan: FleetPlan, parent: Connection) -> None:
    """Record the first cycle of each line, say so, wait for a word, and record the rest: a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = set_by_signals(signal.SIGTERM)
    configuration = fleet_configuration()
    machines = [FleetMachine(plan, number, configuration) for number in range(plan.machines)]
    behind_s = 0.0
    with ExitStack() as stack:
        for machine in machines:
            machine.start()
            stack.enter_context(closing(machine))
        turns = _turns(plan, tuple(MachineLayout.from_configuration(configuration).lines))
        for time_s, at, line, number in itertools.islice(turns, plan.machines * len(configuration.temperatures.inputs)):
            machines[at].cycle(line, number, time_s)
        parent.send(None)
        parent.recv()
        began_s = time.monotonic()
        for time_s, at, line, number in turns:
            late_s = time.monotonic() - began_s - (time_s - PERIOD_S) / plan.speed
            behind_s = max(behind_s, late_s)
            if stop.is_set() or (late_s < 0.0 and stop.wait(-late_s)):
                break
            machines[at].cycle(line, number, time_s)
    parent.send(
        Recorded(
            commits=[commit for machine in machines for commit in machine.commits],
            rows=sum(machine.rows for machine in machines),
            dropped=sum(machine.dropped for machine in machines),
            behind_s=behind_s,
            cpu_s=time.process_time(),
        )
    )
