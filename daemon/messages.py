"""The thermal task: cycles in, cleansed temperatures and the estimate out.

One task owns the cleansing state, the one-minute means and the reference temperatures; whoever
wants something of it puts a message into `inbox`.
"""

from dataclasses import dataclass

from models.records import (
    Reference,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRequest:
    """Ask for a reference now, with what it is bound to."""

    reference_id: str
    source: str
    program: int
    work_offset: int
    power_on_count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRefused:
    """A reference that was asked for cannot be set."""

    reference_id: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRebased:
    """The reference in use, with which sensors that returned go on from where they were imputed."""

    reference: Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceEnded:
    """A reference is valid no longer."""

    reference_id: str
    for_good: bool = True
    """False: it is still estimated how far the machine has gone since, because tool settings count from it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleSpeed:
    """What a poll of the CNC said."""

    monotonic_s: float
    rpm: float
