"""Documents as version 0.1.0 wrote them: bare values, brought to the form of now."""

from collections.abc import Callable
from typing import Any

from daemon.state_store.documents import DaemonAlive, OutputFault, SpindleSpeeds, SpindleSpeedSwitch, WantedAxes
from models.control.reference_records import ReferenceDocument

Old = Callable[[str], Any]
"""What 0.1.0 kept under a key; None where there is nothing."""


def from_0_1_0(kind: type, old: Old) -> Any:
    """Return a document in today's JSON values, None where 0.1.0 kept nothing; raises KeyError, TypeError."""
    return _READERS.get(kind, _nothing)(old)


def _nothing(_old: Old) -> Any:
    return None


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


def _reference(old: Old) -> Any:
    """Return one document from the six keys that held parts of the reference; parts of another one are left out."""
    valid, kept = old("reference"), old("kept_reference")
    found = valid or kept
    record = None if found is None else _record(found, old, valid=bool(valid))
    if found is None and old("cnc_seen") is None:
        return None
    return {
        "state": "none" if record is None else "valid" if valid else "ended",
        "record": record,
        "request_counter": (valid or {}).get("request_counter"),
        "seen": old("cnc_seen"),
    }


def _record(found: dict[str, Any], old: Old, *, valid: bool) -> dict[str, Any]:
    identity = found["reference_id"]
    rest, tool, sensors = old("rest"), old("tool"), old("since_reference")
    ours = rest is not None and identity == rest["reference_id" if valid else "error_reference_id"]
    names = ("reference_id", "source", "degc", "program", "work_offset", "power_on_count")
    return {
        "reference": {name: found[name] for name in names} | {"time": found["utc_s"]},
        "by_handshake": bool(found.get("by_handshake")),
        "baseline": _baseline(rest) if ours else None,
        "tool": tool if tool is not None and tool["reference_id"] == identity else None,
        "sensors": sensors if sensors is not None and sensors["reference_id"] == identity else None,
    }


def _baseline(rest: dict[str, Any]) -> dict[str, Any]:
    return {
        "axes": list(rest["baseline_um"]),
        "model_id": rest["model_id"],
        "baseline_um": list(rest["baseline_um"].values()),
        "offset_um": list(rest["offset_um"].values()),
        "weight": rest.get("weight"),
        "tools": rest.get("tools", {}),
    }


_READERS: dict[type, Callable[[Old], Any]] = {
    DaemonAlive: _alive,
    WantedAxes: _wanted,
    OutputFault: _fault,
    ReferenceDocument: _reference,
    SpindleSpeeds: _speeds,
    SpindleSpeedSwitch: _switch,
}
