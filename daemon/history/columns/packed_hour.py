"""Which rows make a packed hour, and the chunk that stands for them."""

from dataclasses import dataclass

from daemon.history.columns.frames import Kind
from daemon.history.columns.kinds import CYCLES, KINDS, TEMPERATURES, WRITES
from daemon.history.database import HOUR_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedHour:
    """One chunk, and which rows it stands for."""

    kind: str
    layout_id: int
    hour_ms: int
    start_ms: int
    end_ms: int
    row_count: int
    last_id: int
    data: bytes
    extremes: bytes
    chunk_id: int | None = None
    """An older chunk that only gets its extremes."""


def table_of(kind: str) -> tuple[str, str]:
    if kind == TEMPERATURES:
        return CYCLES.table, "id"
    return KINDS[kind].table, id_column(KINDS[kind])


def id_column(kind: Kind) -> str:
    """Return the name of a kind's primary key."""
    return "write_id" if kind is WRITES else "id"


def rows_of_hour(kind: str) -> str:
    """Return the condition for an hour's rows that may be packed: named parameters hour_ms, layout_id, last_id.

    An intent without an outcome stays a row until it is settled.
    """
    condition = f"utc_ms >= :hour_ms AND utc_ms < :hour_ms + {HOUR_MS} AND {table_of(kind)[1]} <= :last_id"
    if kind == TEMPERATURES:
        condition += " AND layout_id = :layout_id"
    if kind == WRITES.name:
        condition += " AND outcome != 0"
    return condition


def packing_cutoff_ms(now_utc_s: float, pack_after_s: float) -> int:
    """Return the end of the last whole hour that is old enough."""
    return int((now_utc_s - pack_after_s) * 1e3) // HOUR_MS * HOUR_MS
