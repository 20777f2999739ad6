"""What a fault campaign found: as a record, as JSON, in words."""

import statistics
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from daemon.simulation.faults.invariants import Ledger
from daemon.simulation.faults.script import DAY_S


@dataclass(slots=True)
class Result:
    """What a campaign found."""

    days: float
    seed: int
    ledger: Ledger
    states_s: dict[str, float] = field(default_factory=dict)
    recovery_s: dict[str, list[float]] = field(default_factory=dict)
    acknowledged: int = 0
    lost: int = 0
    rss_growth_mib: float = 0.0
    rss_mib: float = 0.0
    lives: int = 0
    incidents: Counter[str] = field(default_factory=Counter)
    twin_um: float = 0.0
    """Farthest from the twin while no violation was found [um]."""
    cycles: int = 0
    blocks: int = 0
    wall_s: float = 0.0
    processor_s: float = 0.0
    """Of the campaign's process and the daemon's, models trained for it included [s]."""


def progress_line(result: Result, time_s: float, end_s: float, wall_s: float) -> str:
    shares = sorted(result.states_s.items(), key=lambda item: -item[1])
    states = ", ".join(f"{state} {100 * s / max(time_s, 1):.0f} %" for state, s in shares)
    return (
        f"day {time_s / DAY_S:.2f} of {end_s / DAY_S:g} after {wall_s:.0f} s: "
        f"{result.cycles} cycles, {result.blocks} blocks, {sum(result.incidents.values())} incidents, "
        f"{result.ledger.violations} violations, {result.rss_mib:.1f} MiB; {states}"
    )


def numbers(result: Result) -> dict[str, Any]:
    """Return the result as plain JSON values."""
    return {
        "days": round(result.days, 4),
        "seed": result.seed,
        "invariants": {
            name: {"checked": count.checked, "violated": count.violated} for name, count in result.ledger.counts.items()
        },
        "states_s": {state: round(seconds, 3) for state, seconds in sorted(result.states_s.items())},
        "recovery_s": {
            kind: {"p50": round(statistics.median(times), 3), "max": round(max(times), 3)}
            for kind, times in sorted(result.recovery_s.items())
        },
        "acknowledged_cycles": result.acknowledged,
        "acknowledged_cycles_lost": result.lost,
        "rss_growth_mib": round(result.rss_growth_mib, 3),
        "rss_mib": round(result.rss_mib, 1),
        "incidents": dict(sorted(result.incidents.items())),
        "cycles": result.cycles,
        "blocks": result.blocks,
        "lives": result.lives,
        "wall_s": round(result.wall_s, 1),
        "processor_s": round(result.processor_s, 1),
    }


def failures(result: Result) -> list[str]:
    """Return in words what did not hold."""
    found = [
        f"{name}: violated {count.violated} of {count.checked} times; {example}"
        for name, count in result.ledger.counts.items()
        if count.violated
        for example in (count.examples or [""])
    ]
    if result.lost:
        found.append(f"{result.lost} acknowledged cycles are lost")
    return found


def summary(result: Result) -> str:
    checked = sum(count.checked for count in result.ledger.counts.values())
    shares = ", ".join(f"{state} {seconds / 3600:.1f} h" for state, seconds in sorted(result.states_s.items()))
    slowest = max(((max(times), kind) for kind, times in result.recovery_s.items()), default=(0.0, "none"))
    return "\n".join(
        [
            f"{result.days:.4g} simulated days in {result.wall_s:.0f} s ({result.processor_s:.0f} s of processor "
            f"time), seed {result.seed}: "
            f"{sum(result.incidents.values())} incidents of {len(result.incidents)} kinds, "
            f"{result.lives} lives of the daemon, {result.cycles} cycles, {result.blocks} blocks",
            f"{checked} checks of {len(result.ledger.counts)} invariants, {result.ledger.violations} violations",
            f"{result.acknowledged} cycles acknowledged, {result.lost} lost",
            f"states: {shares}",
            f"slowest way back: {slowest[0]:.1f} s after the first good input ({slowest[1]})",
            f"memory: {result.rss_mib:.1f} MiB, grown by at most {result.rss_growth_mib:.2f} MiB in one life",
        ]
    )
