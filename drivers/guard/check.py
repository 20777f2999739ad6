"""The check of the block: the number that the guard makes of what it has read, and the daemon of what it writes."""

import math
from collections.abc import Iterable, Mapping

from config.schema.cnc import MacroMapConfig

PER_SECOND = 10
"""valid_until counts to this part of a second."""


PIVOT_PER_MM = 10
"""The pivot of a slope counts to this part of a millimetre."""


def pivot_check(place: int, pivot_mm: float) -> int:
    """Return what the pivot of a slope adds to the check; `place` is that of its entry, counted from 1."""
    return place * round(pivot_mm * PIVOT_PER_MM)


def block_check(
    macros: MacroMapConfig,
    axes: Iterable[str],
    held: Mapping[int, float | None],
    pivots_mm: Mapping[str, float] | None = None,
) -> float:
    """Return the check that fits what these macros hold; what is vacant counts as 0, as in a custom macro.

    Every part is a whole number, and so is the sum: sequence number, enable bits, valid_until in tenths of a second,
    each value in nanometres times the place of its axis, counted from 1, with the pivot where it is a slope. Within the
    allowed bounds it stays below 1e8, which a custom macro of eight digits makes exactly.
    """

    def value(number: int) -> float:
        return held.get(number) or 0.0

    nm_per_unit = macros.unit_um * 1000.0
    total = value(macros.sequence_b) + value(macros.enable) + whole(value(macros.valid_until) * PER_SECOND)
    for place, axis in enumerate(axes, start=1):
        total += place * whole(value(macros.values[axis]) * nm_per_unit)
        if pivots_mm and axis in pivots_mm:
            total += pivot_check(place, pivots_mm[axis])
    return total


def whole(value: float) -> float:
    """Return the nearest whole number, halves away from 0, as ROUND does."""
    return math.copysign(math.floor(abs(value) + 0.5), value)
