"""Looks for known vulnerabilities in what the bundle brings along: `audit.py BILL_OF_MATERIALS`.

Asks the package index's advisories by `pip-audit`. Exit status 0 when every component was looked up and nothing is
known, or when no index of advisories can be reached, which is said; 1 when something is known.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

PATIENCE_S = 300


def judge(status: int, output: str, said: str, names: set[str]) -> tuple[int, str]:
    """Return exit status and sentence for what pip-audit returned and printed."""
    try:
        found: list[dict[str, Any]] = json.loads(output)["dependencies"]
    except (ValueError, KeyError):
        why = [str(status), *said.strip().splitlines()][-1]
        return 0, f"skipped: no index of advisories can be reached ({why})"
    known = [
        f"{one['name']} {one['version']}: {advisory['id']}, mended in {', '.join(advisory['fix_versions']) or '-'}"
        for one in found
        for advisory in one.get("vulns", ())
    ]
    if known:
        return 1, "\n".join(["known vulnerabilities:", *known])
    unasked = sorted(names - {one["name"] for one in found if "skip_reason" not in one})
    if unasked:
        return (
            0,
            f"skipped: the index knows no advisories of {len(unasked)} of {len(names)} components ({unasked[0]}, ..)",
        )
    return 0, f"{len(names)} components, no known vulnerability"


def main() -> int:
    """Audit the components of a bill; return the exit status."""
    content = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    components = [one for one in content["components"] if one["purl"].startswith("pkg:pypi/")]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("".join(f"{one['name']}=={one['version']}\n" for one in components))
        file.flush()
        command = [sys.executable, "-m", "pip_audit", "--requirement", file.name, "--no-deps", "--disable-pip"]
        try:
            done = subprocess.run(
                [*command, "--format", "json", "--progress-spinner", "off", "--timeout", "10"],
                capture_output=True,
                text=True,
                check=False,
                timeout=PATIENCE_S,
            )
            status, sentence = judge(done.returncode, done.stdout, done.stderr, {one["name"] for one in components})
        except subprocess.TimeoutExpired:
            status, sentence = 0, f"skipped: the index of advisories gave no answer within {PATIENCE_S} s"
    print(sentence)
    return status


if __name__ == "__main__":
    sys.exit(main())
