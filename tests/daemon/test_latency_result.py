"""From what the simulated machine told and the audit to delays: exact sums, and a reason for every gap."""

import functools

import numpy as np
import pytest
from shipped_machine import shipped_machine

from daemon.history.series import WriteRecord
from daemon.simulation.latency.experiment import Experiment, setting_of
from daemon.simulation.latency.result import STATISTICS, Account, moves_of, result
from models.records import WriteOutcome

EPOCH_UTC_S = 1.7e9
LINE_TIME_S, LAG_S, PRODUCT_S = 0.9, 0.2, 0.004


def setting(mode="temperature", **changes):
    content = {"mode": mode, "cleansing": False, "switches": 3, "speed": 60.0, "seed": 1} | changes
    return setting_of(Experiment(**content), configuration())


@functools.cache
def configuration():
    return shipped_machine()


def write(value, macro, at_s, *, cause="temperature", product_s=PRODUCT_S, outcome=WriteOutcome.VERIFIED):
    return WriteRecord(
        write_id=1,
        time_s=EPOCH_UTC_S + at_s,
        cause=cause,
        person=None,
        state=None,
        reason=None,
        requested_um={},
        compensation_um={},
        enable=(),
        limits_hit=(),
        macros=((macro, value),),
        outcome=outcome,
        sequence=None,
        detail=None,
        read_back=(value,),
        applied_um={},
        outcome_time_s=None,
        cycle_time_s=None,
        delay_s={"written": product_s / 2, "read_back": product_s},
    )


class Machine:
    """A machine whose passes begin at every whole ten seconds; `held` passes go by before the macro follows."""

    def __init__(self, setting, *, held=0, lag_s=LAG_S):
        self.setting, speed = setting, setting.experiment.speed
        moves_s, macro = setting.script.moves_s, setting.script.macro
        self.moves = [
            {"number": n, "time_s": t, "hot": n % 2 == 1, "lag_s": lag_s} for n, t in enumerate(moves_s, start=1)
        ]
        self.passes, self.macros, self.audit = [], [], []
        readings = []
        for start_s in np.arange(0.0, setting.until_s, 10.0):
            hot = sum(t + lag_s <= start_s for t in moves_s) % 2 == 1
            end_s = start_s + LINE_TIME_S
            degc = 42.0 if hot else 2.0
            if start_s % 20.0:
                degc += 0.125  # noise and rounding
            event = {"line": setting.line, "start_s": start_s, "end_s": end_s, "degc": degc}
            self.passes.append(event | {"real_s": end_s / speed})
            readings.append(event["degc"])
            shown = readings[max(len(readings) - 1 - held, 0)]
            if not self.macros or self.macros[-1]["value"] != shown:
                real_s = end_s / speed + PRODUCT_S / 2
                self.macros.append({"value": shown, "time_s": real_s * speed, "real_s": real_s})
                self.audit.append(write(shown, macro, real_s * speed))

    @property
    def account(self):
        return Account.of(
            [
                *({"move": move} for move in self.moves),
                {"ready": True},
                *({"pass": event} for event in self.passes),
                *({"macro": event} for event in self.macros),
            ]
        )

    def delays(self):
        return moves_of(self.setting, self.account, self.audit, EPOCH_UTC_S)


def test_every_part_is_found_and_a_total_is_their_sum():
    machine = Machine(setting())
    moves, problems = machine.delays()
    assert problems == [] and len(moves) == 3
    for move, time_s in zip(moves, machine.setting.script.moves_s, strict=True):
        start_s = np.ceil((time_s + LAG_S) / 10.0) * 10.0
        assert move.sensor_lag_s == pytest.approx(LAG_S)
        assert move.sampling_wait_s == pytest.approx(start_s - time_s - LAG_S)
        assert move.line_time_s == pytest.approx(LINE_TIME_S)
        assert move.held_back_s == 0.0
        assert move.product_s == pytest.approx(PRODUCT_S)
        assert move.measurement_s == pytest.approx(start_s + LINE_TIME_S - time_s)
        assert move.total_s == pytest.approx(move.measurement_s + PRODUCT_S)


@pytest.mark.parametrize("speed", [1.0, 600.0])
def test_the_product_counts_wall_seconds_whatever_the_speed(speed):
    moves, problems = Machine(setting(speed=speed)).delays()
    assert problems == []
    assert all(move.feedback_s == pytest.approx(PRODUCT_S) for move in moves)


def answer(machine):
    """Let the macro answer as compensation does: against the temperature, in millimetres."""
    for event, record in zip(machine.macros, list(machine.audit), strict=True):
        value = -0.0001 * event["value"]
        event["value"] = value
        machine.audit.append(write(value, machine.setting.script.macro, record.time_s - EPOCH_UTC_S, cause="estimate"))


@pytest.mark.parametrize(
    "spoil,sentence",
    [
        (lambda machine: machine.moves.pop(), "did not make it"),
        (lambda machine: machine.passes.clear(), "no reading from before"),
        (lambda machine: machine.macros.clear(), "vacant"),
        (lambda machine: machine.macros.__delitem__(slice(1, None)), "did not change before the next"),
        (lambda machine: machine.audit.clear(), "the audit knows no verified write"),
        (lambda machine: [event.update(degc=2.0) for event in machine.passes], "no reading shows it"),
    ],
)
def test_a_move_without_a_delay_says_why(spoil, sentence):
    machine = Machine(setting())
    spoil(machine)
    _, problems = machine.delays()
    assert problems and all(sentence in problem and "move " in problem for problem in problems)


def test_a_write_that_was_not_verified_does_not_count():
    machine = Machine(setting())
    machine.audit = [
        write(event["value"], machine.setting.script.macro, event["time_s"], outcome=WriteOutcome.DIFFERS)
        for event in machine.macros
    ]
    assert len(machine.delays()[1]) == 3


def test_the_result_has_every_statistic_beside_the_published_means():
    machine = Machine(setting())
    numbers = result(machine.setting, machine.delays()[0])
    blocks = [numbers[key] for key in ("measurement_s", "feedback_s", "total_s")]
    assert set(numbers["parts_s"]) == {"sampling_wait", "sensor_lag", "line_time", "product"}
    for block in (*blocks, *numbers["parts_s"].values()):
        assert tuple(block) == STATISTICS and block["samples"] == 3
    parts = sum(part["mean"] for part in numbers["parts_s"].values())
    assert numbers["total_s"]["mean"] == pytest.approx(parts + numbers["held_back_s"]["mean"])
    published = numbers["published"]
    assert (published["measurement_s"], published["feedback_s"], published["total_s"]) == (20.0, 1.2, 24.7)
    assert "another rig" in published["note"] and "polling" in published["note"]
