"""What a campaign demands of requests, policies, models and heartbeat: a trace that violates it is found."""

import pytest
from campaign_claims import claims
from shipped_machine import shipped_machine

from daemon.simulation.faults.invariants import Ledger
from daemon.simulation.faults.operations_check import (
    ANSWERED_WITHIN_S,
    ENDED_WITHIN_S,
    SETTLED_S,
    HeartbeatWatch,
    OperationsWatch,
    Request,
)
from daemon.simulation.faults.script import Happening, Incident
from drivers.sim.nc.nc import NumericalControl

MACROS = shipped_machine().cnc.macros
CALM_FROM_S = 1000.0


def request(time_s: float = CALM_FROM_S, kind: int = 2) -> Request:
    return Request(time_s=time_s, counter=7, kind=kind, axis=3, value_mm=0.004)


class Bench:
    """A watch that has long been in calm waters."""

    def __init__(self) -> None:
        self.ledger = Ledger(OperationsWatch.NAMES)
        self.watch = OperationsWatch(self.ledger, MACROS.request, 0.7)
        self.watch.heard(CALM_FROM_S - 1.0, claims(), dict)

    def checked(self, name: str) -> tuple[int, int]:
        count = self.ledger.counts[name]
        return count.checked, count.violated


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_request_that_is_answered_in_time_is_right_and_a_probe_is_expected_in_the_store(bench: Bench) -> None:
    bench.watch.asked(request())
    assert bench.watch.answered(CALM_FROM_S + 3.0, 7.0) == "probe"
    assert bench.checked("request_answered") == (1, 0)
    assert [(probe.axis, probe.deviation_um) for probe in bench.watch.probes] == [(3, 4.0)]


def test_a_request_without_an_answer_is_found(bench: Bench) -> None:
    bench.watch.asked(request())
    bench.watch.heard(CALM_FROM_S + ANSWERED_WITHIN_S + 0.1, claims(), dict)
    assert bench.checked("request_answered") == (1, 1)


def test_an_answer_to_nothing_is_found(bench: Bench) -> None:
    bench.watch.answered(CALM_FROM_S, 5.0)
    bench.watch.asked(request())
    bench.watch.answered(CALM_FROM_S + 1.0, -7.0)
    bench.watch.answered(CALM_FROM_S + 2.0, 4.0)
    assert bench.checked("answer_belongs_to_a_request") == (3, 2)
    assert bench.watch.probes == [], "refused"


@pytest.mark.parametrize(("after", "violated"), [("r1", 1), (None, 0), ("r2", 0)])
def test_a_reference_that_a_poll_has_ended_must_go(bench: Bench, after: str | None, violated: int) -> None:
    bench.watch.begun(CALM_FROM_S, Happening(kind=Incident.WORK_OFFSET, at_s=CALM_FROM_S, duration_s=30.0))
    bench.watch.polled(CALM_FROM_S + 2.0, retreat_block=False)
    bench.watch.heard(CALM_FROM_S + 2.0 + ENDED_WITHIN_S + 0.1, claims(reference=after), dict)
    assert bench.checked("reference_ends") == (1, violated)


@pytest.mark.parametrize(("applied_um", "violated"), [(0.0, 0), (3.0, 1)])
def test_under_zero_first_a_reference_needs_the_offset_out(bench: Bench, applied_um: float, violated: int) -> None:
    bench.watch.begun(0.0, Happening(kind=Incident.OTHER_POLICY, at_s=0.0, duration_s=5.0, target=0))
    bench.watch.polled(CALM_FROM_S, retreat_block=True)
    assert bench.watch.retreating
    bench.watch.heard(CALM_FROM_S + 1.0, claims(reference=None), lambda: {"x": 0.0, "z": -applied_um})
    bench.watch.heard(CALM_FROM_S + 2.0, claims(reference="r2"), lambda: {"x": 0.0, "z": -applied_um})
    assert bench.checked("zero_first_at_zero") == (1, violated)
    assert not bench.watch.retreating


@pytest.mark.parametrize(("model", "violated"), [("m2", 0), ("m1", 1)])
def test_a_released_model_must_estimate(bench: Bench, model: str, violated: int) -> None:
    bench.watch.released(CALM_FROM_S, "m2")
    bench.watch.round(CALM_FROM_S + 10.0, claims(model="m1"))
    bench.watch.round(CALM_FROM_S + 90.0, claims(model="m1", doubtful=True))
    bench.watch.round(CALM_FROM_S + 95.0, claims(model="m1", in_domain=False))
    bench.watch.round(CALM_FROM_S + 96.0, claims(model="m1", confidence=0.5))
    assert bench.checked("model_taken_up") == (0, 0), "not yet, and not while it waits for states or for an estimate"
    bench.watch.round(CALM_FROM_S + 100.0, claims(model=model))
    assert bench.checked("model_taken_up") == (1, violated)


@pytest.mark.parametrize(("left_out", "violated"), [((99,), 0), ((26,), 1)])
@pytest.mark.parametrize("limit_k", [0.3, 4.0])
def test_a_sensor_that_has_long_been_wrong_must_not_count(
    bench: Bench, left_out: tuple[int, ...], violated: int, limit_k: float
) -> None:
    """At 12 K/h it is 3 K beyond its limit a quarter of an hour after that, and a quarter more is allowed."""
    judged_s = CALM_FROM_S + 1800.0 + limit_k / 12.0 * 3600.0
    drift = Happening(kind=Incident.WRONG_SENSOR, at_s=CALM_FROM_S, duration_s=5000.0, target=99, amount=-12.0)
    bench.watch.begun(CALM_FROM_S, drift)
    bench.watch.wrong_sensor(judged_s - 100.0, drift, claims(left_out=()), limit_k)
    assert bench.checked("wrong_sensor_left_out") == (0, 0)
    bench.watch.wrong_sensor(judged_s + 100.0, drift, claims(left_out=left_out), limit_k)
    assert bench.checked("wrong_sensor_left_out") == (1, violated)


@pytest.mark.parametrize(
    ("state", "enable", "valid_for_s", "violated"),
    [
        ("ACTIVE", 4.0, 20.0, 0),
        ("ACTIVE", 4.0, -1.0, 1),
        ("HOLD", 0.0, 20.0, 1),
        ("OFF", 0.0, -1.0, 0),
        ("OFF", 4.0, 20.0, 1),
        ("FAULT", 4.0, -1.0, 0),
        ("FAULT", 4.0, 20.0, 1),
    ],
)
def test_the_heartbeat_belongs_to_the_state(state: str, enable: float, valid_for_s: float, violated: int) -> None:
    ledger = Ledger(["heartbeat"])
    watch = HeartbeatWatch(MACROS, ledger)
    nc = NumericalControl(program=1000, clock_s=500.0, clock_ppm=0.0, power_on_count=1, tool_number=1)
    nc.macros.set(MACROS.enable, enable)
    nc.macros.set(MACROS.valid_until, nc.clock_s + valid_for_s)
    watch.look(10.0, claims(state), nc)
    assert ledger.counts["heartbeat"].checked == 0, "not settled"
    watch.look(10.0 + SETTLED_S, claims(state), nc)
    assert (ledger.counts["heartbeat"].checked, ledger.counts["heartbeat"].violated) == (1, violated)
