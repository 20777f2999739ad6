"""Delays, percentiles and metrics."""

import numpy as np
import pytest
from prometheus_client import generate_latest

from daemon.telemetry import KEPT_DELAYS, PUBLISHED_DELAY_S, DelaySeries, Telemetry
from models.records import CompensationCommand, Instant, OutputState, Receipt, Trace, WriteOutcome


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


def test_percentiles_of_what_was_added():
    series = DelaySeries()
    assert series.summary()["mean"] is None
    for value in range(1, 101):
        series.add(value / 100)
    summary = series.summary()
    assert summary["mean"] == pytest.approx(0.505)
    assert summary["p50"] == pytest.approx(0.505)
    assert summary["max"] == 1.0 and summary["samples"] == 100


def test_only_the_latest_are_kept():
    series = DelaySeries()
    for _ in range(10):
        series.add(9.0)
    for _ in range(KEPT_DELAYS):
        series.add(1.0)
    assert series.summary()["max"] == 1.0
    assert series.summary()["samples"] == KEPT_DELAYS + 10


def test_feedback_is_wall_time_and_line_time_is_the_machines():
    telemetry = Telemetry()
    telemetry.stages("spindle", TRACE)
    assert telemetry.feedback.summary()["mean"] == pytest.approx(0.004)
    assert telemetry.line_time.summary()["mean"] == pytest.approx(1.5)
    assert telemetry.total.summary()["mean"] == pytest.approx(1.504)
    text = generate_latest(telemetry.registry).decode()
    for stage in ("cleansed", "estimated", "written", "read_back"):
        assert f'toolpoint_stage_seconds_count{{stage="{stage}"}} 1.0' in text
    assert 'toolpoint_last_cycle_seconds{line="spindle",stage="read_back"}' in text


def test_a_cycle_that_was_never_written_has_no_delay():
    telemetry = Telemetry()
    telemetry.stages("spindle", Trace(first_byte=TRACE.first_byte, last_byte=TRACE.last_byte, cleansed=TRACE.cleansed))
    assert telemetry.feedback.summary()["samples"] == 0


def test_output_state_axes_and_limits():
    telemetry = Telemetry()
    command = CompensationCommand(
        axes=("y", "z"),
        requested_um=np.array([1.0, 60.0]),
        compensation_um=np.array([1.0, 50.0]),
        enable=(True, True),
        state=OutputState.ACTIVE,
        reason="",
        write=True,
        limits_hit=("z:bound",),
    )
    telemetry.output(command, np.array([0.5, 49.0]))
    telemetry.write(
        Receipt(
            sequence=1,
            macros=(),
            outcome=WriteOutcome.VERIFIED,
            detail="",
            read_back=(),
            applied_um=np.zeros(2),
            trace=TRACE,
        )
    )
    telemetry.links([("cnc", True), ("latsis spindle", False)])
    text = generate_latest(telemetry.registry).decode()
    for line in (
        'toolpoint_output_state{state="ACTIVE"} 1.0',
        'toolpoint_output_state{state="FAULT"} 0.0',
        'toolpoint_compensation_micrometres{axis="z",what="requested"} 60.0',
        'toolpoint_compensation_micrometres{axis="z",what="written"} 50.0',
        'toolpoint_compensation_micrometres{axis="z",what="applied"} 49.0',
        'toolpoint_limit_hits_total{axis="z",limit="bound"} 1.0',
        'toolpoint_writes_total{outcome="verified"} 1.0',
        'toolpoint_link_up{link="cnc"} 1.0',
        'toolpoint_link_up{link="latsis spindle"} 0.0',
    ):
        assert line in text, line
    for part, seconds in PUBLISHED_DELAY_S.items():
        assert f'toolpoint_published_delay_seconds{{part="{part}"}} {seconds}' in text
