"""The campaign's own table of states: it agrees with the product, and finds each mistake put into the product."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest

from daemon.simulation.faults.state_oracle import FOLLOWERS, STARTS, Situation, unlawful, way
from models.control import compensation
from models.control.compensation import TRANSITIONS, Condition, initial_memory, step
from models.control.state import OutputInputs, OutputLimits, OutputMemory
from models.records import OutputState, Phase

Table = dict[OutputState, tuple[tuple[Condition, OutputState], ...]]

AXES = ("z",)
LIMITS = OutputLimits(
    axes=AXES,
    absolute_bound_um=np.array([50.0]),
    slew_um_per_min=np.array([1000.0]),
    step_um=np.array([50.0]),
    rounding_um=np.array([0.05]),
    deadband_um=np.array([0.1]),
    stale_after_s=60.0,
    hold_limit_s=600.0,
    min_confidence=0.7,
    probe_bound_um=20.0,
)
SITUATIONS = [
    Situation(
        asked_for=asked_for,
        trusted=trusted,
        zero_first=zero_first,
        connected=connected,
        at_zero=at_zero,
        can_follow=can_follow and connected,
    )
    for asked_for, trusted, zero_first, connected, at_zero, can_follow in itertools.product((False, True), repeat=6)
]
STEPS = 4
ONLY_IN_TIME = {Condition.HELD_TOO_LONG, Condition.ACKNOWLEDGED}


def memory_in(state: str, now: Situation) -> OutputMemory:
    """Return a memory in this state, with nothing commanded where the tool is at zero."""
    um = np.array([0.0 if now.at_zero else 5.0])
    memory = initial_memory(now_s=0.0, applied_um=um, wanted=(now.asked_for,))
    return replace(memory, state=OutputState(state), reference_id="r", model_id="m")


def inputs(now: Situation, time_s: float) -> OutputInputs:
    um = 0.0 if now.at_zero else 5.0
    return OutputInputs(
        now_s=time_s,
        phase=Phase.IDLE,
        link=now.connected,
        applied_um=np.array([um]),
        written_um=np.array([um]),
        thermal_error_um=np.array([-um]),
        estimate_age_s=0.0 if now.can_follow else 500.0,
        confidence=1.0,
        in_domain=True,
        reference_id="r",
        estimate_reference_id="r",
        model_id="m",
        output_fault=None if now.trusted else "not trusted",
        zero_first=now.zero_first,
    )


def way_of_the_product(state: str, now: Situation) -> list[str]:
    """Let the product's step run for a while in an unchanging situation; return the states that it passes."""
    memory = memory_in(state, now)
    passed = [state]
    for number in range(STEPS):
        memory, _ = step(memory, inputs(now, 1.0 + number), LIMITS)
        if memory.state.value != passed[-1]:
            passed.append(memory.state.value)
    return passed


def disagreements(*states: OutputState) -> Iterator[str]:
    for state, now in itertools.product(states, SITUATIONS):
        if state is OutputState.OFF and not now.at_zero:
            continue  # OFF is entered only with an echo of 0
        passed, expected = way_of_the_product(state.value, now), way(state.value, now)
        if passed != expected:
            yield f"{now}: {' -> '.join(passed)}, not {' -> '.join(expected)}"


def test_product_and_oracle_agree_in_every_state_and_situation() -> None:
    assert list(disagreements(*OutputState)) == []


def mutants() -> Iterator[tuple[str, Table]]:
    """Every table with one row taken out, or led to another state."""
    for state, rows in TRANSITIONS.items():
        for index, (condition, target) in enumerate(rows):
            if condition in ONLY_IN_TIME:
                continue
            for wrong in (None, *OutputState):
                if wrong in (target, state):
                    continue
                kept = ((condition, wrong),) if wrong is not None else ()
                table: Table = dict(TRANSITIONS)
                table[state] = (*rows[:index], *kept, *rows[index + 1 :])
                yield f"{state.value}: {condition.name} -> {wrong.value if wrong else 'nowhere'}", table


@pytest.mark.parametrize(("name", "table"), [pytest.param(n, t, id=n) for n, t in mutants()])
def test_a_wrong_row_in_the_products_table_is_found(name: str, table: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compensation, "TRANSITIONS", table)
    state = OutputState(name.partition(":")[0])
    assert next(disagreements(state), None) is not None


def test_what_only_time_and_people_bring_about_leads_where_the_specification_says() -> None:
    """These rows are judged by the changes that the daemon records, by `hold_is_left` and by `fault_is_latched`."""
    rows = {(state.value, target.value) for state, row in TRANSITIONS.items() for c, target in row if c in ONLY_IN_TIME}
    assert rows == {("HOLD", "RETREAT"), ("FAULT", "HOLD")}
    assert unlawful(sorted(rows)) == []


def test_the_followers_are_those_of_the_products_table() -> None:
    of_product: Mapping[str, frozenset[str]] = {
        state.value: frozenset(target.value for _, target in rows) for state, rows in TRANSITIONS.items()
    }
    assert of_product == FOLLOWERS
    assert {"OFF", "HOLD"} == STARTS


def test_changes_that_nobody_knows_are_named() -> None:
    assert unlawful([("OFF", "ARMED"), ("FAULT", "ACTIVE"), ("nothing", "OFF")]) == [
        ("FAULT", "ACTIVE"),
        ("nothing", "OFF"),
    ]
