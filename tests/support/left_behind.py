"""What a test has left open, told from what other tests of the same process have open or open meanwhile."""

import asyncio
import re
import threading
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

TIMES = 3


def descriptors() -> dict[int, str]:
    """Return what each open descriptor of this process leads to; both ends of a pseudo-terminal lead to its device."""
    found: dict[int, str] = {}
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target, info = str(entry.readlink()), Path("/proc/self/fdinfo", entry.name).read_text(encoding="ascii")
        except FileNotFoundError:
            continue  # that of the listing itself, or closed meanwhile
        far_end = re.search(r"^tty-index:\s*(\d+)$", info, re.MULTILINE)
        found[int(entry.name)] = f"/dev/pts/{far_end[1]}" if far_end else target
    return found


def held() -> set[str]:
    """Return each open descriptor and each thread, but for idle threads of asyncio's own pool."""
    threads = {f"thread {one.ident} {one.name}" for one in threading.enumerate() if not one.name.startswith("asyncio_")}
    return threads | {f"descriptor {number} of {target}" for number, target in descriptors().items()}


async def leaves_nothing_behind(once: Callable[[], Awaitable[object]], *, within_s: float = 0.0) -> None:
    """Fail when descriptors or threads are there after `once` that were not before it, each time.

    A thread of another test may open something meanwhile: what leaks, leaks every time.
    """
    for _ in range(TIMES):
        before = held()
        await once()
        begin_s = time.monotonic()
        while (left := held() - before) and time.monotonic() - begin_s < within_s:
            await asyncio.sleep(0.01)
        if not left:
            return
    raise AssertionError(f"left behind: {sorted(left)}")
