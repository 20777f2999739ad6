"""Checks the JSON of `toolpoint demo --headless` and of `toolpoint faults`: `check_demo.py DEMO FAULTS`."""

import json
import math
import sys
from pathlib import Path
from typing import Any

STATISTICS = ("mean", "p50", "p99", "max")
JUDGED_FROM_UM = 5.0


def missing_keys(result: dict[str, Any]) -> list[str]:
    """Return what the contract names and the result lacks."""
    wanted = {
        "cycles": ("expected", "received", "incomplete"),
        "writes": ("sent", "verified", "refused"),
        "latency_s": ("feedback", "total"),
        "estimates": (),
        "error_um": (),
    }
    problems = [f"{part} is missing" for part in wanted if part not in result]
    problems += [
        f"{part}.{key} is missing" for part, keys in wanted.items() for key in keys if key not in result.get(part, {})
    ]
    for part in ("feedback", "total"):
        given = result.get("latency_s", {}).get(part, {})
        problems += [f"latency_s.{part}.{key} is missing" for key in STATISTICS if key not in given]
    return problems


def failures(result: dict[str, Any]) -> list[str]:
    """Return every expectation that a run of 20 simulated minutes does not meet."""
    cycles, writes = result["cycles"], result["writes"]
    checks = {
        "cycles were expected": cycles["expected"] > 0,
        "every expected cycle arrived": cycles["received"] == cycles["expected"],
        "no cycle was incomplete": cycles["incomplete"] == 0,
        "there is an estimate for most cycles": result["estimates"] >= max(100, 0.5 * cycles["received"]),
        "more than a hundred blocks were written": writes["sent"] > 100,
        "every write was verified": writes["verified"] == writes["sent"],
        "no write was refused": writes["refused"] == 0,
        "z is judged": result["error_um"]["z"]["uncompensated_max"] > JUDGED_FROM_UM,
    }
    for part, latency in result["latency_s"].items():
        finite = all(math.isfinite(latency[key]) for key in STATISTICS)
        checks[f"the {part} delay has finite numbers in order"] = (
            finite and 0 < latency["p50"] <= latency["p99"] <= latency["max"] and latency["mean"] <= latency["max"]
        )
    for axis, error in result["error_um"].items():
        without, compensated = error["uncompensated_max"], error["compensated_max"]
        judged = without > JUDGED_FROM_UM and error.get("verdict") != "not_judged"
        checks[f"{axis} is at most half as wrong with compensation"] = not judged or compensated <= without / 2
    return [f"not so: {check}" for check, holds in checks.items() if not holds]


def campaign_failures(result: dict[str, Any]) -> list[str]:
    """Return every expectation that a quarter of a day of faults does not meet."""
    checks = {
        "a quarter of a day was played": abs(result["days"] - 0.25) < 0.001,
        "the seed is told": isinstance(result["seed"], int),
        "processor time is told": result["processor_s"] > 0,
        "cycles were acknowledged": result["acknowledged_cycles"] > 5000,
        "none of them is lost": result["acknowledged_cycles_lost"] == 0,
        "no invariant is violated": not any(count["violated"] for count in result["invariants"].values()),
        "most invariants were checked": sum(count["checked"] > 0 for count in result["invariants"].values()) > 30,
    }
    return [f"not so: {check}" for check, holds in checks.items() if not holds]


def main() -> int:
    """Print what is wrong and the errors per axis; return the exit status."""
    result, campaign = (json.loads(Path(path).read_text(encoding="utf-8")) for path in sys.argv[1:])
    problems = missing_keys(result) or failures(result)
    problems += campaign_failures(campaign)
    print(json.dumps(result, indent=2))
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
