"""Puts documents into the history's store and gets them back, whichever version wrote them."""

import json
import math
import types
import zlib
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from enum import StrEnum
from functools import cache
from types import MappingProxyType
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import structlog

from daemon.history.intake import Commit
from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import (
    UNREADABLE,
    CalendarOfBoot,
    ControlRead,
    DaemonAlive,
    InOtherUnit,
    InputsRead,
    OutputFault,
    OwnOffsets,
    SensorLevelsDocument,
    SpindleSpeeds,
    SpindleSpeedSwitch,
    WantedAxes,
)
from drivers.clock import Clock
from models.control.reference_records import ReferenceDocument, ReferenceState
from models.json_values import plain
from models.records import Instant

log = structlog.get_logger(__name__)

FORMAT_VERSION = 2
"""Version of the documents; 0.1.0 wrote bare values without one."""
KEYS: dict[type, str] = {
    DaemonAlive: "alive_utc_s",
    CalendarOfBoot: "calendar",
    WantedAxes: "wanted",
    OutputFault: "fault",
    OwnOffsets: "own_offsets",
    ReferenceDocument: "reference",
    SensorLevelsDocument: "sensor_levels",
    InOtherUnit: "in_other_unit",
    InputsRead: "inputs_read",
    ControlRead: "control_read",
    SpindleSpeeds: "spindle_speed",
    SpindleSpeedSwitch: "spindle_speed_off",
}
"""Document -> its key in the table `state`."""
VERSION_KEY = "format_version"
CHECKSUM_KEY = "crc32"
"""Last member: CRC-32 of the document's text without it, so that one flipped bit of the disk is not a temperature."""

Document = TypeVar("Document")


PLAIN = (int, str, bool, type(None))
"""Types that are JSON values themselves."""


class DocumentError(ValueError):
    """A stored document is not what its record says; the text says where."""


def to_json(value: Any) -> Any:
    """Return a record as JSON values: NaN as null, an instant as its UTC [s]."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.dtype.kind != "f" or np.isfinite(value).all() else plain(value)
        return value
    if isinstance(value, Instant):
        return value.utc_s
    if isinstance(value, tuple | list):
        return [item if item.__class__ in PLAIN else to_json(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    return {field.name: to_json(getattr(value, field.name)) for field in fields(value)}


def from_json(kind: Any, value: Any, now: Instant) -> Any:
    """Return JSON values as what `kind` says, ages by the calendar clock; raises DocumentError."""
    origin, of = get_origin(kind), get_args(kind)
    if origin in (types.UnionType, Union):
        if value is None and type(None) in of:
            return None
        (kind,) = (arm for arm in of if arm is not type(None))
        return from_json(kind, value, now)
    if kind is Any:
        return value
    if kind is Instant:
        age_s = now.utc_s - _checked(value, (int, float))
        return Instant(monotonic_s=now.monotonic_s - age_s, utc_s=now.utc_s - age_s, real_s=now.real_s - age_s)
    if origin is np.ndarray:
        (element,) = get_args(of[1])
        plain = bool if element is np.bool_ else float
        return np.array([from_json(plain, item, now) for item in _checked(value, list)], dtype=element)
    if origin is tuple:
        return tuple(from_json(of[0], item, now) for item in _checked(value, list))
    if origin is not None and issubclass(origin, Mapping):
        items = _checked(value, dict).items()
        try:
            keys = [of[0](key) for key, _ in items]
        except ValueError as error:
            raise DocumentError(str(error)) from None
        return MappingProxyType({key: from_json(of[1], item, now) for key, (_, item) in zip(keys, items, strict=True)})
    if is_dataclass(kind):
        return _record(kind, _checked(value, dict), now)
    return _plain(kind, value)


def _plain(kind: Any, value: Any) -> Any:
    if kind is float:
        return math.nan if value is None else float(_checked(value, (int, float)))
    if issubclass(kind, StrEnum):
        try:
            return kind(value)
        except ValueError as error:
            raise DocumentError(str(error)) from None
    return _checked(value, kind)


def _record(kind: Any, found: dict[str, Any], now: Instant) -> Any:
    values = {}
    for field, of in zip(fields(kind), _annotations(kind), strict=True):
        if field.name in found:
            try:
                values[field.name] = from_json(of, found[field.name], now)
            except DocumentError as error:
                raise DocumentError(f"{field.name}: {error}") from None
        elif field.default is MISSING and field.default_factory is MISSING:
            raise DocumentError(f"{field.name} is missing")
    return kind(**values)


@cache
def _annotations(kind: Any) -> tuple[Any, ...]:
    hints = get_type_hints(kind)
    return tuple(hints[field.name] for field in fields(kind))


def _checked(value: Any, kind: Any) -> Any:
    """Return a value of this type; true and false are no numbers."""
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise DocumentError(f"{value!r} is not what is kept here")
    return value


def document_json(document: Any) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads(_checked_text(json.dumps({VERSION_KEY: FORMAT_VERSION, **to_json(document)})))
    return stored


def _checked_text(text: str) -> str:
    """Return a document's JSON text with its checksum."""
    return f'{text[:-1]}, "{CHECKSUM_KEY}": {zlib.crc32(text.encode())}}}'


class StateStore:
    """Typed documents over the history's table of keys and JSON values."""

    def __init__(self, history: HistoryWriter, clock: Clock) -> None:
        self._history = history
        self._clock = clock
        self._coded: dict[type, tuple[Any, str]] = {}
        """The latest record of each kind within a document, and its text."""

    def put(self, document: Any) -> Commit:
        key = KEYS[type(document)]
        texts = (f'"{field.name}": {self._text(getattr(document, field.name))}' for field in fields(document))
        text = f'{{"{VERSION_KEY}": {FORMAT_VERSION}, {", ".join(texts)}}}'
        return self._history.put_state(key, document, _checked_text(text))

    def _text(self, value: Any) -> str:
        """Return a member as JSON text; a record that is the very one of before is not coded anew."""
        if not is_dataclass(value):
            return json.dumps(to_json(value), allow_nan=False)
        record, text = self._coded.get(type(value), (None, ""))
        if record is not value:
            text = json.dumps(to_json(value), allow_nan=False)
            self._coded[type(value)] = value, text
        return text

    def get(self, kind: type[Document]) -> Document | None:
        """Return the document of this kind, None where none can be read; may be called before the history's start."""
        try:
            document = self._read(kind)
        except DocumentError as error:
            log.error("state.unreadable", key=KEYS[kind], problem=str(error))
            denying: Document | None = _denying(kind, str(error))
            return denying
        if isinstance(document, ReferenceDocument):
            try:
                self._read(SensorLevelsDocument)
            except DocumentError as error:  # without doubts and levels the temperatures of the reference say nothing
                why = f"what the sensors' levels count as cannot be read from the store ({error})"
                return replace(document, state=ReferenceState.NONE, record=None, ended=why)
        return document

    def _read(self, kind: type[Document]) -> Document | None:
        found = self._history.get_state(KEYS[kind])
        if _version_of(found) is None:
            from daemon.state_store.from_0_1_0 import from_0_1_0  # noqa: PLC0415 (only where version 0.1.0 was)

            try:
                old = from_0_1_0(kind, self._history.get_state)
                return None if old is None else cast(Document, from_json(kind, old, self._clock.now()))
            except (KeyError, TypeError, AttributeError) as error:
                raise DocumentError(f"not as version 0.1.0 wrote it ({error!r})") from None
        if _version_of(found) != FORMAT_VERSION:
            raise DocumentError(f"{VERSION_KEY} {_version_of(found)} is unknown")
        _refuse_changed(found)
        document: Document = from_json(kind, found, self._clock.now())
        return document


def _refuse_changed(found: dict[str, Any]) -> None:
    """Raise DocumentError when a document is not as it was written; one of an earlier version has no checksum."""
    written = found.pop(CHECKSUM_KEY, None)
    if written is not None and written != zlib.crc32(json.dumps(found).encode()):
        raise DocumentError("it does not match its checksum: the store is damaged")


def _version_of(found: Any) -> int | None:
    version = found.get(VERSION_KEY) if isinstance(found, dict) else None
    return version if isinstance(version, int) and not isinstance(version, bool) else None


def _denying(kind: type[Document], problem: str) -> Any:
    if kind is OutputFault:
        why = "whether a FAULT was latched cannot be read from the store"
        return OutputFault(reasons=(f"{why} ({problem}): compare the macro variables with the machine",))
    if kind is OwnOffsets:
        return OwnOffsets(mm={UNREADABLE: math.nan})
    if kind is SpindleSpeedSwitch:
        return SpindleSpeedSwitch(off_by="a start that could not read who had switched it off")
    if kind is SensorLevelsDocument:  # the history may hold what a sensor said while it was wrong: none of it counts
        return SensorLevelsDocument(
            sensor_ids=(), shift_k={}, uncertainty_k={}, left=(), changes=(), reads={0: problem}
        )
    return None
