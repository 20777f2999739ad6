"""The heaps that the C library keeps in a process for its threads, beside the first one."""

from itertools import pairwise
from pathlib import Path

HEAP_BYTES = 64 << 20
"""glibc reserves so much for a thread's heap, at a multiple of it."""


def thread_heaps(pid: int | str) -> int:
    """Return how many there are: a writable begin of a reservation, the rest of which nobody may touch yet."""
    mappings = []
    for line in Path(f"/proc/{pid}/maps").read_text("ascii").splitlines():
        bounds, access, *_ = line.split()
        begin, end = (int(each, 16) for each in bounds.split("-"))
        mappings.append((begin, end, access))
    return sum(
        begin % HEAP_BYTES == 0 and access == "rw-p" and (end, begin + HEAP_BYTES, "---p") == after
        for (begin, end, access), after in pairwise(mappings)
    )
