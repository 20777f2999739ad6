"""What a daemon claims of itself in a fault campaign, as the campaign's judges are told it."""

from typing import Any

from daemon.simulation.faults.invariants import Claims


def claims(state: str = "ACTIVE", **changes: Any) -> Claims:
    """A daemon in good order that compensates its one axis."""
    content: dict[str, Any] = {
        "state": state,
        "wanted": (True,),
        "reference": "r1",
        "link": True,
        "confidence": 1.0,
        "in_domain": True,
        "estimate_reference": "r1",
        "reason": "",
        "model": "m1",
    }
    return Claims(**(content | changes))
