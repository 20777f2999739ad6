"""Axes of the simulated machine that travel: where they stand, what their scales grow, what a slope does there."""

from pathlib import Path

import numpy as np
import pytest
from sloped_machine import PIVOT_MM, TRAVEL_MM, sloped

from config.schema import Configuration
from daemon.simulation.simulated_model import CHANNELS, simulated_recording
from daemon.simulation.simulation import simulated_day
from drivers.clock import SystemClock
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.machine.recording import record
from drivers.sim.machine.travel import SHARES, AxisTravel
from drivers.sim.nc.program import POSITIONING, demo_program


def day(configuration: Configuration) -> CfrpMachine:
    machine = simulated_day(configuration, SystemClock(), 1000).machine  # type: ignore[arg-type]
    assert isinstance(machine, CfrpMachine)
    return machine


def test_the_axis_goes_to_another_place_with_every_cut_and_the_control_tells_it(tmp_path: Path) -> None:
    machine, places, before = day(sloped(tmp_path)), set(), PIVOT_MM
    for second in range(1, 1200):
        machine.advance(float(second))
        position_mm = machine.nc.positions_mm["Z"]
        assert abs(position_mm - before) <= 50.0 + 1e-6, "at 3 m/min"
        if machine.nc.sequence_number == POSITIONING:
            assert second < 155 or position_mm == PIVOT_MM, "work is positioned in the middle"
        if machine.nc.sequence_number == 900 and position_mm == before:
            places.add(round(position_mm, 3))
        before = position_mm
    assert places == {round(500.0 * share, 3) for share in SHARES}
    assert machine.nc.positions_mm["X"] == machine.nc.positions_mm["Y"] == 0.0, "nothing is said of their travel"


def test_what_is_applied_as_a_slope_moves_the_tool_where_the_axis_stands(tmp_path: Path) -> None:
    machine = day(sloped(tmp_path))
    machine.advance(460.0)
    position_mm, before = machine.nc.positions_mm["Z"], machine.truth()["z"]
    assert abs(position_mm - PIVOT_MM) > 50.0
    read_um = machine.displacement_um()["Z1"]
    machine.guard.place(machine.nc.macros, {"z": 3.0, "z_slope": 40.0})
    moved_um = 3.0 + 40.0 * 1e-3 * (position_mm - PIVOT_MM)
    assert machine.truth()["z"].compensated_um - before.compensated_um == pytest.approx(moved_um, abs=0.01)
    assert machine.truth()["z"].uncompensated_um == before.uncompensated_um
    assert machine.displacement_um()["Z1"] - read_um == pytest.approx(moved_um, abs=0.01)


def test_a_day_without_travel_is_what_it_was_and_one_with_it_tells_the_slope(tmp_path: Path) -> None:
    sensors = sloped(tmp_path).temperatures.sensors
    travels = {"z": AxisTravel(lowest_mm=TRAVEL_MM[0], highest_mm=TRAVEL_MM[1])}
    header, still = record(Day.draw(3), demo_program(), sensors, hours=1.0)
    names, moving = record(Day.draw(3), demo_program(), sensors, hours=1.0, travels=travels)
    assert names == (*header, "Z_mm")
    same = [place for place, name in enumerate(header) if name[0] != "Z"]
    np.testing.assert_array_equal(still[:, same], moving[:, same])
    assert np.ptp(moving[:, -1]) == pytest.approx(0.92 * 500.0)
    recording = simulated_recording(3, demo_program(), sensors, hours=1.0, travels=travels, slopes={"Z1": PIVOT_MM})
    kept = tuple(name for name in CHANNELS if name[0] != "Z")
    assert recording.displacement_names == (*kept, "Z1", "Z1_per_m")
    assert recording.pivots_mm == {"Z1_per_m": PIVOT_MM}
    of_z1 = still[:, header.index("Z1")]
    offset_um, per_m = recording.displacements_um[:, -2:].T
    assert np.nanmax(np.abs(offset_um - of_z1)) < 0.25 * np.ptp(of_z1), "in the middle nothing has changed"
    assert np.nanmax(per_m) - np.nanmin(per_m) > 10.0
