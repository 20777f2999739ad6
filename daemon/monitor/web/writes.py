"""The audit of macro writes as a document: what stood there before, what was written, why, and with which model."""

from bisect import bisect_right
from collections.abc import Callable
from typing import Any

from daemon.history.columns.kinds import ESTIMATES, WRITES
from daemon.history.reader import HistoryReader
from daemon.history.series import WriteRecord
from models.json_values import finite_or_none, plain
from models.records import WriteOutcome

HOUR_S = 3600.0
SEARCHED = ("reason", "cause", "person", "state")


def writes_document(
    reader: HistoryReader, from_s: float, to_s: float, limit: int, text: str, outcome: str, go_on: Callable[[], None]
) -> dict[str, Any]:
    """Return the latest writes of an interval, newest first; where given, only those with `text` and of `outcome`."""
    extent = reader.extent(WRITES.name)
    if extent is None:
        return {"writes": [], "more": False}
    first_s, stop_s = max(from_s, extent[0]), min(to_s, extent[1] + 0.001)
    found: list[WriteRecord] = []
    while stop_s > first_s and len(found) <= limit:
        go_on()
        begin_s = max(first_s, stop_s - HOUR_S)
        found = [*(each for each in reader.writes(begin_s, stop_s) if _holds(each, text, outcome)), *found]
        stop_s = begin_s
    more, found = len(found) > limit, found[-limit:]
    if not found:
        return {"writes": [], "more": False}
    held = _held_before(reader, found[0].time_s)
    model_of = _models(reader, found[0].time_s - HOUR_S, found[-1].time_s)
    documents = []
    for record in found:
        old = [held.get(number) for number, _ in record.macros]
        documents.append(write_document(record) | {"old": old, "model_id": model_of(record)})
        if record.outcome is WriteOutcome.VERIFIED:
            held |= {number: finite_or_none(value) for number, value in record.macros}
    return {"writes": documents[::-1], "more": more}


def _holds(record: WriteRecord, text: str, outcome: str) -> bool:
    if outcome not in ("", record.outcome.name.lower()):
        return False
    return not text or any(text.lower() in (getattr(record, name) or "").lower() for name in SEARCHED)


def _held_before(reader: HistoryReader, time_s: float) -> dict[int, float | None]:
    """Return what each macro held before, by the writes of the hour before."""
    held: dict[int, float | None] = {}
    for record in reader.writes(time_s - HOUR_S, time_s):
        if record.outcome is WriteOutcome.VERIFIED:
            held |= {number: finite_or_none(value) for number, value in record.macros}
    return held


def _models(reader: HistoryReader, from_s: float, to_s: float) -> Callable[[WriteRecord], str | None]:
    """Return what tells the model of the latest estimate before a write of the output."""
    frame = reader.frame(ESTIMATES, from_s, to_s + 0.001, ("model_id",))
    times, names = (frame.integers("utc_ms") / 1e3).tolist(), frame.texts("model_id")

    def model_of(record: WriteRecord) -> str | None:
        place = bisect_right(times, record.time_s)
        return names[place - 1] if place and record.state is not None else None

    return model_of


def write_document(write: WriteRecord) -> dict[str, Any]:
    """Return one entry of the audit."""
    document = plain(
        {
            "id": write.write_id,
            "time": write.time_s,
            "cause": write.cause,
            "person": write.person,
            "state": write.state,
            "reason": write.reason,
            "requested_um": write.requested_um,
            "compensation_um": write.compensation_um,
            "applied_um": write.applied_um,
            "limits_hit": write.limits_hit,
            "macros": [[number, finite_or_none(value)] for number, value in write.macros],
            "read_back": write.read_back,
            "outcome": write.outcome.name.lower(),
            "detail": write.detail,
            "delay_s": write.delay_s,
            "echoed_after_s": write.echoed_after_s,
        }
    )
    assert isinstance(document, dict)
    return document
