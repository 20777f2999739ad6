"""Commissions a slope at two positions of its axis: it moves the reading at the second against that at the first."""

import math
from collections.abc import Awaitable, Callable, Mapping

from config.records.commissioning import LEAST_PROOF_UM
from config.schema.compensation import AxisConfig
from daemon.commissioning.dialogue import Dialogue
from daemon.commissioning.initialising import CommissioningRefusedError
from daemon.commissioning.readings import WORDS, Instruments, Moment, Reading

LEAST_SHARE = 0.5
"""The two positions lie at least so much of the travel apart."""
Positions = tuple[float, float]


async def positions_of(name: str, axis: AxisConfig, given: Mapping[str, Positions], dialogue: Dialogue) -> Positions:
    """Return the two machine positions [mm], as they were given beforehand or as a person says; refuses others."""
    slope = axis.slope
    assert slope is not None
    first, second = given.get(name, (math.nan, math.nan))
    if name not in given:
        for place in ("first", "second"):
            told = await dialogue.number(f"Machine position of {slope.of} at the {place} reading [mm]:")
            if told is None:
                raise CommissioningRefusedError(
                    f"axis {name}: a slope is proved at two positions of {slope.of}; say them, or give "
                    f"--position {name}=FIRST,SECOND"
                )
            first, second = (told, second) if place == "first" else (first, told)
    lowest, highest = slope.travel_mm
    if not all(lowest <= at <= highest for at in (first, second)):
        raise CommissioningRefusedError(
            f"axis {name}: {first:g} mm and {second:g} mm do not both lie in the travel of {slope.of} from {lowest:g} "
            f"to {highest:g} mm (compensation.axes.{name}.slope.travel_mm)"
        )
    if abs(second - first) < LEAST_SHARE * (highest - lowest):
        raise CommissioningRefusedError(
            f"axis {name}: {first:g} mm and {second:g} mm lie closer than half of the travel of {slope.of}: the ends "
            "of the travel show a slope best"
        )
    return first, second


def slope_to_write(name: str, axis: AxisConfig, offset_um: float, positions: Positions, increment_um: float) -> float:
    """Return the slope [um/m] that moves the second position by the offset against the first, in whole increments.

    Raises CommissioningRefusedError where that is too little to prove anything, or more than the slope's bound.
    """
    span_m = abs(positions[1] - positions[0]) / 1000.0
    um_per_m = math.copysign(math.floor(abs(offset_um) / span_m / increment_um + 1e-6) * increment_um, offset_um)
    if abs(um_per_m) > axis.absolute_bound_um:
        raise CommissioningRefusedError(
            f"axis {name}: {offset_um:g} um between {positions[0]:g} and {positions[1]:g} mm would be {um_per_m:g} "
            f"um/m, outside its bound of {axis.absolute_bound_um:g} um/m; choose a smaller --offset-um"
        )
    if abs(um_per_m) * span_m < LEAST_PROOF_UM:
        raise CommissioningRefusedError(
            f"axis {name}: {um_per_m:g} um/m move {abs(um_per_m) * span_m:.2g} um between {positions[0]:g} and "
            f"{positions[1]:g} mm, which proves nothing: at least {LEAST_PROOF_UM:g} um; choose a larger --offset-um"
        )
    return um_per_m


async def read_at(
    name: str,
    axis: AxisConfig,
    moment: Moment,
    positions: Positions,
    instruments: Instruments,
    dialogue: Dialogue,
    arrived: Callable[[], Awaitable[None]] | None = None,
) -> dict[str, Reading]:
    """Return the reading at the second position minus that at the first, a person having brought the axis there.

    `arrived` waits for a guard that has to be called at each position, because the slope counts for one place there.
    """
    slope = axis.slope
    assert slope is not None
    taken = []
    for at_mm in positions:
        called = " and was the guard called there" if arrived is not None and moment is Moment.AT_OFFSET else ""
        question = f"Does {slope.of} stand at {at_mm:g} mm (machine){called}, the instrument in place, {WORDS[moment]}?"
        if not await dialogue.confirm(question):
            raise CommissioningRefusedError(f"you said no to: {question}")
        if arrived is not None:
            await arrived()
        taken.append((await instruments.take(name, moment, (name,)))[name])
    first, second = taken
    noise_um = [reading.noise_um for reading in taken if reading.noise_um is not None]
    difference = Reading(
        um=second.um - first.um,
        source=f"{second.source}, {slope.of} at {positions[1]:g} mm minus at {positions[0]:g} mm",
        noise_um=math.hypot(*noise_um) if noise_um else None,
        samples=min(first.samples, second.samples),
    )
    return {name: difference}
