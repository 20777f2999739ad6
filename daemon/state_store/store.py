"""Puts documents into the history's store and gets them back, whichever version wrote them."""

import json
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import structlog

from daemon.history.intake import Commit
from daemon.history.writer import HistoryWriter
from daemon.state_store.codec import DocumentError, from_json, to_json
from daemon.state_store.documents import (
    DaemonAlive,
    OutputFault,
    SensorLevelsDocument,
    SpindleSpeeds,
    SpindleSpeedSwitch,
    WantedAxes,
)
from daemon.state_store.from_0_1_0 import from_0_1_0
from drivers.clock import Clock
from models.control.reference_records import ReferenceDocument

log = structlog.get_logger(__name__)

FORMAT_VERSION = 2
"""Version of the documents; 0.1.0 wrote bare values without one."""
KEYS: dict[type, str] = {
    DaemonAlive: "alive_utc_s",
    WantedAxes: "wanted",
    OutputFault: "fault",
    ReferenceDocument: "reference",
    SensorLevelsDocument: "sensor_levels",
    SpindleSpeeds: "spindle_speed",
    SpindleSpeedSwitch: "spindle_speed_off",
}
"""Document -> its key in the table `state`."""
VERSION_KEY = "format_version"

Document = TypeVar("Document")


def document_json(document: Any) -> dict[str, Any]:
    """Return a document as it stands in the store."""
    return {VERSION_KEY: FORMAT_VERSION, **to_json(document)}


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
        return self._history.put_state(key, document, f'{{"{VERSION_KEY}": {FORMAT_VERSION}, {", ".join(texts)}}}')

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
        found = self._history.get_state(KEYS[kind])
        try:
            if _version_of(found) is None:
                read: Document | None = from_0_1_0(kind, self._history.get_state, self._clock.now())
                return read
            if _version_of(found) != FORMAT_VERSION:
                raise DocumentError(f"{VERSION_KEY} {_version_of(found)} is unknown")
            document: Document = from_json(kind, found, self._clock.now())
        except DocumentError as error:
            log.error("state.unreadable", key=KEYS[kind], problem=str(error))
            denying: Document | None = _denying(kind, str(error))
            return denying
        return document


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
