"""Reads the store, from any process, while the daemon writes; raw rows and packed hours alike."""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import FloatArray
from daemon.history.columns.frames import Frame
from daemon.history.columns.joining import ms_from_s, texts_of, time_s_of
from daemon.history.columns.kinds import DISPLACEMENTS, ESTIMATES, WRITES
from daemon.history.restart_reader import TABLES, RestartReader, named_damage
from daemon.history.series import CodeArray, WriteRecord, write_records
from models.records import Instant, ProbeSample, Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class DisplacementHistory:
    """Displacements as the logger wrote them."""

    time_s: FloatArray
    um: dict[str, FloatArray]
    """Per channel [um], NaN where there was no number."""
    reason: dict[str, CodeArray]
    source: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimateHistory:
    """Thermal errors as estimated."""

    time_s: FloatArray
    line: tuple[str, ...]
    """The line whose cycle renewed each estimate."""
    cycle_time_s: FloatArray
    """First byte of the cycle behind each estimate."""
    thermal_error_um: dict[str, FloatArray]
    band_um: dict[str, FloatArray]
    label_degc: dict[str, FloatArray]
    label_increment_degc: dict[str, FloatArray]
    in_domain: npt.NDArray[np.bool_]
    confidence: FloatArray
    imputed: tuple[tuple[int, ...], ...]
    model_id: tuple[str, ...]
    reference_id: tuple[str | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class EventRecord:
    """An operator's action, a change of state, an alarm."""

    time_s: float
    kind: str
    text: str
    person: str | None


class HistoryReader(RestartReader):
    """One read-only connection; for one thread. Times are UTC seconds, from <= t < to."""

    @named_damage
    def displacements(self, from_utc_s: float, to_utc_s: float) -> DisplacementHistory:
        """Return the rows of the logger's files."""
        frame = self.frame(DISPLACEMENTS, from_utc_s, to_utc_s)
        um, reasons = frame.mapping("um"), frame.mapping("reasons")
        none = np.zeros(frame.rows)
        return DisplacementHistory(
            time_s=time_s_of(frame),
            um=um.values,
            reason={key: np.nan_to_num(reasons.values.get(key, none)).astype(np.uint8) for key in um.values},
            source=texts_of(frame, "source"),
        )

    @named_damage
    def estimates(self, from_utc_s: float, to_utc_s: float) -> EstimateHistory:
        frame = self.frame(ESTIMATES, from_utc_s, to_utc_s)
        return EstimateHistory(
            time_s=time_s_of(frame),
            line=texts_of(frame, "line"),
            cycle_time_s=frame.integers("cycle_utc_ms") / 1e3,
            thermal_error_um=frame.mapping("thermal_error_um").values,
            band_um=frame.mapping("band_um").values,
            label_degc=frame.mapping("label_degc").values,
            label_increment_degc=_increments(frame),
            in_domain=frame.integers("in_domain").astype(bool),
            confidence=frame.numbers("confidence"),
            imputed=tuple(tuple(json.loads(text)) for text in texts_of(frame, "imputed")),
            model_id=texts_of(frame, "model_id"),
            reference_id=tuple(frame.texts("reference_id")),
        )

    @named_damage
    def writes(self, from_utc_s: float, to_utc_s: float) -> list[WriteRecord]:
        return write_records(self.frame(WRITES, from_utc_s, to_utc_s))

    @named_damage
    def events(self, from_utc_s: float, to_utc_s: float) -> list[EventRecord]:
        """Return operator actions, state changes and alarms."""
        found = self._connection.execute(
            "SELECT utc_ms, kind, text, person FROM events WHERE utc_ms >= ? AND utc_ms < ? ORDER BY utc_ms, id",
            (ms_from_s(from_utc_s), ms_from_s(to_utc_s)),
        )
        return [EventRecord(time_s=ms / 1e3, kind=kind, text=text, person=who) for ms, kind, text, who in found]

    @named_damage
    def probes(self, from_utc_s: float, to_utc_s: float) -> list[ProbeSample]:
        found = self._connection.execute(
            "SELECT utc_ms, monotonic_ms, axis, deviation_um, applied_um, thermal_error_um, reference_id, accepted, "
            "reason FROM probes WHERE utc_ms >= ? AND utc_ms < ? ORDER BY utc_ms, id",
            (ms_from_s(from_utc_s), ms_from_s(to_utc_s)),
        )
        return [_probe(row) for row in found]

    @named_damage
    def references(self, from_utc_s: float, to_utc_s: float) -> list[Reference]:
        found = self._connection.execute(
            "SELECT reference_id, monotonic_s, utc_s, real_s, source, degc, program, work_offset, power_on_count "
            "FROM reference_points WHERE utc_ms >= ? AND utc_ms < ? ORDER BY utc_ms, id",
            (ms_from_s(from_utc_s), ms_from_s(to_utc_s)),
        )
        return [_reference(row) for row in found]

    @named_damage
    def acknowledged(self) -> dict[str, int]:
        """Return the number of the last committed cycle of each line."""
        return dict(self._connection.execute("SELECT line, number FROM acknowledged").fetchall())

    @named_damage
    def last_written_utc_s(self, kind: str) -> float | None:
        """Return the time of the row that was written last, not that of a clock that was ahead; None without any."""
        for query in (
            f"SELECT utc_ms FROM {TABLES[kind]} WHERE ?1 = ?1 ORDER BY rowid DESC LIMIT 1",
            "SELECT end_ms FROM chunks WHERE kind = ?1 ORDER BY last_row_id DESC LIMIT 1",
        ):
            if (found := self._connection.execute(query, (kind,)).fetchone()) is not None:
                return float(found[0]) / 1e3
        return None

    @named_damage
    def row_count(self, kind: str) -> int:
        """Return how many rows of a kind there are, packed ones included."""
        with self._snapshot() as connection:
            (raw,) = connection.execute(f"SELECT count(*) FROM {TABLES[kind]}").fetchone()
            (packed,) = connection.execute("SELECT sum(row_count) FROM chunks WHERE kind = ?", (kind,)).fetchone()
        return int(raw + (packed or 0))


def _increments(frame: Frame) -> dict[str, FloatArray]:
    """Return each label's change since the reference [K]."""
    now, at_reference = frame.mapping("label_degc").values, frame.mapping("label_reference_degc").values
    return {label: np.round(now[label] - before, 3) for label, before in at_reference.items()}


def _reference(row: tuple[Any, ...]) -> Reference:
    reference_id, monotonic_s, utc_s, real_s, source, degc, program, work_offset, power_on_count = row
    return Reference(
        reference_id=reference_id,
        time=Instant(monotonic_s=monotonic_s, utc_s=utc_s, real_s=real_s),
        source=source,
        degc=np.frombuffer(degc, dtype="<f8").astype(np.float64),
        program=program,
        work_offset=work_offset,
        power_on_count=power_on_count,
    )


def _probe(row: tuple[Any, ...]) -> ProbeSample:
    utc_ms, monotonic_ms, axis, deviation_um, applied_um, thermal_error_um, reference_id, accepted, reason = row
    return ProbeSample(
        time=Instant(monotonic_s=monotonic_ms / 1e3, utc_s=utc_ms / 1e3, real_s=monotonic_ms / 1e3),
        axis=axis,
        deviation_um=deviation_um,
        applied_um=np.nan if applied_um is None else applied_um,
        thermal_error_um=np.nan if thermal_error_um is None else thermal_error_um,
        reference_id=reference_id,
        accepted=bool(accepted),
        reason=reason,
    )
