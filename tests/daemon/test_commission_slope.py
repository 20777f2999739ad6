"""A slope is commissioned at two positions of its axis, on a simulated SINUMERIK over real OPC UA."""

import re
from pathlib import Path
from typing import Any

import pytest
from commissioning_bench import Bench, Person, serving

from daemon.commissioning.initialising import CommissioningRefusedError
from drivers.guard.text import GUARD_VERSION

SLOPE = {
    "estimate": "Z1_per_m",
    "absolute_bound_um": 60.0,
    "slew_um_per_min": 100.0,
    "step_um": 4.0,
    "slope": {"of": "z", "pivot_mm": 250.0, "travel_mm": [0.0, 500.0]},
}
AT_MM = (20.0, 480.0)


class Walking(Person):
    """Brings the axis to where it is asked for, and reads the instrument there."""

    def __init__(self, bench: Bench, factor: float = 1.0) -> None:
        super().__init__(bench)
        self.at_mm = 250.0
        self.factor = factor
        self.eyes = lambda axis: self.reading_um() if axis == "z" else bench.moved_um()[axis]

    def reading_um(self) -> float:
        """What the instrument shows where the axis stands: an unevenness of its own, and what the control moves."""
        control = self.bench.machine.guard.control
        offset_um = control.moved_mm("Z", control.pivots_mm[control.axis("Z")]) * 1000.0
        slope_um = control.moved_mm("Z", self.at_mm) * 1000.0 - offset_um
        return 3.0 * self.at_mm / 500.0 + offset_um + self.factor * slope_um

    async def confirm(self, question: str) -> bool:
        """Bring the axis there."""
        if found := re.search(r"stand at ([0-9.]+) mm", question):
            self.at_mm = float(found[1])
        return await super().confirm(question)


async def test_a_slope_is_proved_by_what_two_positions_show(tmp_path: Path) -> None:
    async with serving(tmp_path, "sinumerik", SLOPE) as bench:
        person = Walking(bench)
        plan: dict[str, Any] = {"axes": ("z_slope",), "positions": {"z_slope": AT_MM}, "offset_um": 4.0}
        record = await bench.commission(person, **plan)
        assert record is not None and record.guard_version == GUARD_VERSION
        proved = record.axes["z_slope"]
        assert (proved.sign, proved.scale) == (1, 1.0)
        assert proved.slope is not None and proved.slope.positions_mm == AT_MM
        assert proved.slope.of == "z" and proved.slope.pivot_mm == 250.0
        assert proved.written_um == pytest.approx(proved.measured_um) and proved.written_um >= 2.0
        assert proved.readings is not None and "z at 480 mm minus at 20 mm" in proved.readings.source
        assert bench.at_rest(), "everything is back at zero"
        bench.reset()
        with pytest.raises(CommissioningRefusedError, match="the sign is wrong"):
            await bench.commission(Walking(bench, -1.0), **plan)
        assert bench.at_rest()


class CallingThere(Person):
    """The same at a FANUC, whose guard puts the slope in for where the axis stands when it is called."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self.eyes = lambda axis: bench.moved_um()[axis]

    async def confirm(self, question: str) -> bool:
        """Bring the axis there, and call the guard once."""
        if found := re.search(r"stand at ([0-9.]+) mm", question):
            self.bench.machine.guard.control.positions_mm[2] = float(found[1])
            if "the guard called there" in question:
                self.bench.call_guard()
        return await super().confirm(question)


async def test_at_a_fanuc_the_guard_is_called_at_both_positions_until_the_slope_is_there(tmp_path: Path) -> None:
    async with serving(tmp_path, "opcua", SLOPE) as bench:
        person = CallingThere(bench)
        plan: dict[str, Any] = {"axes": ("z_slope",), "positions": {"z_slope": AT_MM}, "offset_um": 4.0}
        record = await bench.commission(person, **plan)
        assert record is not None
        proved = record.axes["z_slope"]
        assert proved.sign == 1 and proved.scale == pytest.approx(1.0, abs=0.03), "of increments of 0.1 um"
        assert proved.slope is not None and proved.slope.positions_mm == AT_MM
        assert "on its way to where the axis stands" in person.text_said
        assert bench.at_rest(), "everything is back at zero"
