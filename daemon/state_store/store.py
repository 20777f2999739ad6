"""Puts documents into the history's store and gets them back, whichever version wrote them."""

import json
import zlib
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import structlog

from daemon.history.intake import Commit
from daemon.history.writer import HistoryWriter
from daemon.state_store.codec import DocumentError, from_json, to_json
from daemon.state_store.documents import (
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
from daemon.state_store.from_0_1_0 import from_0_1_0
from drivers.clock import Clock
from models.control.reference_records import ReferenceDocument, ReferenceState

log = structlog.get_logger(__name__)

FORMAT_VERSION = 2
"""Version of the documents; 0.1.0 wrote bare values without one."""
KEYS: dict[type, str] = {
    DaemonAlive: "alive_utc_s",
    WantedAxes: "wanted",
    OutputFault: "fault",
    OwnOffsets: "own_offsets",
    ReferenceDocument: "reference",
    SensorLevelsDocument: "sensor_levels",
    InOtherUnit: "in_other_unit",
    InputsRead: "inputs_read",
    SpindleSpeeds: "spindle_speed",
    SpindleSpeedSwitch: "spindle_speed_off",
}
"""Document -> its key in the table `state`."""
VERSION_KEY = "format_version"
CHECKSUM_KEY = "crc32"
"""Last member: CRC-32 of the document's text without it, so that one flipped bit of the disk is not a temperature."""

Document = TypeVar("Document")


def document_json(document: Any) -> dict[str, Any]:
    """Return a document as it stands in the store."""
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
        """Keep a document for the next start of the daemon."""
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
        """Return the document of this kind, None where there is none; may be called before the history's start.

        One that cannot be read is none, but denies what it could have denied.
        """
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
            read: Document | None = from_0_1_0(kind, self._history.get_state, self._clock.now())
            return read
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
    if kind is SpindleSpeedSwitch:
        return SpindleSpeedSwitch(off_by="a start that could not read who had switched it off")
    return None
