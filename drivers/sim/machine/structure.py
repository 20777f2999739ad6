"""Deformation of the simulated machine: where the tool point stands for a given temperature field.

Z chain, from the ram's clamp to the nose: ram, cast metal, housing, bearings, shaft; each grows
towards the work, which is the negative direction. The bearings add the axial shift of angular
contact bearings whose shaft is warmer than the housing, which saturates. The front cover hangs on
the cast metal beside this chain. Y and the inclination come from the difference between the upper
and the lower half of the cast metal and of the ram, and from the column. X is what the symmetric
design leaves. Shaft, bearings, test bar and tool carry no sensor, and the sensors on the other lumps
lie between them and read some air.
"""

from dataclasses import dataclass, replace

import numpy as np

from drivers.sim.machine.day import Day
from drivers.sim.machine.heat import INDEX, per_node
from models.records import FloatArray

CHANNELS = ("X", "Y1", "Y2", "Z1", "Z2", "Z3")
"""Displacement channels: test bar near the nose (Y1) and near its end (Y2, Z2, X), nose (Z1), front cover (Z3)."""
REFERENCE_DEGC = 20.0
"""Temperature at which the machine has its nominal shape [degC]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """Coefficients of the deformation. Those marked tuned were fitted to the published behaviour."""

    ram_um_per_k: float = 0.754
    """0.3 m of ram, CFRP and steel [um/K] (tuned)."""
    cast_um_per_k: float = 3.09
    """Cast metal in front of its seat [um/K] (tuned)."""
    cast_lower_share: float = 0.731
    """Share of the lower half of the cast metal, which is stiffer and carries the flange (tuned)."""
    housing_um_per_k: float = 0.174
    """Housing between cast metal and front bearings [um/K] (tuned)."""
    cover_um_per_k: float = 0.195
    """Front cover, 15 mm of steel [um/K] (tuned)."""
    shaft_um_per_k: float = 0.546
    """Shaft in front of the bearings, CFRP and steel [um/K] (tuned)."""
    bearing_um_per_k: float = 0.0722
    """Axial shift per kelvin of shaft over housing [um/K] (tuned)."""
    bearing_saturation_k: float = 40.0
    """Difference at which the shift per kelvin has halved [K] (chosen)."""
    bed_um_per_k: float = 0.5
    """Bed against column, seen at the tool point [um/K] (chosen)."""
    column_um_per_k: float = 0.6
    """Column's front in the same direction [um/K] (chosen)."""
    tilt_um_per_m_k: float = 12.1
    """Inclination per kelvin of lower over upper half of the cast metal [um/(m K)] (tuned)."""
    tilt_slip_k: float = 6.0
    """Difference at which the bolted joint of the ram starts to give [K] (chosen)."""
    ram_tilt_um_per_m_k: float = 3.64
    """Inclination per kelvin between the halves of the ram [um/(m K)] (tuned)."""
    column_tilt_um_per_m_k: float = 3.0
    """Inclination per kelvin of the column's front over its sides [um/(m K)] (chosen)."""
    ram_drop_um_per_k: float = 4.3
    """Growth between the guides and the spindle axis, 0.35 m hanging down [um/K] (tuned)."""
    arm_m: float = 0.5
    """From the pivot of the inclination to the spindle nose [m] (chosen)."""
    test_bar_m: float = 0.3
    """Length of the test bar [m] (chosen)."""
    lower_target_m: float = 0.05
    """Height of Y1 over the nose [m] (chosen)."""
    upper_target_m: float = 0.25
    """Height of Y2 over the nose [m] (chosen)."""
    steel_um_per_m_k: float = 11.0
    """Expansion of test bar and tool [um/(m K)]."""
    shank_share: float = 0.0432
    """Share of the length of bar or tool that has the nose's temperature (tuned)."""
    slider_sideways_um_per_k: float = 2.0
    """Half the slider's width, left against right [um/K] (chosen)."""
    saddle_sideways_um_per_k: float = 1.5
    """Half the saddle's width, left against right [um/K] (chosen)."""
    spindle_sideways_um_per_k: float = 0.1
    """What is not symmetric in the spindle unit [um/K] (chosen)."""

    @classmethod
    def on(cls, day: Day) -> "Structure":
        """Return the structure as it is on a day: clamping, preload and joints change its coefficients."""
        nominal = cls()
        return replace(
            nominal, **{name: getattr(nominal, name) * factor for name, factor in day.structure_factors.items()}
        )

    def nose_um(self, degc: FloatArray) -> FloatArray:
        """Return X, Y, Z of the spindle nose and the inclination [um, um, um, um/m] at `degc` [degC]."""
        warm = degc - REFERENCE_DEGC
        shaft_k = 0.6 * _of(warm, "shaft_front") + 0.4 * _of(warm, "nose")
        over_k = _of(warm, "shaft_front") - _of(warm, "housing_front")
        bearing_um = self.bearing_um_per_k * over_k / (1.0 + abs(over_k) / self.bearing_saturation_k)
        z_um = self._carrier_z_um(warm) - (
            self.housing_um_per_k * _of(warm, "housing_front") + self.shaft_um_per_k * shaft_k + bearing_um
        )
        tilt = self._tilt_um_per_m(warm)
        y_um = tilt * self.arm_m - self.ram_drop_um_per_k * 0.5 * (_of(warm, "ram_top") + _of(warm, "ram_bottom"))
        return np.array([self._sideways_um(warm), y_um, z_um, tilt])

    def displacement_um(self, degc: FloatArray) -> FloatArray:
        """Return the test bar's and the cover's displacement in the order of CHANNELS [um]."""
        x_um, y_um, z_um, tilt = self.nose_um(degc)
        warm = degc - REFERENCE_DEGC
        cover_um = self._carrier_z_um(warm) - self.cover_um_per_k * _of(warm, "front_cover")
        y1_um = y_um + tilt * self.lower_target_m
        y2_um = y_um + tilt * self.upper_target_m
        return np.array([x_um, y1_um, y2_um, z_um, z_um - self._bar_growth_um(warm), cover_um])

    def tool_point_um(self, degc: FloatArray, tool_length_m: float, tool_um_per_m_k: float) -> FloatArray:
        """Return X, Y, Z of the tip of a tool that stands `tool_length_m` [m] over the nose [um]."""
        x_um, y_um, z_um, tilt = self.nose_um(degc)
        warm = degc - REFERENCE_DEGC
        tool_k = (1.0 - self.shank_share) * _of(warm, "tool") + self.shank_share * _of(warm, "nose")
        growth_um = tool_um_per_m_k * tool_length_m * tool_k
        return np.array([x_um, y_um + tilt * tool_length_m, z_um - growth_um])

    def _bar_growth_um(self, warm: FloatArray) -> float:
        bar_k = (1.0 - self.shank_share) * _of(warm, "test_bar") + self.shank_share * _of(warm, "nose")
        return self.steel_um_per_m_k * self.test_bar_m * bar_k

    def _carrier_z_um(self, warm: FloatArray) -> float:
        ram_um = self.ram_um_per_k * 0.5 * (_of(warm, "ram_top") + _of(warm, "ram_bottom"))
        lower = self.cast_lower_share
        cast_um = self.cast_um_per_k * float(lower * (_CAST_LOWER @ warm) + (1.0 - lower) * (_CAST_UPPER @ warm))
        bed_um = self.bed_um_per_k * (_of(warm, "bed_left") + _of(warm, "bed_right")) / 2.0
        return bed_um - self.column_um_per_k * _of(warm, "column_front") - ram_um - cast_um

    def _tilt_um_per_m(self, warm: FloatArray) -> float:
        difference_k = float((_CAST_LOWER - _CAST_UPPER) @ warm)
        cast = self.tilt_um_per_m_k * self.tilt_slip_k * float(np.tanh(difference_k / self.tilt_slip_k))
        ram = self.ram_tilt_um_per_m_k * (_of(warm, "ram_bottom") - _of(warm, "ram_top"))
        sides_k = 0.5 * (_of(warm, "column_left") + _of(warm, "column_right"))
        return cast + ram - self.column_tilt_um_per_m_k * (_of(warm, "column_front") - sides_k)

    def _sideways_um(self, warm: FloatArray) -> float:
        slider_k = _of(warm, "slider_left") - _of(warm, "slider_right")
        saddle_k = _of(warm, "saddle_left") - _of(warm, "saddle_right")
        spindle_k = _of(warm, "housing_front") - _of(warm, "cast_front_top")
        return (
            self.slider_sideways_um_per_k * slider_k
            + self.saddle_sideways_um_per_k * saddle_k
            + self.spindle_sideways_um_per_k * spindle_k
        )


def _of(warm: FloatArray, name: str) -> float:
    return float(warm[INDEX[name]])


_AXIAL = {"rear": 0.1, "middle": 0.3, "front": 0.6}
_CAST_LOWER = per_node({f"cast_{where}_bottom": weight for where, weight in _AXIAL.items()})
_CAST_UPPER = per_node({f"cast_{where}_top": weight for where, weight in _AXIAL.items()})
