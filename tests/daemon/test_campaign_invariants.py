"""Each invariant of a fault campaign can fail: a trace that violates it is fed to its checker."""

from functools import partial

import campaign_claims
import pytest

from config.loader import load_configuration
from config.schema import Configuration
from daemon.cli.simulate.demo import demo_machine
from daemon.simulation.faults.invariants import Claims, Ledger, WriteWatch
from daemon.simulation.processes import write_simulation_configuration

A, X, Y, Z, VALID, ENABLE, CHECK, B = 500, 501, 502, 503, 120, 504, 506, 505
claims = partial(campaign_claims.claims, wanted=(False, True, True))


@pytest.fixture(scope="module")
def configuration(tmp_path_factory: pytest.TempPathFactory) -> Configuration:
    path, _ = write_simulation_configuration(demo_machine(), tmp_path_factory.mktemp("machine"), speed=1.0)
    return load_configuration(path)


class Trace:
    """A watch that sees blocks and movements of a trace."""

    def __init__(self, configuration: Configuration) -> None:
        self.ledger = Ledger(WriteWatch.NAMES)
        self.watch = WriteWatch(configuration, self.ledger)
        self.sequence = 0.0
        self.watch.applied(0.0, {"x": 0.0, "y": 0.0, "z": 0.0}, cutting=False)

    def block(self, time_s: float, z_um: float, said: Claims | None = None, *, y_um: float = 0.0) -> None:
        self.sequence += 1
        content = ((X, 0.0), (Y, y_um / 1e3), (Z, z_um / 1e3), (VALID, time_s + 30), (ENABLE, 6.0), (CHECK, 1.0))
        for group in (((A, self.sequence),), content, ((B, self.sequence),)):
            self.watch.group(time_s, group, said or claims(), taken=True)

    @property
    def violated(self) -> set[str]:
        return {name for name, count in self.ledger.counts.items() if count.violated}


@pytest.fixture
def trace(configuration: Configuration) -> Trace:
    return Trace(configuration)


def test_a_good_trace_violates_nothing_and_is_checked(trace: Trace) -> None:
    """4 um/min on z: half a micrometre in ten seconds."""
    for n in range(20):
        trace.block(10.0 * n, 0.5 * n)
        trace.watch.applied(10.0 * n + 5, {"x": 0.0, "y": 0.0, "z": 0.5 * n}, cutting=False)
    assert trace.violated == set()
    assert trace.ledger.counts["slew_written"].checked == 3 * 19
    assert trace.ledger.counts["block_order"].checked == 3 * 20


def test_the_slew_rate(trace: Trace) -> None:
    trace.block(0.0, 0.0)
    trace.block(10.0, 2.0)
    assert trace.violated == {"slew_written"}


def test_the_bound(trace: Trace) -> None:
    trace.block(0.0, 81.0)
    assert trace.violated == {"bound_written"}


def test_what_the_nc_applies(trace: Trace) -> None:
    trace.watch.applied(1.0, {"x": 0.0, "y": 0.0, "z": 10.2}, cutting=False)
    assert trace.violated == {"step_applied"}
    for n in range(2, 10):
        trace.watch.applied(n, {"x": 0.0, "y": 0.0, "z": 10.0 * n}, cutting=False)
    assert trace.violated == {"step_applied", "bound_applied"}


def test_motion_in_a_cut(trace: Trace) -> None:
    trace.watch.applied(1.0, {"x": 0.0, "y": 0.0, "z": 1.0}, cutting=True)
    assert trace.violated == set(), "it moved before the cut began"
    trace.watch.applied(2.0, {"x": 0.0, "y": 0.0, "z": 1.1}, cutting=True)
    assert trace.violated == {"no_motion_in_cut"}


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_value_that_is_no_number(trace: Trace, value: float) -> None:
    trace.watch.group(0.0, ((A, 1.0),), claims(), taken=True)
    trace.watch.group(0.0, ((Z, value),), claims(), taken=True)
    assert trace.violated == {"finite"}


def test_a_macro_that_is_not_ours(trace: Trace) -> None:
    trace.watch.group(0.0, ((600, 1.0),), claims(), taken=True)
    assert trace.violated == {"allow_list"}


@pytest.mark.parametrize(
    "groups",
    [
        [((Z, 0.0),)],
        [((A, 1.0), (Z, 0.0))],
        [((A, 1.0),), ((B, 1.0),)],
        [((A, 1.0),), ((X, 0.0), (Y, 0.0), (Z, 0.0), (VALID, 1.0), (ENABLE, 0.0)), ((B, 2.0),)],
    ],
    ids=["content first", "all at once", "no content", "another number"],
)
def test_the_order_of_a_block(trace: Trace, groups: list[tuple[tuple[int, float], ...]]) -> None:
    for group in groups:
        trace.watch.group(0.0, group, claims(), taken=True)
    assert trace.violated == {"block_order"}


def test_a_number_that_is_used_twice(trace: Trace) -> None:
    trace.block(0.0, 0.0)
    trace.sequence = 0.0
    trace.block(10.0, 0.0)
    assert trace.violated == {"block_order"}


def test_writing_in_fault_and_without_a_link(trace: Trace) -> None:
    trace.block(0.0, 0.0, claims("FAULT"))
    assert trace.violated == {"nothing_written_in_fault"}
    trace.block(1.0, 0.0, claims(link=False))
    assert trace.violated == {"nothing_written_in_fault", "nothing_written_without_link"}


def test_motion_in_hold(trace: Trace) -> None:
    trace.block(0.0, 0.0, claims("HOLD"))
    trace.block(60.0, 1.0, claims("HOLD"))
    assert trace.violated == {"hold_freezes"}


def test_motion_without_temperatures(trace: Trace) -> None:
    trace.watch.input_is(100.0, good=False)
    trace.block(150.0, 0.0)
    trace.block(161.0, 0.5)
    assert trace.violated == set(), "the estimate is not stale yet"
    trace.block(170.0, 1.0)
    trace.block(180.0, 1.5)
    assert trace.violated == {"no_motion_on_bad_input"}


@pytest.mark.parametrize(("to_um", "found"), [(9.0, set()), (11.0, {"no_motion_on_bad_input"})])
def test_a_retreat_without_temperatures_takes_out_and_adds_nothing(trace: Trace, to_um: float, found: set[str]) -> None:
    """Under zero_first the axes stay switched on while the offset is taken out, whether or not lines send anything."""
    trace.block(0.0, 10.0)
    trace.watch.input_is(100.0, good=False)
    trace.block(170.0, 10.0, claims("RETREAT"))
    trace.block(230.0, to_um, claims("RETREAT"))
    assert trace.violated == found


@pytest.mark.parametrize("mark", ["reference", "restart"])
def test_a_step_at_a_reference_or_a_restart(trace: Trace, mark: str) -> None:
    """What is written runs ahead of the tool; after both it must begin at the tool."""
    trace.watch.heard(0.0, claims())
    trace.block(0.0, 0.0)
    for n in range(1, 7):
        trace.block(60.0 * n, 4.0 * n)
    if mark == "reference":
        trace.watch.heard(361.0, claims(reference="r2"))
    else:
        trace.watch.restarted(361.0)
    trace.block(362.0, 24.0)
    assert trace.violated == {f"no_step_at_{mark}"}


def test_a_step_at_switching(trace: Trace) -> None:
    trace.watch.heard(0.0, claims())
    trace.block(0.0, 20.0)
    trace.watch.heard(100.0, claims(wanted=(False, True, False)))
    trace.block(101.0, 10.0, claims(wanted=(False, True, False)))
    assert "no_step_at_switching" in trace.violated


@pytest.mark.parametrize("mark", ["model", "tool", "probe"])
def test_a_step_where_what_is_written_must_go_on(trace: Trace, mark: str) -> None:
    trace.watch.heard(0.0, claims(model="m1"))
    trace.block(0.0, 20.0)
    trace.block(100.0, 20.0)
    if mark == "model":
        trace.watch.heard(101.0, claims(model="m2"))
    else:
        trace.watch.mark(101.0, mark)
    trace.block(102.0, 10.0)
    assert f"no_step_at_{mark}" in trace.violated


def test_a_hold_that_lasts_too_long(trace: Trace) -> None:
    for time_s in (0.0, 600.0, 614.0):
        trace.watch.heard(time_s, claims("HOLD"))
    assert trace.violated == set()
    trace.watch.heard(616.0, claims("HOLD"))
    assert trace.violated == {"hold_is_left"}
