"""Where the axes of the simulated machine stand, and how far their scales have grown there.

Only axes whose travel a configuration tells go anywhere: with every cut, and with every minute of a longer block, to
another place of their travel, there and back; work is positioned in the middle. The scale of an axis that is given a
slope is held in the middle of its travel and has another temperature at either end: it grows, and in no straight line.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from config.schema import Configuration
from drivers.guard.text import guard_axes
from drivers.sim.machine.heat import INDEX
from drivers.sim.nc.program import BlockKind
from drivers.sim.nc.wiring import AXES
from models.records import FloatArray

SHARES = (0.04, 0.27, 0.5, 0.73, 0.96, 0.73, 0.5, 0.27)
"""Places of the travel, in turn."""
STAY_S = 60.0
USUAL_MM_PER_S = 50.0
RAPID_SHARE = 0.5
"""An axis moves at most at this share of the rapid traverse that a configuration tells."""
EXPANSION_UM_PER_M_K = 11.5
ENDS = {"x": ("x_screw", "saddle_front"), "y": ("y_screw", "column_front"), "z": ("z_coupling", "ram_top")}
"""Nodes at the lowest and the highest position of each axis."""
SCALED_AT_DEGC = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisTravel:
    """Travel of an axis in machine coordinates."""

    lowest_mm: float
    highest_mm: float
    mm_per_s: float = USUAL_MM_PER_S
    grows: bool = True
    """Its scale grows."""

    def place_mm(self, share: float) -> float:
        """Return the position at a share of the travel [mm]."""
        return self.lowest_mm + share * (self.highest_mm - self.lowest_mm)


def axis_travels(configuration: Configuration) -> dict[str, AxisTravel]:
    """Return the travels of x, y and z that a configuration tells: of slopes, whose scales grow, and of positions."""
    compensation, found = configuration.compensation, {}
    letters = {name: axis.letter for name, axis in guard_axes(compensation.axes, configuration.cnc.guard).items()}
    ranges = {slope.of: slope.travel_mm for slope in compensation.slopes.values()}
    read = {one.axis: one for one in configuration.cnc.axis_positions.values()}
    for axis in AXES:
        position = read.get(letters.get(axis, axis.upper()))
        travel_mm = ranges.get(axis, None if position is None else position.travel_mm)
        if travel_mm is None:
            continue
        fastest = np.inf if position is None else RAPID_SHARE * position.rapid_mm_per_min / 60.0
        speed = min(USUAL_MM_PER_S, float(fastest))
        found[axis] = AxisTravel(lowest_mm=travel_mm[0], highest_mm=travel_mm[1], mm_per_s=speed, grows=axis in ranges)
    return found


class Travel:
    """Moves the axes with the blocks of a part program."""

    def __init__(self, travels: Mapping[str, AxisTravel]) -> None:
        self._travels = dict(travels)
        self._from = {axis: travel.place_mm(0.5) for axis, travel in self._travels.items()}
        self._begun_s, self._count, self._in_middle = 0.0, 0, True

    def enter(self, kind: BlockKind, time_s: float) -> None:
        """Begin a block: a cut is at the next place, work is positioned in the middle, all others begin here."""
        self._from = self.positions_mm(time_s)
        self._count += self._minutes(time_s) + (kind == "cut")
        self._in_middle = kind == "positioning" or (self._in_middle and kind != "cut")
        self._begun_s = time_s

    def _minutes(self, time_s: float) -> int:
        return int(max(time_s - self._begun_s, 0.0) // STAY_S)

    def positions_mm(self, time_s: float) -> dict[str, float]:
        """Return where each axis that travels stands at a time in this block [mm]."""
        minutes = self._minutes(time_s)
        since_s = time_s - self._begun_s - STAY_S * minutes
        found = {}
        for axis, travel in self._travels.items():
            before, now = (self._place_mm(travel, minutes - back) for back in (1, 0))
            start = self._from[axis] if minutes == 0 else before
            reach = travel.mm_per_s * since_s
            found[axis] = start + float(np.clip(now - start, -reach, reach))
        return found

    def _place_mm(self, travel: AxisTravel, minutes: int) -> float:
        share = 0.5 if self._in_middle and minutes <= 0 else SHARES[(self._count + minutes) % len(SHARES)]
        return travel.place_mm(share)

    def grown_um(self, degc: FloatArray, time_s: float) -> FloatArray:
        """Return by how much X, Y and Z are off where they stand, at temperatures of the nodes [um, degC]."""
        grown = np.zeros(len(AXES))
        for axis, mm in self.positions_mm(time_s).items():
            if not self._travels[axis].grows:
                continue
            travel, (low, high) = self._travels[axis], (float(degc[INDEX[node]]) for node in ENDS[axis])
            along_m = 1e-3 * (mm - travel.place_mm(0.5))
            per_m = (high - low) / (1e-3 * (travel.highest_mm - travel.lowest_mm))
            strain = (0.5 * (low + high) - SCALED_AT_DEGC) * along_m + 0.5 * per_m * along_m**2
            grown[AXES.index(axis)] = EXPANSION_UM_PER_M_K * strain
        return grown
