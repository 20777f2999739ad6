"""Decides whether a positioning of the work may have been missed between two polls of the CNC."""

from models.control.program import IDLE
from models.control.reference_records import CncSeen, ReferenceRules
from models.records import CncSample


def seen_of(sample: CncSample, rules: ReferenceRules) -> CncSeen:
    """Return what of a poll tells later whether a positioning passed since."""
    counter = rules.positioning_counter
    return CncSeen(
        utc_s=sample.time.utc_s,
        clock_s=sample.clock_s,
        sequence_number=sample.sequence_number,
        idle=sample.run in IDLE,
        positioning_count=None if counter is None else sample.macros.get(counter),
    )


def may_be_missed(before: CncSeen, now: CncSeen, gap_s: float, rules: ReferenceRules, *, by_handshake: bool) -> str:
    """Return why a positioning may have passed in a gap, '' when that is excluded.

    It is where the program cannot have left the positioning block again, and where the handshake or the counter of
    positionings tells of every one. Standing idle at the same block before and after proves nothing: a whole program
    may have run in between.
    """
    if not rules.sequence_numbers or by_handshake or gap_s < rules.positioning_dwell_s:
        return ""
    counts = before.positioning_count, now.positioning_count
    if None not in counts and counts[0] == counts[1]:
        return ""
    return (
        f"the CNC could not be polled for {gap_s:.1f} s, so a positioning may have been missed; "
        "pass the positioning again or set the reference by hand (`toolpoint reference`)"
    )


def counted(
    before: CncSample | None, now: CncSample, ahead: int, rules: ReferenceRules, *, passed: bool
) -> tuple[int, str]:
    """Return how far the program's counter of positionings is ahead, and why the reference ends by it, '' if not.

    `ahead` is 1 where it was raised and its block not yet seen, -1 the other way round; `passed`: it is seen now.
    """
    why, number = "", rules.positioning_counter
    if number is not None and before is not None and before.macros.get(number) != now.macros.get(number):
        if ahead >= 0 and not passed:
            why = f"the work is positioned again: the program has raised #{number}, its counter of positionings"
        ahead = min(ahead + 1, 1)
    return max(ahead - passed, -1), why
