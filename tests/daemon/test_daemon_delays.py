"""The composition root gives telemetry what it needs: every line's times, and a tick that reports."""

import numpy as np
import pytest
from shipped_machine import shipped_machine

from daemon.app import Daemon
from daemon.telemetry.latency import line_timings
from drivers.clock import ScaledClock
from drivers.latsis.frames import frame_bytes
from models.records import Instant, TemperatureCycle, Trace


@pytest.fixture
def daemon(tmp_path):
    configuration = shipped_machine()
    history = configuration.history.model_copy(update={"path": tmp_path / "history.sqlite"})
    clock = ScaledClock(epoch_real_s=0.0, epoch_utc_s=0.0, speed=60.0)
    return Daemon(configuration.model_copy(update={"history": history}), clock), configuration


def test_a_scaled_clock_takes_the_lines_times_from_the_configuration(daemon):
    daemon, configuration = daemon
    line = configuration.temperatures.lines[0]
    timing = line_timings(configuration)[line.name]
    short = frame_bytes(line.frame_grammar, 3) * len(line.sensor_ids) * 10 / line.baud
    assert short <= timing.line_time_s <= short * 1.2
    moment = Instant(monotonic_s=100.0, utc_s=100.0, real_s=1.0)
    late = Instant(monotonic_s=109.0, utc_s=109.0, real_s=1.15)
    count = len(line.sensor_ids)
    codes = np.zeros(count, dtype=np.uint8)
    cycle = TemperatureCycle(
        line=line.name,
        number=1,
        degc=np.zeros(count),
        quality=codes,
        reason=codes.copy(),
        complete=True,
        trace=Trace(first_byte=moment, last_byte=late),
    )
    daemon._telemetry.arrived(cycle)
    daemon._telemetry.cycle(cycle)
    measurement = daemon._telemetry.delays["measurement"].summary()
    assert measurement["mean"] == pytest.approx(line.cycle_period_s / 2 + timing.line_time_s)


def test_every_tick_lets_the_delays_be_reported(daemon, monkeypatch):
    daemon, _ = daemon
    asked = []
    monkeypatch.setattr(daemon._telemetry, "report", asked.append)
    daemon._on_tick()
    assert len(asked) == 1
