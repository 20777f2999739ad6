"""Judges readings: whether they prove axis, sign and scale."""

import math
from collections.abc import Iterable, Mapping

from config.records.commissioning import PROOF_TOLERANCE, AxisReadings, CommissionedAxis
from daemon.commissioning.initialising import CommissioningRefusedError
from daemon.commissioning.readings import Moment, Reading

NOISE_SHARE = 0.1
"""Noise above this share of the offset drowns what shall be proved."""
UNMOVED_SHARE = PROOF_TOLERANCE
"""An axis that moves by less than this share of the offset has not moved."""
RETURN_SHARE = PROOF_TOLERANCE
"""Back at zero the instrument may differ from before by this share of the offset."""
LEAST_SCALE, LARGEST_SCALE = 0.2, 5.0
"""Scales that a person may accept; anything beyond is another unit."""
KNOWN_SCALES = (
    (25.4, "25.4: the value is taken for inches. Set the control to metric (G21), or set cnc.macros.unit_um"),
    (1 / 25.4, "1/25.4: the instrument reads inches, or the control divides by 25.4. Read in um, set G21"),
    (1000.0, "1000: the macros' unit is not what cnc.macros.unit_um says (mm there, um here)"),
    (0.001, "1/1000: the macros' unit is not what cnc.macros.unit_um says (um there, mm here)"),
    (10.0, "10: the control counts another increment system (IS-A, IS-B, IS-C), or the instrument another unit"),
    (0.1, "1/10: the control counts another increment system (IS-A, IS-B, IS-C), or the instrument another unit"),
    (2.0, "2: one side takes the value for a radius, the other for a diameter"),
    (0.5, "1/2: one side takes the value for a diameter, the other for a radius"),
)
"""Ratios of movement to offset that have a usual cause."""

Taken = Mapping[Moment, Mapping[str, Reading]]


class DisprovedError(CommissioningRefusedError):
    """An axis does not move as it is told to; what a record of before says of it may be wrong now."""

    def __init__(self, text: str, axis: str, ratio: float = math.nan, also_moved: Iterable[str] = ()) -> None:
        """`ratio` of the movement to what was written; NaN where it is not known, or axes are mixed up."""
        super().__init__(text)
        self.axis, self.ratio, self.also_moved = axis, ratio, tuple(also_moved)


def judge(
    axis: str, written_um: float, taken: Taken, *, accept_reversed: bool = False, accept_scale: bool = False
) -> CommissionedAxis:
    """Return the proof for one axis; raises CommissioningRefusedError saying what the readings show instead.

    `taken` holds per moment the readings of this axis and of all others that were observed.
    """
    readings = _readings(axis, taken)
    _refuse_noise(axis, written_um, taken)
    _refuse_no_return(axis, written_um, readings)
    others_um = {
        other: _moved_um(other, taken) for other in taken[Moment.AT_OFFSET] if other != axis and _complete(other, taken)
    }
    moved_um = readings.moved_um
    _refuse_wrong_axis(axis, written_um, moved_um, others_um)
    ratio = moved_um / written_um
    if ratio < 0 and not accept_reversed:
        raise DisprovedError(_reversed(axis, written_um, moved_um), axis, ratio)
    scale = abs(ratio)
    if abs(scale - 1.0) <= PROOF_TOLERANCE:
        scale = 1.0  # they agree; a reading of some micrometres does not know it better
    elif not accept_scale or not LEAST_SCALE <= scale <= LARGEST_SCALE:
        raise DisprovedError(_wrong_scale(axis, written_um, moved_um, scale), axis, ratio)
    return CommissionedAxis(
        sign=1 if ratio > 0 else -1,
        scale=round(scale, 3),
        written_um=written_um,
        measured_um=round(moved_um, 4),
        readings=readings,
        others_um={other: round(um, 4) for other, um in others_um.items()},
    )


def _readings(axis: str, taken: Taken) -> AxisReadings:
    before, at_offset, after = (taken[moment][axis] for moment in Moment)
    noise_um = [reading.noise_um for reading in (before, at_offset, after) if reading.noise_um is not None]
    return AxisReadings(
        source=before.source,
        before_um=round(before.um, 4),
        at_offset_um=round(at_offset.um, 4),
        after_um=round(after.um, 4),
        noise_um=round(max(noise_um), 4) if noise_um else None,
        samples=before.samples,
    )


def _complete(axis: str, taken: Taken) -> bool:
    return all(axis in taken[moment] for moment in Moment)


def _moved_um(axis: str, taken: Taken) -> float:
    before, at_offset, after = (taken[moment][axis].um for moment in Moment)
    return at_offset - 0.5 * (before + after)


def refuse_noise(axis: str, offset_um: float, reading: Reading) -> None:
    """Refuse a reading whose noise would hide the movement."""
    limit_um = NOISE_SHARE * abs(offset_um)
    if reading.noise_um is not None and reading.noise_um > limit_um:
        raise CommissioningRefusedError(
            f"axis {axis}: the {reading.source} scatters by {reading.noise_um:.2f} um, more than the "
            f"{limit_um:.2f} um (1/10 of the offset) that would let the movement be seen. Let the machine rest, "
            "check sensor and cable, take more samples of a quieter signal, or ask for a larger --offset-um"
        )


def _refuse_noise(axis: str, written_um: float, taken: Taken) -> None:
    for moment in Moment:
        refuse_noise(axis, written_um, taken[moment][axis])


def _refuse_no_return(axis: str, written_um: float, readings: AxisReadings) -> None:
    left_um = readings.after_um - readings.before_um
    if abs(left_um) > RETURN_SHARE * abs(written_um):
        raise CommissioningRefusedError(
            f"axis {axis}: back at zero the instrument shows {readings.after_um:.2f} um, before it showed "
            f"{readings.before_um:.2f} um. The machine drifts, the instrument has slipped, or the axis sticks: let the "
            "machine settle, clamp the instrument anew, and repeat"
        )


def _refuse_wrong_axis(axis: str, written_um: float, moved_um: float, others_um: Mapping[str, float]) -> None:
    limit_um = UNMOVED_SHARE * abs(written_um)
    moved = {other: um for other, um in others_um.items() if abs(um) > limit_um}
    words = " and ".join(f"axis {other} by {um:.2f} um" for other, um in moved.items())
    if abs(moved_um) <= limit_um:
        instead = f", {words} instead" if moved else ""
        advice = (
            "the axes are swapped: check cnc.macros.values and the order of compensation.axes against the guard"
            if moved
            else "look which axis moved (are two axes swapped in cnc.macros.values or in the guard?), whether the "
            "instrument touches, and whether the value is taken for a far larger unit (inch mode: 1/25.4)"
        )
        raise DisprovedError(
            f"axis {axis}: {written_um:g} um were commanded and applied by the guard's own account, and the instrument "
            f"moved by {moved_um:.2f} um{instead}. Nothing is proved: {advice}",
            axis,
            also_moved=moved,
        )
    if moved:
        raise DisprovedError(
            f"axis {axis}: it moved by {moved_um:.2f} um, but {words} moved as well, and must not. Check that the "
            "guard adds each value to one axis only, and that the instruments stand square to the axes",
            axis,
            also_moved=moved,
        )


def _reversed(axis: str, written_um: float, moved_um: float) -> str:
    return (
        f"axis {axis}: +{abs(written_um):g} um moved the tool point by {-abs(moved_um):.2f} um: the sign is wrong, "
        "and a compensation with the wrong sign doubles the error. First look at the instrument: jog the axis 0.01 mm "
        "in plus, and it must show plus (a moving table counts the other way round, because the tool point relative to "
        "the work is meant). If the instrument is right, correct the guard's sign, or, if this control is built that "
        f"way, repeat with --accept-reversed {axis}: the record then turns every value of this axis"
    )


def _wrong_scale(axis: str, written_um: float, moved_um: float, scale: float) -> str:
    near = [words for known, words in KNOWN_SCALES if abs(scale - known) <= PROOF_TOLERANCE * known]
    cause = f"That is nearly {near[0]}" if near else "No usual cause fits: check the instrument and cnc.macros.unit_um"
    accept = (
        f", or repeat with --accept-scale {axis} if the control is built that way"
        if LEAST_SCALE <= scale <= LARGEST_SCALE
        else ""
    )
    return (
        f"axis {axis}: {written_um:g} um moved the tool point by {moved_um:.2f} um, {scale:.3g} times as far; "
        f"{PROOF_TOLERANCE:.0%} are allowed. {cause}{accept}"
    )
