"""Reads from polls of the CNC where the program is, and what may have passed between two of them."""

from collections.abc import Collection
from dataclasses import replace

from models.control.reference_records import CncSeen, ReferenceRules
from models.records import CncRun, CncSample, Phase

IDLE = (CncRun.RESET, CncRun.STOP)
"""Run states in which no program runs."""
CLOCK_STEP_S = 1.0
"""The CNC's clock going back by more than this means that it was switched off [s]."""
CLOCK_GAP_REAL_S = 2.0
"""After a gap as long as this the CNC's clock is compared with ours [s of the wall clock]."""
CLOCK_DRIFT = 0.02
"""Share of the elapsed time by which two clocks may differ."""


def phase_of(sample: CncSample, safe_sequence_numbers: Collection[int], safe_flag: int | None = None) -> Phase:
    """Return what the machine is doing; everything that is not known to be harmless is cutting."""
    if sample.run in IDLE:
        return Phase.IDLE
    flagged = safe_flag is not None and sample.macros.get(safe_flag) == 1.0
    if sample.run is CncRun.START and (flagged or sample.sequence_number in safe_sequence_numbers):
        return Phase.SAFE_POINT
    return Phase.CUTTING


def in_part_program(
    previous: CncSample | None, polled: CncSample, guard_programs: Collection[int], guard_blocks: Collection[int]
) -> CncSample:
    """Return a poll as the part program stands in it: the guard's own programs and blocks are not the part's.

    A control that tells the main program's number tells the block of the one that it has called.
    """
    if previous is None or not (polled.program in guard_programs or polled.sequence_number in guard_blocks):
        return polled
    if polled.program not in guard_programs and polled.program != previous.program:
        return replace(polled, sequence_number=0)
    return replace(polled, program=previous.program, sequence_number=previous.sequence_number)


def positioning_passed(
    previous: CncSample | None, sample: CncSample, program: int | None, sequence_numbers: Collection[int]
) -> bool:
    """Whether the program has reached a positioning block since the previous sample, be it in a feed hold.

    One that stops there, as for a work that is clamped by hand, is positioned when it goes on, wherever that is seen.
    """
    if previous is None or sample.run in IDLE or (program is not None and sample.program != program):
        return False
    same, here = sample.program == previous.program, sample.sequence_number in sequence_numbers
    if previous.run in IDLE:
        return here or (same and previous.run is CncRun.STOP and previous.sequence_number in sequence_numbers)
    return here and not (same and sample.sequence_number == previous.sequence_number)


def power_cycled(previous: CncSample | None, sample: CncSample) -> bool:
    """Whether the control was switched off between two samples."""
    if previous is None:
        return False
    if sample.power_on_count != previous.power_on_count or sample.clock_s < previous.clock_s - CLOCK_STEP_S:
        return True
    if sample.time.real_s - previous.time.real_s < CLOCK_GAP_REAL_S:
        return False
    elapsed_s = sample.time.monotonic_s - previous.time.monotonic_s
    return clock_restarted(sample.clock_s - previous.clock_s, elapsed_s)


def clock_restarted(advance_s: float, elapsed_s: float) -> bool:
    """Whether the CNC's clock went on by less than the time that has passed here."""
    return advance_s < elapsed_s - max(2.0 * CLOCK_STEP_S, CLOCK_DRIFT * elapsed_s)


def stood_still_s(advance_s: float, elapsed_s: float) -> float:
    """Return for how long our clock stood while the CNC's went on [s], 0 where it did not.

    That is what a computer that slept, or a virtual one that was paused, leaves: its monotonic clock shows no gap.
    """
    stood_s = advance_s - elapsed_s
    return stood_s if stood_s > max(CLOCK_STEP_S, CLOCK_DRIFT * elapsed_s) else 0.0


def clocks_differ(advance_s: float, elapsed_s: float) -> bool:
    """Whether the CNC's clock went on by less or by more than the time that has passed here."""
    return abs(advance_s - elapsed_s) > max(2.0 * CLOCK_STEP_S, CLOCK_DRIFT * abs(elapsed_s))


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
