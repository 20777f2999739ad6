"""What a row of the table holds: runs, what was checked, what did not hold, what was lost, how long it took."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

PERCENTILES = (50, 90, 99, 100)


class Unavailable(Exception):
    """This computer cannot be brought into that hardship; the text says why."""


@dataclass(slots=True, kw_only=True)
class Row:
    """One kind of hardship."""

    name: str
    runs: int = 0
    checks: dict[str, int] = field(default_factory=dict)
    """What was checked -> how often."""
    violations: list[str] = field(default_factory=list)
    acknowledged: int = 0
    """Cycles that the daemon had acknowledged and that were looked for in the store."""
    lost: int = 0
    start_s: list[float] = field(default_factory=list)
    """From the start of the process to `daemon.ready`."""
    back_s: list[float] = field(default_factory=list)
    """From the end of the hardship until the output followed again, or said why not."""
    notes: dict[str, float] = field(default_factory=dict)
    skipped: str = ""
    interrupted: bool = False
    """A person wants no further run."""

    def rounds(self, count: int) -> Iterator[int]:
        """Yield the numbers of so many rounds, until a person wants no further one."""
        for k in range(count):
            if self.interrupted:
                return
            yield k

    def check(self, what: str, holds: bool, violation: object = "") -> bool:
        """Count a check; keep what was seen when it does not hold."""
        self.checks[what] = self.checks.get(what, 0) + 1
        if not holds:
            self.violations.append(f"run {self.runs}: not so: {what}" + (f" ({violation})" if violation else ""))
        return holds

    @contextlib.contextmanager
    def holds(self, what: str) -> Iterator[None]:
        """Count a check that asserts; an assertion that fails is a violation."""
        try:
            yield
        except AssertionError as error:
            self.check(what, False, str(error)[:500])
        else:
            self.check(what, True)

    def numbers(self) -> dict[str, Any]:
        """Return the row, ready for JSON."""
        return {
            "runs": self.runs,
            "checks": self.checks,
            "violations": self.violations,
            "acknowledged": self.acknowledged,
            "lost": self.lost,
            "start_s": percentiles(self.start_s),
            "back_s": percentiles(self.back_s),
            "notes": self.notes,
            "skipped": self.skipped,
        }


def percentiles(values: Sequence[float]) -> dict[str, float] | None:
    """Return p50, p90, p99 and p100; None without values."""
    if not values:
        return None
    return {f"p{p}": round(float(np.percentile(values, p)), 3) for p in PERCENTILES}


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a table of text."""
    lines = [
        f"{'hardship':<44} {'runs':>5} {'checks':>7} {'not so':>6} {'acknowledged':>12} {'lost':>5}"
        "  times [s]: p50 / p90 / p99 / longest"
    ]
    for row in rows:
        if row.skipped:
            lines.append(f"{row.name:<44} skipped: {row.skipped}")
            continue
        times = [_in_words("start", row.start_s), _in_words("back", row.back_s)]
        notes = [f"{name} {value:g}" for name, value in row.notes.items()]
        lines.append(
            f"{row.name:<44} {row.runs:>5} {sum(row.checks.values()):>7} {len(row.violations):>6} "
            f"{row.acknowledged:>12} {row.lost:>5}  {'; '.join(filter(None, [*times, *notes]))}"
        )
    return "\n".join(lines)


def _in_words(name: str, values: Sequence[float]) -> str:
    found = percentiles(values)
    return "" if found is None else f"{name} " + " / ".join(f"{found[f'p{p}']:.2f}" for p in PERCENTILES)
