"""Chatter beside the band that the tuning computes, which neither lobes nor verification see.

A mode there limits the depth of cut as one within the band does. Up to some depth no speed chatters by it; what is
deeper is refused.
"""

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.spindle_speed.tracked_tool_point import response_of_axes
from models.stability.lobes_zoa import depth_at_any_speed
from models.stability.milling import Cut
from models.stability.response import SampledResponse
from models.thermomechanics.tool_point import WIDE_HZ, ToolPointTracker

AROUND = 1.0 + np.linspace(-2e-3, 2e-3, 81)
"""Frequencies around each peak, as shares of it: narrow ones lie between the lines."""


class BesideTheBand:
    """Responses of a tool point outside the band, over the temperatures that its bearings were fitted to.

    `tracker`: has the band, and a spindle with tool per axis.
    """

    def __init__(self, tracker: ToolPointTracker) -> None:
        wide = {axis: each.receptances_at(WIDE_HZ) for axis, each in tracker.axes.items()}
        size = np.abs(np.array([every for found in wide.values() for every in found]))
        tops = ((size[:, 1:-1] > size[:, :-2]) & (size[:, 1:-1] >= size[:, 2:])).any(axis=0)
        lines = np.unique(np.concatenate((WIDE_HZ, np.outer(WIDE_HZ[1:-1][tops], AROUND).ravel())))
        self._band_hz: FloatArray = tracker.frequency_hz[[0, -1]]
        beside = lines[(lines < self._band_hz[0]) | (lines > self._band_hz[1])]
        found = {axis: each.receptances_at(beside) for axis, each in tracker.axes.items()}
        self._responses: list[SampledResponse] = [
            response_of_axes(beside, {axis: each[state] for axis, each in found.items()}) for state in range(3)
        ]

    def check(self, cut: Cut, feeds_deg: tuple[float, ...], depth_mm: float, highest_rpm: float) -> None:
        """Raise StabilityError when a cut may chatter beside the band.

        `cut`: engagement and coefficients. `feeds_deg`: directions of the feed against X [deg]. `depth_mm`: axial depth
        of cut [mm]. `highest_rpm`: highest speed that may be chosen [1/min].
        """
        limits = [
            (*depth_at_any_speed(each, cut, feeds_deg=feeds_deg, highest_rpm=highest_rpm), each)
            for each in self._responses
        ]
        limit_mm, at_hz, response = min(limits, key=lambda each: each[0])
        if depth_mm <= limit_mm:
            return
        um_per_n = 1e6 * np.abs(response.receptance[np.searchsorted(response.frequency_hz, at_hz)]).max()
        raise StabilityError(
            f"{self._band_hz[0]:.0f} to {self._band_hz[1]:.0f} Hz are computed, and at {at_hz:.0f} Hz beside "
            f"them the tool's response is {um_per_n:.2g} um/N: at {depth_mm:g} mm a cut may chatter there where "
            f"neither lobes nor verification look, and up to {limit_mm:.2g} mm no speed does; cut less deep"
        )
