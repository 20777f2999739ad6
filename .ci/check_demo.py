"""Checks the JSON that `toolpoint demo --headless --json` printed: `check_demo.py FILE`."""

import json
import sys
from pathlib import Path

KEYS = {
    "cycles": {"expected", "received", "incomplete"},
    "writes": {"sent", "verified", "refused"},
    "latency_s": {"feedback", "total"},
}


def main() -> int:
    result = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    problems = [
        f"{part} lacks {sorted(keys - set(result[part]))}" for part, keys in KEYS.items() if keys - set(result[part])
    ]
    for part in KEYS["latency_s"]:
        if set(result["latency_s"][part]) != {"mean", "p50", "p99", "max"}:
            problems.append(f"latency_s.{part} has the keys {sorted(result['latency_s'][part])}")
    if result["cycles"]["received"] != result["cycles"]["expected"] or result["cycles"]["incomplete"]:
        problems.append(f"cycles: {result['cycles']}")
    if (
        not result["estimates"]
        or not result["writes"]["sent"]
        or result["writes"]["verified"] != result["writes"]["sent"]
    ):
        problems.append(f"estimates {result['estimates']}, writes {result['writes']}")
    z = result["error_um"]["z"]
    if not z["uncompensated_max"] > 5 or not z["compensated_max"] <= z["uncompensated_max"] / 2:
        problems.append(f"z: {z}")
    for problem in problems:
        print(problem, file=sys.stderr)
    print(json.dumps(result["error_um"]))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
