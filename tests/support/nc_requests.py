"""What an NC program does to ask the daemon for something, on the rig's control."""

from pathlib import Path

import pytest
from control_rig import Bench, Rig

from daemon.messages import ReferenceRequest

COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE = 520, 521, 522, 523, 524
REFERENCE, PROBE, TOOL_CHANGE = 1, 2, 3
Y_AXIS, Z_AXIS = 2, 3


def requesting_bench(directory: Path) -> Bench:
    """A bench whose request block is initialised."""
    bench = Bench(directory)
    for number in (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE):
        bench.nc.macros.set(number, 0.0)
    return bench


def zero_first(bench: Bench) -> Bench:
    """Let the offset be taken out at a retreat block before the work is positioned."""
    reference = bench.configuration.compensation.reference.model_copy(
        update={"policy": "zero_first", "retreat_sequence_numbers": [50]}
    )
    compensation = bench.configuration.compensation.model_copy(update={"reference": reference})
    bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})
    return bench


def ask(bench: Bench, counter: int, kind: int, axis: int = 0, value_mm: float = 0.0) -> None:
    """Write a request, the counter last."""
    for number, value in ((KIND, kind), (AXIS, axis), (VALUE, value_mm), (COUNTER, counter)):
        bench.nc.macros.set(number, float(value))


def answer(bench: Bench) -> float | None:
    """Return the answer that the program reads."""
    return bench.nc.macros.get(ACKNOWLEDGE)


def last_asked(rig: Rig) -> ReferenceRequest:
    """Return the latest reference that the thermal task was asked for."""
    return next(item for item in reversed(rig.asked) if isinstance(item, ReferenceRequest))


async def tool_2_set(rig: Rig, bench: Bench) -> None:
    """Set tool 2 with 8 um applied, then take tool 1, and let the machine go on by 4 um."""
    await rig.active(handshake=True)
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, TOOL_CHANGE, 0, 2.0)
    await rig.turn(rig.estimate(0.0, -8.0))
    ask(bench, 2, REFERENCE, Z_AXIS)
    await rig.follow(0.0, -8.0, 4)
    assert answer(bench) == 2.0
    ask(bench, 3, TOOL_CHANGE, 0, 1.0)
    await rig.follow(0.0, -12.0, 30)
    assert rig.applied["z"] == pytest.approx(12.0, abs=0.11)
