"""What is now, as the history last recorded it: for systems that show a machine beside those that keep its history."""

import json
import time
from collections.abc import Mapping
from typing import Any

from daemon.sinks.outbox import STREAMS, Outbox
from models.records import OutputState

SILENT_AFTER_S = 120.0
"""A history to which nothing was added for so long is that of a daemon that does not run."""
Number = float | None


def current_values(outbox: Outbox) -> dict[str, Any]:
    """Return state, compensation, errors, temperatures and alarms; None or {} where the last hour has nothing."""
    write = outbox.newest(STREAMS["writes"], "state")
    cnc = outbox.newest(STREAMS["cnc"], "mode")
    estimate = outbox.newest(STREAMS["estimates"], "line")
    displacement = outbox.newest(STREAMS["displacements"], "um")
    state, reason, alarm = _state_and_alarm(outbox, write)
    requested, applied = _numbers(write.get("requested_um")), _numbers(write.get("applied_um"))
    follows = state == OutputState.ACTIVE
    newest_ms = max((row["utc_ms"] for row in (write, cnc, estimate) if row), default=None)
    return {
        "utc_ms": newest_ms,
        "state": state,
        "reason": reason,
        "alarm": alarm,
        "compensation_um": _numbers(write.get("compensation_um")),
        "applied_um": applied,
        "error_without_um": _numbers(estimate.get("thermal_error_um")),
        "error_with_um": {axis: _left(requested[axis], applied.get(axis)) if follows else None for axis in requested},
        "band_um": _numbers(estimate.get("band_um")),
        "label_degc": _numbers(estimate.get("label_degc")),
        "confidence": estimate.get("confidence"),
        "displacement_um": _numbers(displacement.get("um")),
        "cnc_alarm": None if not cnc else bool(cnc["alarm"]),
        "cnc_mode": cnc.get("mode"),
        "cnc_run": cnc.get("run"),
        "spindle_speed_rpm": cnc.get("spindle_speed_rpm"),
    }


def _state_and_alarm(outbox: Outbox, write: Mapping[str, Any]) -> tuple[str | None, str | None, str]:
    """Return the output's state and its reason, and the alarm that was raised since the state last changed."""
    change = outbox.newest(STREAMS["events"], "kind", "state")
    raised = outbox.newest(STREAMS["events"], "kind", "alarm")
    state, reason = write.get("state"), write.get("reason")
    if change and (not write or _when(change) >= _when(write)):
        words, _, reason = change["text"].partition(": ")
        state = words.rpartition(" ")[2]
    alarm = raised["text"] if raised and (not change or _when(raised) >= _when(change)) else ""
    return state, reason, alarm


def _when(row: Mapping[str, Any]) -> tuple[int, int]:
    return row["utc_ms"], row["monotonic_ms"]


def _numbers(text: str | None) -> dict[str, Number]:
    found: dict[str, Number] = json.loads(text) if text else {}
    return found


def _left(requested: Number, applied: Number) -> Number:
    """Return the error that the compensation leaves: what it asks for is minus the error."""
    return None if requested is None or applied is None else round(applied - requested, 3)


class Freshness:
    """Whether anything is added to the history."""

    def __init__(self) -> None:
        self._written, self._since_s = -1, time.monotonic()

    def fresh(self, outbox: Outbox) -> bool:
        """Return whether something was added in the last minutes."""
        if (written := outbox.written()) != self._written:
            self._written, self._since_s = written, time.monotonic()
        return time.monotonic() - self._since_s < SILENT_AFTER_S
