"""Names of back-ups in a folder, and which of them are a machine's."""

import json
import re
import zlib
from datetime import UTC, datetime
from pathlib import Path

SUFFIX = ".tar"
HEAD_BYTES = 4096
"""Of a back-up, in which its manifest says of which machine it is."""


def backup_name(machine: str, now: datetime) -> str:
    """Return the name that a back-up gets in a folder of back-ups."""
    return f"{_prefix(machine)}{now.astimezone(UTC):%Y%m%dT%H%M%SZ}{SUFFIX}"


def _prefix(machine: str) -> str:
    """Return how the names begin; a number tells apart what letters of other scripts, which are left out, would."""
    plain = re.sub(r"[^A-Za-z0-9]+", "-", machine).strip("-").lower() or "machine"
    return f"toolpoint-{plain}-" if machine.isascii() else f"toolpoint-{plain}-{zlib.crc32(machine.encode()):08x}-"


def existing_backups(folder: Path, machine: str) -> list[Path]:
    """Return the machine's back-ups in a folder, the oldest first; other files there are none of them."""
    form = re.compile(re.escape(_prefix(machine)) + r"\d{8}T\d{6}Z" + re.escape(SUFFIX))
    named = (path for path in folder.glob(f"*{SUFFIX}") if form.fullmatch(path.name))
    return sorted(path for path in named if _machine_in(path) in ("", machine))


def _machine_in(path: Path) -> str:
    """Return of which machine a back-up is, as DMU 50 and DMU 50+ have one name here; '' where it does not say."""
    try:
        with path.open("rb") as file:
            found = re.search(rb'"machine": ("(?:[^"\\]|\\.)*")', file.read(HEAD_BYTES))
        return "" if found is None else str(json.loads(found[1]))
    except (OSError, ValueError):
        return ""
