"""From the simulated machine's account and the daemon's audit to the delay of every move: the sum of its parts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from daemon.history.series import WriteRecord
from daemon.simulation.latency.experiment import Setting
from daemon.telemetry.latency import PUBLISHED_DELAY_S, PUBLISHED_NOTE, summary
from models.records import WriteOutcome

LEAST_COMPENSATION_CHANGE = 1e-5
"""In the macros' unit [mm]: 0.01 um. Between moves the deadband keeps the macro still."""
SAME_VALUE = 1e-9
STATISTICS = ("mean", "p50", "p99", "max", "samples")


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    number: int
    time_s: float
    hot: bool
    sampling_wait_s: float
    sensor_lag_s: float
    line_time_s: float
    held_back_s: float
    """From the last byte of the first changed reading to that of the cycle that changed the macro."""
    product_s: float
    """From that last byte to the verified read-back, in wall seconds."""
    seen_by_machine_s: float
    """The same as the simulated machine saw it: bytes handed over until the macro was set, in wall seconds."""

    @property
    def measurement_s(self) -> float:
        return self.sensor_lag_s + self.sampling_wait_s + self.line_time_s

    @property
    def feedback_s(self) -> float:
        return self.held_back_s + self.product_s

    @property
    def total_s(self) -> float:
        return self.measurement_s + self.feedback_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Account:
    """What the simulated machine has told, in order."""

    moves: tuple[dict[str, Any], ...]
    passes: tuple[dict[str, Any], ...]
    macros: tuple[dict[str, Any], ...]

    @classmethod
    def of(cls, reports: Sequence[dict[str, Any]]) -> "Account":
        def told(key: str) -> tuple[dict[str, Any], ...]:
            return tuple(report[key] for report in reports if key in report)

        return cls(moves=told("move"), passes=told("pass"), macros=told("macro"))


def moves_of(
    setting: Setting, account: Account, audit: Sequence[WriteRecord], epoch_utc_s: float
) -> tuple[list[Move], list[str]]:
    """Return the delays of the moves that reached the macro, and in words why others have none."""
    found: list[Move] = []
    problems: list[str] = []
    told = {move["number"]: move for move in account.moves}
    for number, time_s in enumerate(setting.script.moves_s, start=1):
        try:
            if number not in told:
                raise LookupError("the simulated machine did not make it")
            found.append(_delay(setting, account, audit, epoch_utc_s, told[number]))
        except LookupError as error:
            problems.append(f"move {number} at {time_s:.1f} s has no delay: {error.args[0]}")
    return found, problems


def _delay(
    setting: Setting, account: Account, audit: Sequence[WriteRecord], epoch_utc_s: float, move: dict[str, Any]
) -> Move:
    time_s, rises = float(move["time_s"]), 1.0 if move["hot"] else -1.0
    next_s = next((later_s for later_s in setting.script.moves_s if later_s > time_s), setting.until_s)
    first = _first_changed(setting, account, (time_s, next_s), rises)
    change = _changed_macro(setting, account, first, next_s, rises)
    record = _write_of(setting, audit, change, epoch_utc_s)
    cause = _cause_of(setting, account, change, record)
    product_s = record.delay_s["read_back"]
    held_back_s = cause["end_s"] - first["end_s"]
    if setting.experiment.mode == "temperature" and not setting.experiment.cleansing:
        # No rule holds anything back here: a cycle that was overtaken waited for this computer, in wall time.
        product_s, held_back_s = product_s + cause["real_s"] - first["real_s"], 0.0
    if record.cause == "tick":  # written between two cycles: held back until then, on the machine's clock
        held_back_s = (change["real_s"] - first["real_s"]) * setting.experiment.speed
    lag_s = min(float(move["lag_s"]), first["start_s"] - time_s)
    return Move(
        number=move["number"],
        time_s=time_s,
        hot=bool(move["hot"]),
        sampling_wait_s=first["start_s"] - time_s - lag_s,
        sensor_lag_s=lag_s,
        line_time_s=first["end_s"] - first["start_s"],
        held_back_s=held_back_s,
        product_s=product_s,
        seen_by_machine_s=change["real_s"] - cause["real_s"],
    )


def _first_changed(setting: Setting, account: Account, between_s: tuple[float, float], rises: float) -> dict[str, Any]:
    """Return the first pass whose reading shows the move."""
    time_s, next_s = between_s
    passes = [event for event in account.passes if event["line"] == setting.line]
    before = [event["degc"] for event in passes if event["start_s"] <= time_s]
    if not before:
        raise LookupError("there is no reading from before it")
    for event in passes:
        changed = rises * (event["degc"] - before[-1]) >= setting.script.change_degc
        if time_s < event["start_s"] < next_s and changed:
            return event
    raise LookupError("no reading shows it before the next one")


def _changed_macro(
    setting: Setting, account: Account, first: dict[str, Any], next_s: float, rises: float
) -> dict[str, Any]:
    temperature = setting.experiment.mode == "temperature"
    least = setting.script.change_degc if temperature else LEAST_COMPENSATION_CHANGE
    direction = rises if temperature else -rises
    before = [event["value"] for event in account.macros if event["real_s"] <= first["real_s"]]
    if not before or before[-1] is None:
        raise LookupError("the macro was vacant before it")
    for event in account.macros:
        if event["real_s"] <= first["real_s"] or event["time_s"] >= next_s or event["value"] is None:
            continue
        if direction * (event["value"] - before[-1]) >= least:
            return event
    raise LookupError("the macro did not change before the next one")


def _cause_of(setting: Setting, account: Account, change: dict[str, Any], record: WriteRecord) -> dict[str, Any]:
    """Return the pass whose cycle changed the macro: the one that by the daemon's trace ended so long before."""
    ended_real_s = change["real_s"] - record.delay_s["written"]
    passes = [event for event in account.passes if event["real_s"] <= change["real_s"]]
    if setting.experiment.mode == "temperature":
        passes = [event for event in passes if event["line"] == setting.line and event["degc"] == change["value"]]
    if not passes:
        raise LookupError(f"no pass carried the {change['value']} that the macro holds")
    return min(passes, key=lambda event: abs(event["real_s"] - ended_real_s))


def _write_of(
    setting: Setting, audit: Sequence[WriteRecord], change: dict[str, Any], epoch_utc_s: float
) -> WriteRecord:
    """Return the audit's record of what the machine saw."""
    same = [
        record
        for record in audit
        if record.outcome is WriteOutcome.VERIFIED
        and any(n == setting.script.macro and abs(v - change["value"]) <= SAME_VALUE for n, v in record.macros)
    ]
    if not same:
        raise LookupError(f"the audit knows no verified write of {change['value']} to #{setting.script.macro}")
    utc_s = epoch_utc_s + change["time_s"]
    return min(same, key=lambda record: abs(record.time_s - utc_s))


def result(setting: Setting, moves: Sequence[Move]) -> dict[str, Any]:
    """Return the delays of all moves as JSON values [s]."""
    experiment = setting.experiment

    def of(name: str) -> dict[str, Any]:
        figures = summary([getattr(move, name) for move in moves])
        return {key: figures[key] for key in STATISTICS}

    return {
        "mode": experiment.mode,
        "cleansing": experiment.cleansing,
        "speed": experiment.speed,
        "seed": experiment.seed,
        "switches": experiment.switches,
        "sensor": setting.script.sensor,
        "line": setting.line,
        "cycle_period_s": setting.cycle_period_s,
        "measurement_s": of("measurement_s"),
        "feedback_s": of("feedback_s"),
        "total_s": of("total_s"),
        "parts_s": {
            "sampling_wait": of("sampling_wait_s"),
            "sensor_lag": of("sensor_lag_s"),
            "line_time": of("line_time_s"),
            "product": of("product_s"),
        },
        "held_back_s": of("held_back_s"),
        "seen_by_machine_s": of("seen_by_machine_s"),
        "published": {**{f"{part}_s": seconds for part, seconds in PUBLISHED_DELAY_S.items()}, "note": PUBLISHED_NOTE},
        "moves": [
            {
                "number": move.number,
                "time_s": move.time_s,
                "to": "hot" if move.hot else "ice",
                "measurement_s": move.measurement_s,
                "feedback_s": move.feedback_s,
                "total_s": move.total_s,
                "product_s": move.product_s,
            }
            for move in moves
        ],
    }
