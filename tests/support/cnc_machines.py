"""Machines of the random histories of a control: a mill, a lathe, and one whose Z error has a slope along the axis.

The tools of some expand; a slope is the control's own, or the guard puts it in for where the axis stands.
"""

import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from control_rig import Bench
from sloped_machine import FARTHEST_M, PIVOT_MM, SLOPE, Z, proved

from config.records.commissioning import CommissionedAxis
from config.schema.compensation import AxisConfig, CompensationConfig, ToolTermConfig
from drivers.sim.nc.custom_macro import MacroControl
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.nc.sinumerik import SinumerikControl

FACTORS = (1.0, 1.0, -1.0, 0.5)
"""Axes as they usually are, one that goes the other way, and one of diameters."""
TOOL = ToolTermConfig(length_mm=300.0, temperatures={"A": 1.0})
"""3.3 um per kelvin along Z."""
RETREATS = 50
"""N number of the block at which the offset is taken out, under the policy zero_first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """Axes of which something is compensated; of a slope um at one metre from its pivot."""

    places: Mapping[str, int]
    """Place of each on the control; a slope is at its axis' place."""
    numbers: Mapping[str, int]
    """Place of each among the axes of the configuration."""
    channels: tuple[str, ...]
    factors: Mapping[str, float]
    """How far the tool goes along the axis for an offset of 1: half of it where diameters are programmed."""
    grows_um_per_k: Mapping[str, float] = field(default_factory=dict)
    """By how much the tool in the spindle moves its point as it warms, by axis."""

    @property
    def offsets(self) -> list[str]:
        """Axes that take an offset."""
        return [axis for axis in self.places if not axis.endswith("_slope")]

    def register_um(self, guard: SafePointApplication, axis: str, slope_um: float = 0.0) -> float:
        """Return what the control's own register holds of an axis [um], of a slope [um/m].

        `slope_um`: how much of the offset a guard that was called away from the pivot has put in there for the slope.
        """
        place, control = self.places[axis], guard.control
        if axis in self.offsets:
            return 1000.0 * control.external_mm[place] - (slope_um * from_pivot_m(guard) if slope_um else 0.0)
        return 1e6 * control.slopes[place] if isinstance(control, SinumerikControl) else slope_um

    def commissioned(self) -> dict[str, CommissionedAxis]:
        """Return what a person has seen the axes do."""
        return {
            axis: (proved()[axis] if "z_slope" in self.places else PROVED).model_copy(
                update={
                    "sign": 1 if factor > 0 else -1,
                    "scale": abs(factor),
                    "measured_um": PROVED.written_um * factor,
                }
                if factor != 1.0
                else {}
            )
            for axis, factor in self.factors.items()
        }


PROVED = CommissionedAxis(sign=1, scale=1.0, written_um=10.0, measured_um=10.0)


def from_pivot_m(guard: SafePointApplication) -> float:
    """Return how far from the pivot of its slope Z stands, on a control without slopes [m]."""
    assert isinstance(guard.control, MacroControl)
    at_mm = guard.control.positions_mm[2]
    assert at_mm is not None
    return (at_mm - PIVOT_MM) / 1000.0


def some_machine(rng: random.Random, *, slopes: bool) -> Machine:
    """Return a machine; `slopes`: its control takes them."""
    kind = rng.choice(("mill", "mill", "lathe", "sloped" if slopes else "mill"))
    match kind:
        case "sloped":
            places, numbers = {"z": 2, "z_slope": 2}, {"z": 0, "z_slope": 1}
            return Machine(
                places=places, numbers=numbers, channels=("Z1", "Z1_per_m"), factors=dict.fromkeys(places, 1.0)
            )
        case "lathe":
            places = {"x": 0, "z": 1}
            factors = {"x": 0.5, "z": rng.choice(FACTORS)}
            return Machine(places=places, numbers=places, channels=("X1", "Z1"), factors=factors)
        case _:
            places = {"y": 1, "z": 2}
            factors = {axis: rng.choice(FACTORS) for axis in places}
            return Machine(places=places, numbers=places, channels=("Y1", "Z1"), factors=factors)


def bench_of(machine: Machine, directory: Path, **reference: Any) -> Bench:
    """Return a bench with such a machine; `reference`: what differs in the section of that name."""
    bench = Bench(directory)
    given = bench.configuration
    macros, axes = given.cnc.macros, dict(given.compensation.axes)
    if "y" not in machine.places:
        usual = axes["z"]
        ours: dict[str, dict[str, Any]] = {"z": dict(Z), "z_slope": dict(SLOPE)}
        axes = {
            axis: AxisConfig.model_validate(ours[axis])
            if "z_slope" in machine.places
            else usual.model_copy(update={"estimate": channel})
            for axis, channel in zip(machine.places, machine.channels, strict=True)
        }
        values, echoes = dict(zip(axes, (502, 503), strict=True)), dict(zip(axes, (512, 513), strict=True))
        macros = macros.model_copy(update={"values": values, "echo_applied": echoes})
    if "z" in machine.grows_um_per_k:
        tool = TOOL.model_copy(update={"direction": 1 if machine.grows_um_per_k["z"] > 0.0 else -1})
        axes["z"] = axes["z"].model_copy(update={"tool_term": tool})
    compensation = CompensationConfig(
        axes=axes,
        reference=given.compensation.reference.model_copy(update=reference),
        output=given.compensation.output,
    )
    cnc = given.cnc.model_copy(update={"macros": macros})
    bench.configuration = given.model_copy(update={"cnc": cnc, "compensation": compensation})
    return bench


def farthest_um(machine: Machine, gone: Mapping[str, float], axes: list[str]) -> float:
    """Return how far the tool has gone anywhere on its way along the worst of these axes [um]."""
    found = [abs(gone[axis]) for axis in axes if axis in machine.offsets]
    if {"z", "z_slope"} <= set(axes):
        found.append(abs(gone["z"]) + FARTHEST_M * abs(gone["z_slope"]))
    return max(found, default=0.0)
