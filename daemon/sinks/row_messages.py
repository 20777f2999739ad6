"""A row of the history as a JSON object with the key by which a repeat is known."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from daemon.sinks.outbox import Batch
from models.records import WriteOutcome

KEYS = {
    "temperatures": ("line", "utc_ms", "monotonic_ms", "number"),
    "estimates": ("line", "utc_ms", "monotonic_ms"),
    "writes": ("utc_ms", "write_id"),
    "cnc": ("utc_ms", "monotonic_ms"),
    "displacements": ("utc_ms", "source", "um"),
    "events": ("utc_ms", "monotonic_ms", "kind", "text"),
    "probes": ("utc_ms", "monotonic_ms", "axis"),
    "references": ("utc_ms", "reference_id"),
}
"""Stream -> the columns that, with machine and stream, no other row has: those of the tables in PostgreSQL."""
HASHED = ("text", "um")
"""Columns of which a key holds a hash."""
JSON_COLUMNS = frozenset(
    (
        *("faults", "thermal_error_um", "band_um", "label_degc", "label_reference_degc", "imputed", "requested_um"),
        *("compensation_um", "enable", "limits_hit", "macros", "read_back", "applied_um", "um", "reasons"),
        "positions_mm",
    )
)
"""Columns that are JSON already."""
CONVERSIONS: Mapping[str, Callable[[Any], Any]] = {
    **dict.fromkeys(("complete", "alarm", "in_domain", "accepted"), bool),
    "outcome": lambda code: WriteOutcome(code).name.lower(),
}


def row_messages(batch: Batch, machine: str) -> Iterator[bytes]:
    """Yield each row of a batch as JSON in UTF-8."""
    columns, name = batch.stream.columns, batch.stream.name
    head = f'"machine":{_json(machine)},"stream":{_json(name)}'
    in_key = [columns.index(column) for column in KEYS[name]]
    for row in batch.rows:
        key = "/".join(
            (machine, name, *(_short(column, row[at]) for column, at in zip(KEYS[name], in_key, strict=True)))
        )
        fields = (f'"{column}":{_field(column, value)}' for column, value in zip(columns, row, strict=True))
        yield f'{{"key":{_json(key)},{head},{",".join(fields)}}}'.encode()


def _short(column: str, value: Any) -> str:
    return hashlib.sha256(value.encode()).hexdigest()[:16] if column in HASHED else str(value)


def _field(column: str, value: Any) -> str:
    if value is None:
        return "null"
    if column in JSON_COLUMNS:
        return str(value)
    convert = CONVERSIONS.get(column)
    return _json(value if convert is None else convert(value))


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
