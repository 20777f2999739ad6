"""The demonstration: runs until a given time, counts what arrived and was written, and checks the result."""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from daemon.monitor.control_socket import RequestError
from daemon.simulation import SimulationError
from daemon.simulation.processes import RunningSimulation
from drivers.latsis.cycle import MIN_SILENCE_REAL_S, SILENCE_PERIODS

JUDGED_FROM_UM = 5.0
"""An axis whose uncompensated error stays below this is not judged [um]."""
DRAIN_S = 3.0
"""Wall time that the daemon gets for the last cycles."""
SPEED_KEYS = ("state", "programmed_rpm", "commanded_rpm", "applied_rpm", "limiting_depth_mm", "alarm")
SEEN_KEPT = 720
DIFFERING_SHARE = 0.01
"""Share of the cycles of `temperatures.sources` by which their number may differ where the clock is fast: two that a
busy computer brings within half a cycle period make one, and one whose parts it brings too far apart makes two. The
bytes of a line wait, so every cycle of it must arrive, once."""
NOT_ENABLED = ("nothing was written", "was switched on", ": None um applied")
"""What a run shows in which nobody switched anything on; the last of a control that gives no macro variables."""


def too_slow(late_s: float, speed: float, cycle_period_s: float, *, lines: bool) -> str:
    """Return that this computer, late by `late_s` at worst, cannot simulate at `speed`, and at which it may.

    `lines`: serial lines of LATSIS are simulated, beside sources or alone.
    """
    silence_s = max(SILENCE_PERIODS * cycle_period_s / speed, MIN_SILENCE_REAL_S)
    possible = int(min(SILENCE_PERIODS * cycle_period_s / (2 * max(late_s, 1e-6)), speed / 2))
    advice = f"use --speed {possible}" if possible >= 1 else "end other programs"
    ended = f"a line that is silent for {silence_s * 1e3:.0f} ms has ended its pass"
    due = f"the next reading of a source is due after {cycle_period_s / speed * 1e3:.0f} ms"
    return (
        f"this computer is too slow, or too busy, for --speed {speed:g}: machine or daemon waited up to "
        f"{late_s * 1e3:.0f} ms for its turn, and {ended if lines else due}; {advice}"
    )


def switch_on(running: RunningSimulation, patience_s: float = 20.0) -> None:
    """Enable every axis that has a model, as an operator would."""
    deadline = time.monotonic() + patience_s
    while True:
        try:
            while running.client.ask("status")["output"]["since_s"] is None and time.monotonic() < deadline:
                running.check_alive()
                time.sleep(0.05)
            running.client.ask("enable")
            return
        except RequestError as error:
            running.check_alive()
            if time.monotonic() > deadline:
                raise SimulationError(f"the daemon refused to enable: {error}") from error
            time.sleep(0.1)


def switch_on_again(running: RunningSimulation, status: dict[str, Any]) -> bool:
    """Switch on, as an operator would, what the daemon took back because it had held for too long; tell whether it did.

    Where a computer stands still for some seconds, the machine is without temperatures for minutes.
    """
    if not status["output"]["reason"].startswith("held too long"):
        return False
    try:
        running.client.ask("enable")
    except RequestError:
        return False
    return True


def watch(running: RunningSimulation, until_s: float, look: Callable[[dict[str, Any]], None], period_s: float) -> None:
    """Look at the daemon's status every `period_s` [s of the wall clock] until the simulated time is over."""
    while running.time_s < until_s:
        running.check_alive()
        look(running.client.ask("status"))
        time.sleep(min(period_s, max(0.0, (until_s - running.time_s) / running.speed)))


def settle(running: RunningSimulation) -> tuple[dict[str, Any], dict[str, Any]]:
    """Wait until the simulator has sent its last cycle and the daemon has taken it; return both accounts."""
    final = running.wait_for_report("final", DRAIN_S + 60.0 / running.speed + 10.0)
    expected = sum(final["cycles_sent"].values())
    deadline = time.monotonic() + DRAIN_S
    status = running.client.ask("status")
    while status["cycles"]["received"] < expected and time.monotonic() < deadline:
        time.sleep(0.05)
        status = running.client.ask("status")
    return final, status


def result(
    final: dict[str, Any], status: dict[str, Any], speed: float, cycle_period_s: float, *, enabled: bool = True
) -> tuple[dict[str, Any], list[str]]:
    """Return the demonstration's numbers and every check that failed, first that the computer was too slow for it.

    Where it was not `enabled` from the start, nothing fails for what waits to be switched on.
    """
    errors = {}
    untouched = {"uncompensated_max_um": 0.0, "compensated_max_um": 0.0}
    for axis in status["axes"]:
        truth = final["truth"].get(axis, untouched)
        modelled = status["axes"][axis]["estimate_from"] is not None
        without, compensated = truth["uncompensated_max_um"], truth["compensated_max_um"]
        if not modelled or without <= JUDGED_FROM_UM or not (enabled or status["writes"]["sent"]):
            verdict = "not_judged"
        else:
            verdict = "passed" if compensated <= without / 2 else "failed"
        errors[axis] = {"uncompensated_max": without, "compensated_max": compensated, "verdict": verdict}
    numbers = {
        "cycles": {
            "expected": sum(final["cycles_sent"].values()),
            "received": status["cycles"]["received"],
            "incomplete": status["cycles"]["incomplete"],
        },
        "estimates": status["estimates"],
        "writes": status["writes"],
        "latency_s": {
            part: {key: status["latency_s"][part][key] for key in ("mean", "p50", "p99", "max")}
            for part in ("feedback", "total")
        },
        "error_um": errors,
        "spindle_speed": status["spindle_speed"] and {key: status["spindle_speed"][key] for key in SPEED_KEYS},
    }
    missing = numbers["cycles"]["expected"] - numbers["cycles"]["received"]
    lost = [] if -may_differ(final) <= missing <= may_differ(final) else [_not_arrived(numbers["cycles"])]
    failures = lost + _failures(numbers, status, final)
    if not enabled:
        failures = [failure for failure in failures if not any(words in failure for words in NOT_ENABLED)]
    incomplete = numbers["cycles"]["incomplete"] and not sum(final["cycles_disturbed"].values())
    late_s = max(final["late_real_s"], numbers["latency_s"]["feedback"]["max"] or 0.0)
    if failures and (incomplete or lost or late_s * speed > cycle_period_s):
        failures = [too_slow(late_s, speed, cycle_period_s, lines=bool(final["cycles_disturbed"])), *failures]
    return numbers, failures


def may_differ(final: dict[str, Any]) -> int:
    """Return by how many cycles a fast simulation's account may differ: a share of those of sources, rounded up."""
    lines = final["cycles_disturbed"]
    of_sources: int = sum(sent for name, sent in final["cycles_sent"].items() if name not in lines)
    return math.ceil(DIFFERING_SHARE * of_sources)


def _not_arrived(cycles: dict[str, int]) -> str:
    return f"{cycles['expected']} cycles were sent, {cycles['received']} arrived"


def _failures(numbers: dict[str, Any], status: dict[str, Any], final: dict[str, Any]) -> list[str]:
    failures = []
    cycles, writes = numbers["cycles"], numbers["writes"]
    if cycles["incomplete"] and not sum(final["cycles_disturbed"].values()):
        failures.append(f"{cycles['incomplete']} cycles are incomplete without a fault that explains them")
    if writes["sent"] == 0:
        failures.append("nothing was written")
    if writes["verified"] != writes["sent"]:
        failures.append(f"{writes['sent'] - writes['verified']} writes were not verified")
    if status["output"]["state"] == "FAULT":
        failures.append(f"the output ended in FAULT: {status['output']['reason']}")
    for axis, state in status["axes"].items():
        applied, bound = state["applied_um"], state["bound_um"]
        if applied is None or abs(applied) > bound + 1e-6:
            failures.append(f"axis {axis}: {applied} um applied, bound {bound} um")
        if state["estimate_from"] is not None and not (state["wanted"] and axis in status["written_axes"]):
            ended = "never written" if state["wanted"] else "off now"
            why = status["output"]["reason"]
            failures.append(f"axis {axis} was switched on, but is {ended}: {status['output']['state']}: {why}")
    for axis, error in numbers["error_um"].items():
        if error["verdict"] == "failed":
            failures.append(
                f"axis {axis}: {error['compensated_max']:.1f} um left of {error['uncompensated_max']:.1f} um"
            )
    return failures


class Trail:
    """The last minutes of the true error per axis, for the live view."""

    def __init__(self) -> None:
        self._seen = 0
        self.axes: dict[str, deque[tuple[float, float]]] = {}
        self.time_s = 0.0

    def take(self, reports: list[dict[str, Any]]) -> dict[str, Any] | None:
        """Add what is new; return the newest report."""
        for report in reports[self._seen :]:
            for axis, truth in report.get("truth", {}).items():
                series = self.axes.setdefault(axis, deque(maxlen=SEEN_KEPT))
                series.append((truth["uncompensated_um"], truth["compensated_um"]))
            self.time_s = report.get("time_s", self.time_s)
        self._seen = len(reports)
        return reports[-1] if reports else None

    def largest_um(self) -> dict[str, tuple[float, float]]:
        """Return per axis the largest error that was seen, without and with compensation [um]."""
        return {
            axis: (max(abs(without) for without, _ in series), max(abs(with_it) for _, with_it in series))
            for axis, series in self.axes.items()
            if series
        }
