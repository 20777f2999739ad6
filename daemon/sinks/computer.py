"""Which computer this is: a copy of its disk holds the same store, and runs on other network cards."""

import functools
import hashlib
from contextlib import suppress
from pathlib import Path

CARDS = Path("/sys/class/net")
STARTED = Path("/proc/sys/kernel/random/boot_id")
"""For a computer without network cards of its own, such as a container: another number after each start."""


@functools.cache
def this_computer(cards: Path = CARDS, started: Path = STARTED) -> str:
    """Return a number that is the same over restarts and reveals no address; '' where nothing tells."""
    found = sorted({_read(each / "address") for each in cards.glob("*") if (each / "device").exists()} - {""})
    known = " ".join(found) or _read(started)
    return hashlib.sha256(known.encode()).hexdigest()[:16] if known else ""


def _read(path: Path) -> str:
    with suppress(OSError):
        return path.read_text("ascii").strip()
    return ""
