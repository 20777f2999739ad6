"""The campaign's judgement of the way back: where the table leads, what counts as good input, and that it can fail."""

from typing import Any

import pytest
from campaign_claims import claims

from daemon.simulation.faults.invariants import Ledger
from daemon.simulation.faults.recovery import CutFreeze, RecoveryWatch, Truth, where_it_leads

NAMED_T2 = "the control shows T1, and the NC program has named T2"


def truth(**changes: bool) -> Truth:
    content = {"reachable": True, "temperatures": True, "distrust": False, "echo_known": True, "at_zero": False}
    return Truth(**(content | changes))


@pytest.mark.parametrize(
    ("state", "known", "said", "expected"),
    [
        ("HOLD", {}, {}, "ACTIVE"),
        ("OFF", {}, {}, "ACTIVE"),
        ("ACTIVE", {"reachable": False}, {}, "HOLD"),
        ("ACTIVE", {"temperatures": False}, {}, "HOLD"),
        ("ACTIVE", {"echo_known": False}, {}, "HOLD"),
        ("ACTIVE", {}, {"reference": None}, "HOLD"),
        ("ACTIVE", {}, {"confidence": 0.5}, "HOLD"),
        ("ACTIVE", {}, {"in_domain": False}, "HOLD"),
        ("ACTIVE", {"distrust": True}, {}, "FAULT"),
        ("HOLD", {"frozen_in_cut": True}, {}, "HOLD"),
        ("ACTIVE", {"frozen_in_cut": True}, {}, "HOLD"),
        ("ARMED", {"tool_unnamed": True}, {"reason": NAMED_T2}, "ARMED"),
        ("ARMED", {}, {"reason": NAMED_T2}, "ACTIVE"),
        ("HOLD", {"distrust": True}, {}, "FAULT"),
        ("FAULT", {}, {}, "FAULT"),
        ("ACTIVE", {}, {"wanted": (False,)}, "RETREAT"),
        ("RETREAT", {"at_zero": True}, {"wanted": (False,)}, "OFF"),
        ("OFF", {}, {"reference": None}, "ARMED"),
    ],
)
def test_where_the_table_leads(state: str, known: dict[str, bool], said: dict[str, Any], expected: str) -> None:
    assert where_it_leads(state, truth(**known), claims(state, **said), 0.7) == expected


@pytest.mark.parametrize(
    ("before", "within", "state", "frozen"),
    [
        (1.0, 0.87, "ACTIVE", True),
        (1.0, 0.87, "HOLD", True),
        (1.0, 0.96, "ACTIVE", False),
        (0.87, 0.87, "HOLD", False),
        (0.8, 0.9, "ACTIVE", False),
        (1.0, 0.87, "ARMED", False),
    ],
)
def test_within_a_cut_an_estimate_of_less_confidence_is_not_followed(
    before: float, within: float, state: str, frozen: bool
) -> None:
    freeze = CutFreeze(0.95)
    assert not freeze.look(claims(confidence=before), 0.7, cutting=False)
    assert freeze.look(claims(state, confidence=within), 0.7, cutting=True) is frozen
    assert not freeze.look(claims(state, confidence=within), 0.7, cutting=False), "between cuts the weight falls"
    assert not freeze.look(claims(state, confidence=within), 0.7, cutting=True)


def watched(states: list[tuple[float, str]], **known: bool) -> tuple[Ledger, RecoveryWatch]:
    """A case whose good input came at 100 s in HOLD, and the states that were claimed afterwards."""
    ledger = Ledger()
    watch = RecoveryWatch(ledger, 0.7)
    watch.over({"frozen_cnc"})
    watch.good_input(100.0, claims("HOLD"))
    for time_s, state in states:
        if watch.open:
            watch.look(time_s, truth(**known), claims(state))
    return ledger, watch


def test_a_way_back_within_the_time_is_right_and_timed() -> None:
    ledger, watch = watched([(100.0, "HOLD"), (104.0, "HOLD"), (108.0, "ACTIVE"), (116.0, "ACTIVE")])
    assert (ledger.counts["state_after_fault"].checked, ledger.violations) == (1, 0)
    assert watch.times_s == {"frozen_cnc": [4.0]}


def test_a_state_that_is_never_left_is_wrong() -> None:
    ledger, _ = watched([(100.0 + n, "HOLD") for n in range(30)])
    assert ledger.violations == 1
    assert "the table leads from HOLD to ACTIVE" in ledger.counts["state_after_fault"].examples[0]


def test_a_fault_that_is_not_seen_is_wrong() -> None:
    ledger, _ = watched([(100.0 + n, "ACTIVE") for n in range(30)], distrust=True)
    assert ledger.violations == 1


def test_a_new_incident_puts_the_judgement_off() -> None:
    ledger, watch = watched([(101.0, "HOLD")])
    watch.begun("noise")
    assert not watch.open
    assert ledger.counts == {}


def test_a_fault_that_ends_by_itself_is_wrong() -> None:
    ledger, watch = watched([])
    watch.left_fault(104.0, acknowledged=False)
    assert ledger.counts["fault_is_latched"].violated == 1
