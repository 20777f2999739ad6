"""Delays, percentiles and metrics."""

import numpy as np
import pytest
import structlog
from prometheus_client import generate_latest

from daemon.telemetry.latency import LineTiming
from daemon.telemetry.metrics import LOG_PERIOD_S, Telemetry
from models.records import Instant, TemperatureCycle, Trace


def at(machine_s, real_s):
    return Instant(monotonic_s=machine_s, utc_s=machine_s, real_s=real_s)


TRACE = Trace(
    first_byte=at(100.0, 10.0),
    last_byte=at(101.5, 10.025),
    cleansed=at(101.56, 10.026),
    estimated=at(101.62, 10.027),
    written=at(101.68, 10.028),
    read_back=at(101.8, 10.029),
)


def cycle(trace=TRACE, *, complete=True, line="spindle"):
    nothing = np.zeros(1, dtype=np.uint8)
    return TemperatureCycle(
        line=line, number=1, degc=np.zeros(1), quality=nothing, reason=nothing.copy(), complete=complete, trace=trace
    )


def later(seconds, trace=TRACE, **changes):
    """The same trace after some seconds of the machine."""
    stages = ("first_byte", "last_byte", "cleansed", "estimated", "written", "read_back")
    moved = {stage: getattr(trace, stage) for stage in stages}
    moved = {k: at(v.monotonic_s + seconds, v.real_s + seconds) for k, v in moved.items()}
    return Trace(**(moved | changes))


def taken(telemetry, this):
    """What the daemon does with a cycle that is written."""
    telemetry.arrived(this)
    telemetry.cycle(this)
    telemetry.stages(this.line, this.trace)


def test_a_total_is_the_sum_of_waiting_on_the_machine_and_of_wall_time_here():
    telemetry = Telemetry({"spindle": LineTiming(cycle_period_s=10.0, line_time_s=0.9)})
    taken(telemetry, cycle())
    taken(telemetry, cycle(later(12.0)))
    delays = telemetry.delays
    assert delays["feedback"].summary()["mean"] == pytest.approx(0.004)
    assert delays["line_time"].summary()["mean"] == pytest.approx(1.5)
    # The first pass has none before it and is taken to be one period late; the second came after 12 s.
    assert delays["sampling_wait"].summary()["mean"] == pytest.approx((5.0 + 6.0) / 2)
    assert delays["measurement"].summary()["max"] == pytest.approx(7.5)
    assert delays["total"].summary()["max"] == pytest.approx(7.504)
    text = generate_latest(telemetry.registry).decode()
    for stage in ("cleansed", "estimated", "written", "read_back"):
        assert f'toolpoint_stage_seconds_count{{stage="{stage}"}} 2.0' in text
    for part in ("sampling_wait", "line_time", "measurement", "feedback", "total"):
        assert f'toolpoint_delay_seconds_count{{complete="yes",part="{part}"}} 2.0' in text
    assert 'toolpoint_last_cycle_seconds{line="spindle",stage="read_back"}' in text


@pytest.mark.parametrize("speed", [10.0, 60.0, 600.0])
def test_the_speed_of_a_simulation_does_not_change_the_total(speed):
    """Arrivals that this computer's scheduling smeared over 25 ms are seconds on a fast clock."""
    telemetry = Telemetry({"spindle": LineTiming(cycle_period_s=10.0, line_time_s=0.9)}, scaled=True)
    smeared = Trace(
        first_byte=at(100.0, 10.0),
        last_byte=at(100.0 + 0.025 * speed, 10.025),
        cleansed=at(0.0, 10.026),
        read_back=at(0.0, 10.029),
    )
    taken(telemetry, cycle(smeared))
    assert telemetry.delays["measurement"].summary()["mean"] == pytest.approx(5.9)
    assert telemetry.delays["total"].summary()["mean"] == pytest.approx(5.904)


def test_the_echo_counts_in_the_machines_time():
    telemetry = Telemetry()
    telemetry.echoed("spindle", later(0.0, echoed=at(141.5, 11.0)))
    assert telemetry.echo.summary()["mean"] == pytest.approx(40.0)
    assert "toolpoint_echo_seconds_count 1.0" in generate_latest(telemetry.registry).decode()


def test_the_log_names_the_delays_beside_the_published_ones_once_in_a_while():
    telemetry = Telemetry()
    taken(telemetry, cycle())
    with structlog.testing.capture_logs() as lines:
        for real_s in (0.0, 1.0, LOG_PERIOD_S, LOG_PERIOD_S + 1.0):
            telemetry.report(real_s)
    assert [line["event"] for line in lines] == ["delays"]
    assert lines[0]["feedback_s"]["samples"] == 1
    assert lines[0]["published_s"] == {"measurement": 20.0, "feedback": 1.2, "total": 24.7}
    assert "another rig" in lines[0]["note"] and "polling" in lines[0]["note"]
    assert lines[0]["incomplete_cycles"] == 0
