"""Which metrics of Sparkplug a row of the history makes, and payloads of Sparkplug B 3.0: protobuf by field numbers."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

from daemon.sinks.outbox import Stream
from models.quality import Quality
from models.records import WriteOutcome

UM, MM, DEGC, RPM = "um", "mm", "degC", "rpm"


PACKAGE = "toolpoint.sparkplug"
TYPES = {"uint32": 13, "uint64": 4, "float": 2, "double": 1, "bool": 8, "string": 9, "bytes": 12}
"""Type -> its number in protobuf's description of fields; another word is a message."""
VALUES = ("int", "uint32"), ("long", "uint64"), ("float", "float"), ("double", "double"), ("boolean", "bool")
MESSAGES: Mapping[str, tuple[tuple[str, int, str], ...]] = {
    "PropertyValue": (
        *(("type", 1, "uint32"), ("is_null", 2, "bool")),
        *((f"{name}_value", 3 + at, kind) for at, (name, kind) in enumerate((*VALUES, ("string", "string")))),
    ),
    "PropertySet": (("keys", 1, "string*"), ("values", 2, "PropertyValue*")),
    "Metric": (
        *(("name", 1, "string"), ("alias", 2, "uint64"), ("timestamp", 3, "uint64"), ("datatype", 4, "uint32")),
        *(("is_historical", 5, "bool"), ("is_transient", 6, "bool"), ("is_null", 7, "bool")),
        ("properties", 9, "PropertySet"),
        *(
            (f"{name}_value", 10 + at, kind)
            for at, (name, kind) in enumerate((*VALUES, ("string", "string"), ("bytes", "bytes")))
        ),
    ),
    "Payload": (
        *(("timestamp", 1, "uint64"), ("metrics", 2, "Metric*"), ("seq", 3, "uint64")),
        *(("uuid", 4, "string"), ("body", 5, "bytes")),
    ),
}
"""Message -> name, number and type of its fields; * marks a repeated one. Values exclude each other."""
REPEATED, OPTIONAL, A_MESSAGE = 3, 1, 11
BITS = 1 << 64


class DataType(IntEnum):
    """What a metric's value is, of the types that are sent here."""

    INT32 = 3
    INT64 = 4
    DOUBLE = 10
    BOOLEAN = 11
    STRING = 12


FIELD_OF = {
    DataType.INT32: "int_value",
    DataType.INT64: "long_value",
    DataType.DOUBLE: "double_value",
    DataType.BOOLEAN: "boolean_value",
    DataType.STRING: "string_value",
}
Value = int | float | bool | str


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One named value at one time; None: there is none."""

    name: str
    datatype: DataType
    value: Value | None
    utc_ms: int
    historical: bool = False
    properties: Mapping[str, str | int] = field(default_factory=dict)
    """Texts and whole numbers that say more of it: its unit, its quality."""


def _payload_class() -> type[Any]:
    file = descriptor_pb2.FileDescriptorProto(name="toolpoint_sparkplug.proto", package=PACKAGE, syntax="proto2")
    for name, fields in MESSAGES.items():
        made = file.message_type.add(name=name)
        made.oneof_decl.add(name="value")
        for field_name, number, marked in fields:
            label, kind = REPEATED if marked.endswith("*") else OPTIONAL, marked.removesuffix("*")
            added = made.field.add(name=field_name, number=number, label=label, type=TYPES.get(kind, A_MESSAGE))
            if kind not in TYPES:
                added.type_name = f".{PACKAGE}.{kind}"
            if field_name.endswith("_value"):
                added.oneof_index = 0
        if not any(each.HasField("oneof_index") for each in made.field):
            del made.oneof_decl[:]
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    found: type[Any] = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.Payload"))
    return found


PAYLOAD = _payload_class()


def encode(metrics: Iterable[Metric], *, utc_ms: int, seq: int | None) -> bytes:
    """Return a payload; only that of an NDEATH has no `seq`."""
    payload = PAYLOAD(timestamp=utc_ms)
    if seq is not None:
        payload.seq = seq
    for each in metrics:
        added = payload.metrics.add(name=each.name, timestamp=each.utc_ms, datatype=each.datatype)
        if each.historical:
            added.is_historical = True
        for key, value in each.properties.items():
            added.properties.keys.append(key)
            if isinstance(value, str):
                added.properties.values.add(type=DataType.STRING, string_value=value)
            else:
                added.properties.values.add(type=DataType.INT32, int_value=value)
        if each.value is None:
            added.is_null = True
        elif each.datatype is DataType.INT64:
            added.long_value = int(each.value) % BITS
        elif each.datatype is DataType.INT32:
            added.int_value = int(each.value) % (1 << 32)
        else:
            setattr(added, FIELD_OF[each.datatype], each.value)
    content: bytes = payload.SerializeToString()
    return content


def asks_for_rebirth(content: bytes, name: str) -> bool:
    """Return whether a command sets this metric to true; what is no payload asks for nothing."""
    try:
        payload = PAYLOAD.FromString(content)
    except message.DecodeError:
        return False
    return any(each.name == name and each.boolean_value for each in payload.metrics)


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
