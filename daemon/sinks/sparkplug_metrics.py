"""Which metrics of Sparkplug a row of the history makes."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from daemon.sinks.outbox import Stream
from daemon.sinks.sparkplug_payload import DataType, Metric, Value
from models.quality import Quality
from models.records import WriteOutcome

UM, MM, DEGC, RPM = "um", "mm", "degC", "rpm"
Found = tuple[str, DataType, Value | None, str]
"""Name, type, value, unit."""
NUMBER, TEXT, FLAG, COUNT = DataType.DOUBLE, DataType.STRING, DataType.BOOLEAN, DataType.INT64
BAD_VALUE, STALE_VALUE = 0, 500
"""Values of the property `Quality`; without it a value is good."""
MAPPINGS = {
    "estimates": (
        ("thermal_error_um", "Thermal error", UM),
        ("band_um", "Band", UM),
        ("label_degc", "Temperature", DEGC),
    ),
    "writes": (
        ("requested_um", "Requested", UM),
        ("compensation_um", "Compensation", UM),
        ("applied_um", "Applied", UM),
    ),
    "displacements": (("um", "Displacement", UM),),
    "cnc": (("positions_mm", "CNC/Position", MM),),
}
"""Stream -> columns with a number per name, the folder of its metrics, unit."""
SINGLE: Mapping[str, tuple[tuple[str, str, DataType, str], ...]] = {
    "estimates": (
        ("confidence", "Estimate/Confidence", NUMBER, ""),
        ("in_domain", "Estimate/In domain", FLAG, ""),
        ("model_id", "Estimate/Model", TEXT, ""),
        ("reference_id", "Estimate/Reference", TEXT, ""),
    ),
    "writes": (
        ("state", "Output/State", TEXT, ""),
        ("reason", "Output/Reason", TEXT, ""),
        ("cause", "Output/Cause of the write", TEXT, ""),
        ("outcome", "Output/Outcome of the write", TEXT, ""),
    ),
    "cnc": (
        ("mode", "CNC/Mode", TEXT, ""),
        ("run", "CNC/Run", TEXT, ""),
        ("alarm", "CNC/Alarm", FLAG, ""),
        ("program", "CNC/Program", COUNT, ""),
        ("sequence_number", "CNC/Sequence number", COUNT, ""),
        ("spindle_speed_rpm", "CNC/Spindle speed", NUMBER, RPM),
        ("motor_temperature_degc", "CNC/Motor temperature", NUMBER, DEGC),
        ("tool_number", "CNC/Tool", COUNT, ""),
        ("work_offset", "CNC/Work offset", COUNT, ""),
    ),
    "events": (
        ("kind", "Event/Kind", TEXT, ""),
        ("text", "Event/Text", TEXT, ""),
        ("person", "Event/Person", TEXT, ""),
    ),
    "references": (("reference_id", "Reference/ID", TEXT, ""), ("source", "Reference/Source", TEXT, "")),
}
PROBE = (
    ("deviation_um", "Deviation", NUMBER, UM),
    ("applied_um", "Applied", NUMBER, UM),
    ("thermal_error_um", "Thermal error", NUMBER, UM),
    ("accepted", "Accepted", FLAG, ""),
    ("reason", "Reason", TEXT, ""),
)


def row_metrics(stream: Stream, row: tuple[Any, ...]) -> list[Metric]:
    """Return the metrics of a row, each with the row's time."""
    fields = dict(zip(stream.columns, row, strict=True))
    utc_ms: int = fields["utc_ms"]
    if stream.name == "temperatures":
        return list(_sensors(fields, utc_ms))
    found = _of_probe(fields) if stream.name == "probes" else _of_columns(stream.name, fields)
    return [
        Metric(name=name, datatype=kind, value=value, utc_ms=utc_ms, properties={"engUnit": unit} if unit else {})
        for name, kind, value, unit in found
    ]


def _sensors(fields: Mapping[str, Any], utc_ms: int) -> Iterator[Metric]:
    for number, degc, quality in zip(fields["sensor_ids"], fields["degc"], fields["quality"], strict=True):
        properties: dict[str, str | int] = {"engUnit": DEGC}
        if quality != Quality.GOOD:
            properties["Quality"] = STALE_VALUE if degc is None else BAD_VALUE
        name = f"Sensor/{number}"
        yield Metric(name=name, datatype=NUMBER, value=degc, utc_ms=utc_ms, properties=properties)


def _of_columns(stream: str, fields: Mapping[str, Any]) -> Iterator[Found]:
    for column, name, kind, unit in SINGLE.get(stream, ()):
        yield name, kind, _value(column, kind, fields[column]), unit
    for column, folder, unit in MAPPINGS.get(stream, ()):
        values: dict[str, float | None] = json.loads(fields[column]) if fields[column] else {}
        for key, number in values.items():
            yield f"{folder}/{key}", NUMBER, number, unit


def _of_probe(fields: Mapping[str, Any]) -> Iterator[Found]:
    for column, name, kind, unit in PROBE:
        yield f"Probe/{fields['axis']}/{name}", kind, _value(column, kind, fields[column]), unit


def _value(column: str, kind: DataType, value: Any) -> Value | None:
    if value is None:
        return None
    if column == "outcome":
        return WriteOutcome(value).name.lower()
    return bool(value) if kind is FLAG else value
