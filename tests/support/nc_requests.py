"""What an NC program does to ask the daemon for something, on the rig's control."""

from pathlib import Path

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
