"""Gives memory back that the process has freed."""

import ctypes


def give_memory_back() -> None:
    """Return freed memory to the system, where the C library keeps it and can be asked to (glibc)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
