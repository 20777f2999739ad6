"""From packed or raw rows of the audit to records."""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from daemon.history.columns.frames import Frame
from daemon.history.series import WriteRecord
from models.records import WriteOutcome

STAGES = ("cleansed", "estimated", "written", "read_back")


def write_records(frame: Frame) -> list[WriteRecord]:
    """Return each row of the audit as a record."""
    return [_record(frame, index) for index in range(frame.rows)]


def possible_macros(newest_first: Iterable[WriteRecord], of: Sequence[int]) -> dict[int, tuple[float, ...]]:
    """Return per macro what it may hold by the audit, as `HistoryReader.last_written_macros` says."""
    since_verified: list[WriteRecord] = []
    for record in newest_first:
        written = {number for number, _ in record.macros}
        if of and not written & set(of):
            continue
        since_verified.append(record)
        whole = written >= set(of) if of else record.state is not None
        if record.outcome is WriteOutcome.VERIFIED and whole:
            break  # a whole block; answers to the NC program and the like carry no state
    possible: dict[int, tuple[float, ...]] = {}
    for record in reversed(since_verified):
        if record.outcome is WriteOutcome.REFUSED:
            continue
        apart = not of and record.state is None and record.outcome is not WriteOutcome.VERIFIED
        for number, value in record.macros:
            if apart and number not in possible:
                continue  # it may not have arrived, and what stood there before is not told: it counts as found
            before = () if record.outcome is WriteOutcome.VERIFIED else possible.get(number, ())
            possible[number] = before if value in before else (*before, value)
    return possible


def _record(frame: Frame, index: int) -> WriteRecord:
    def number(name: str) -> float | None:
        value = float(frame.numbers(name)[index])
        return None if np.isnan(value) else value

    written = frame.mapping("macros").row(index) or {}
    outcome = WriteOutcome(int(frame.integers("outcome")[index]))
    utc_ms = int(frame.integers("utc_ms")[index])
    after_ms, age_ms, sequence = number("outcome_after_ms"), number("cycle_age_ms"), number("sequence")
    echoed_ms = number("echoed_after_ms")
    delays_us = {stage: number(f"{stage}_us") for stage in STAGES}
    return WriteRecord(
        write_id=int(frame.integers("write_id")[index]),
        time_s=utc_ms / 1e3,
        cause=frame.texts("cause")[index] or "",
        person=frame.texts("person")[index],
        state=frame.texts("state")[index],
        reason=frame.texts("reason")[index],
        requested_um=frame.mapping("requested_um").row(index) or {},
        compensation_um=frame.mapping("compensation_um").row(index) or {},
        enable=tuple(_listed(frame.texts("enable")[index])),
        limits_hit=tuple(_listed(frame.texts("limits_hit")[index])),
        macros=tuple((int(key.partition("#")[0]), np.nan if v is None else v) for key, v in written.items()),
        outcome=outcome,
        sequence=None if sequence is None else int(sequence),
        detail=frame.texts("detail")[index],
        read_back=_read_back(frame, index, written) if outcome is not WriteOutcome.INTENDED else (),
        applied_um=frame.mapping("applied_um").row(index) or {},
        outcome_time_s=None if after_ms is None else (utc_ms + after_ms) / 1e3,
        cycle_time_s=None if age_ms is None else (utc_ms - age_ms) / 1e3,
        delay_s={stage: us / 1e6 for stage, us in delays_us.items() if us is not None},
        echoed_after_s=None if echoed_ms is None else echoed_ms / 1e3,
    )


def _listed(text: str | None) -> list[Any]:
    return [] if text is None else list(json.loads(text))


def _read_back(frame: Frame, index: int, written: dict[str, float | None]) -> tuple[float | None, ...]:
    found = frame.mapping("read_back").row(index)
    return tuple(written.values()) if found is None else tuple(found.get(key) for key in written if key in found)
