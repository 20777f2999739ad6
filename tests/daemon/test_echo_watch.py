"""When a written value counts as echoed: applied in full by a guard that ran after it."""

import numpy as np

from daemon.cnc.macro_block import Echo
from daemon.compensation.block_writer import EchoWatch
from daemon.telemetry.metrics import Telemetry
from models.records import CompensationCommand, Instant, OutputState, Trace


def at(seconds):
    return Instant(monotonic_s=seconds, utc_s=seconds, real_s=seconds)


def command(z_um, *, on=True):
    return CompensationCommand(
        axes=("y", "z"),
        requested_um=np.array([0.0, z_um]),
        compensation_um=np.array([0.0, z_um]),
        enable=(False, on),
        state=OutputState.ACTIVE,
        reason="",
        write=True,
    )


def echo(z_um, ran_s, *, status=0, y_um=5.0):
    """Axis y is not enabled: what it holds does not matter."""
    return Echo(applied_um=np.array([y_um, z_um]), time_s=ran_s, status=status, guard_version=1.0)


class Watched:
    def __init__(self):
        self.telemetry = Telemetry()
        self.watch = EchoWatch(self.telemetry, np.array([0.05, 0.05]))

    def wrote(self, z_um, *, at_s, echo_now, line="spindle", on=True):
        trace = Trace(first_byte=at(at_s - 1.0), last_byte=at(at_s))
        self.watch.wrote(trace, command(z_um, on=on), echo_now, line)

    @property
    def delays(self):
        return self.telemetry.echo.summary()

    @property
    def superseded(self):
        return self.telemetry.registry.get_sample_value("toolpoint_writes_superseded_total")


def test_the_first_poll_with_the_whole_value_counts():
    w = Watched()
    w.wrote(8.0, at_s=100.0, echo_now=echo(0.0, 50.0))
    w.watch.seen(echo(0.0, 50.0), at(110.0))
    w.watch.seen(echo(8.0, 120.0), at(120.5))
    w.watch.seen(echo(8.0, 121.0), at(121.5))
    assert w.delays["samples"] == 1 and w.delays["max"] == 20.5
    line, trace = w.telemetry.latest
    assert line == "spindle" and trace.echoed == at(120.5)


def test_a_step_towards_the_value_is_not_the_value():
    w = Watched()
    w.wrote(15.0, at_s=100.0, echo_now=echo(0.0, 50.0))
    w.watch.seen(echo(10.0, 120.0), at(120.5))
    assert w.delays["samples"] == 0
    w.watch.seen(echo(15.0, 121.0), at(121.5))
    assert w.delays["max"] == 21.5


def test_a_value_that_already_stood_there_needs_a_run_of_the_guard_too():
    w = Watched()
    w.wrote(8.0, at_s=100.0, echo_now=echo(8.0, 50.0))
    w.watch.seen(echo(8.0, 50.0), at(100.5))
    assert w.delays["samples"] == 0
    w.watch.seen(echo(8.0, 120.0), at(120.5))
    assert w.delays["samples"] == 1


def test_the_audit_gets_the_trace_of_the_estimate_whose_value_was_taken_over():
    w, recorded = Watched(), []
    w.watch = EchoWatch(
        w.telemetry, np.array([0.05, 0.05]), record=lambda write_id, trace: recorded.append((write_id, trace.echoed))
    )
    trace = Trace(first_byte=at(99.0), last_byte=at(100.0))
    w.watch.wrote(trace, command(2.0), echo(0.0, 50.0), "spindle", 7)
    w.watch.wrote(trace, command(4.0), echo(0.0, 50.0), None, 8)
    w.watch.seen(echo(4.0, 120.0), at(120.5))
    assert recorded == [(7, at(120.5))], "the tick only carried the same estimate further"
