"""The programs on the NC side: their text, filled in for one machine, and the sheet of their commissioning."""

from drivers.guard.text import (
    GUARD_VERSION,
    GuardPrograms,
    GuardStatus,
    GuardTextError,
    block_check,
    guard_axes,
    guard_digest,
    guard_program,
    guard_text,
)

__all__ = [
    "GUARD_VERSION",
    "GuardPrograms",
    "GuardStatus",
    "GuardTextError",
    "block_check",
    "guard_axes",
    "guard_digest",
    "guard_program",
    "guard_text",
]
