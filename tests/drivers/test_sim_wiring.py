"""What is applied moves the tool point as the machine is wired, and the displacement sensors see it."""

import pytest
from shipped_machine import shipped_machine

from drivers.guard.check import block_check
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.program import standing_program
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.nc.wiring import STRAIGHT, Wiring

MACHINE = shipped_machine()
MACROS = MACHINE.cnc.macros


def standing(wiring: Wiring = STRAIGHT) -> CfrpMachine:
    return CfrpMachine(
        Day.draw(7, start="cold"),
        standing_program(),
        MACHINE.temperatures.sensors,
        SafePointApplication(MACROS, MACHINE.compensation.axes),
        wiring=wiring,
    )


def ask(machine: CfrpMachine, **um: float) -> None:
    """Put a valid block into the NC that enables every axis."""
    macros = machine.nc.macros
    for axis, number in MACROS.values.items():
        macros.set(number, um.get(axis, 0.0) / MACROS.unit_um)
    macros.set(MACROS.enable, 7.0)
    macros.set(MACROS.valid_until, machine.nc.clock_s + 60.0)
    macros.set(MACROS.sequence_a, 1.0)
    macros.set(MACROS.sequence_b, 1.0)
    held = {number: macros.get(number) for number in MACROS.block}
    macros.set(MACROS.check, block_check(MACROS, MACHINE.compensation.axes, held))


@pytest.mark.parametrize(
    ("wiring", "moved"),
    [
        (STRAIGHT, {"X": 0.0, "Y1": 0.0, "Z1": 4.0}),
        (Wiring(um_per_um={"z": {"z": -1.0}}), {"X": 0.0, "Y1": 0.0, "Z1": -4.0}),
        (Wiring(um_per_um={"z": {"y": 1.0}, "y": {"z": 1.0}}), {"X": 0.0, "Y1": 4.0, "Z1": 0.0}),
        (Wiring(um_per_um={"z": {"z": 25.4}}), {"X": 0.0, "Y1": 0.0, "Z1": 101.6}),
    ],
)
def test_the_sensors_see_what_the_compensation_does(wiring: Wiring, moved: dict[str, float]) -> None:
    left, compensated = standing(), standing(wiring)
    ask(compensated, z=4.0)
    for machine in (left, compensated):
        machine.advance(3.0)
    before, after = left.displacement_um(), compensated.displacement_um()
    assert {channel: after[channel] - before[channel] for channel in moved} == pytest.approx(moved, abs=1e-9)
