"""Documents as version 0.1.0 wrote them: bare values, brought to the form of now."""

from collections.abc import Callable
from typing import Any

from daemon.state_store.codec import DocumentError, from_json
from daemon.state_store.documents import (
    DaemonAlive,
    OutputFault,
    SpindleSpeeds,
    SpindleSpeedSwitch,
    WantedAxes,
)
from models.records import Instant

Old = Callable[[str], Any]
"""What 0.1.0 kept under a key; None where there is nothing."""


def from_0_1_0(kind: type, old: Old, now: Instant) -> Any:
    """Return a document from what 0.1.0 kept, None where it kept nothing. Raises DocumentError."""
    try:
        found = _READERS[kind](old)
        return None if found is None else from_json(kind, found, now)
    except (KeyError, TypeError, AttributeError) as error:
        raise DocumentError(f"not as version 0.1.0 wrote it ({error!r})") from None


def _alive(old: Old) -> Any:
    return None if old("alive_utc_s") is None else {"utc_s": old("alive_utc_s")}


def _wanted(old: Old) -> Any:
    return None if old("wanted") is None else {"axes": old("wanted")}


def _fault(old: Old) -> Any:
    return {"reasons": [old("fault")]} if old("fault") is not None else None


def _speeds(old: Old) -> Any:
    return None if old("spindle_speed") is None else {"operations": old("spindle_speed")}


def _switch(old: Old) -> Any:
    return None if old("spindle_speed_off") is None else {"off_by": old("spindle_speed_off")}


_READERS: dict[type, Callable[[Old], Any]] = {
    DaemonAlive: _alive,
    WantedAxes: _wanted,
    OutputFault: _fault,
    SpindleSpeeds: _speeds,
    SpindleSpeedSwitch: _switch,
}
