"""Axis positions as inputs of the thermal model: which are believed, their means, and how far training knows them."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from config.schema import Configuration
from daemon.estimation.inputs import NoPositions
from daemon.messages import SpindleSpeed
from drivers.contract import MM_PER_INCH
from models.align import RollingMean
from models.records import FloatArray
from models.thermal.family import ThermalModel
from models.thermal.positions import beyond_positions, trust_in_positions

SLACK_MM = 1.0
"""A position may lie outside its travel, or farther than the axis can have come, by so much."""
AGREEING = 2
"""So many values in a row that an axis cannot have reached are no slip of one value: the positions have changed."""
SAME_MM = 0.002
"""A position that is so nearly the one before in the other unit has not moved: the control's unit has changed."""


class AxisPositions(NoPositions):
    """What is known of the positions; owned by the thermal task. A value that is not believed changes nothing."""

    def __init__(self, configuration: Configuration) -> None:
        self._axes = configuration.cnc.axis_positions
        self.names = tuple(self._axes)
        self._stale_after_s = configuration.cnc.stale_after_s
        self._window_s = configuration.compensation.reference.mean_s
        self._mean = RollingMean(self._window_s)
        count = len(self.names)
        self._last_mm, self._last_s = np.full(count, np.nan), np.full(count, -np.inf)
        self._whole_s = np.full(count, -np.inf)
        self._unreachable = np.zeros(count, dtype=int)
        self._why = dict.fromkeys(self.names, "the control has given none yet")
        self._jumped: dict[str, str] = {}
        self.reference_mm: FloatArray = np.full(count, np.nan)
        """Where the axes stood when the reference was set [mm]."""

    def take(self, poll: SpindleSpeed) -> None:
        now_s = poll.monotonic_s
        believed = np.full(len(self.names), np.nan)
        for place, name in enumerate(self.names):
            mm = poll.positions_mm.get(name, np.nan)
            if why := self._not_believed(place, name, now_s, mm, poll.no_position):
                self._why[name] = why
                continue
            if now_s - self._last_s[place] > self._window_s / 2:
                self._whole_s[place] = now_s + self._window_s
            believed[place] = self._last_mm[place] = mm
            self._last_s[place] = now_s
            self._why[name] = "none has been read for longer than cnc.stale_after_s"
        self._mean.add(now_s, believed)

    def _not_believed(self, place: int, name: str, now_s: float, mm: float, lacking: str) -> str:
        """Return why a value does not count, '' when it does."""
        axis = self._axes[name]
        if not np.isfinite(mm):
            return lacking or "the control gives none now"
        lowest, highest = axis.travel_mm
        if not lowest - SLACK_MM <= mm <= highest + SLACK_MM:
            return (
                f"the control says {mm:.6g} mm, which is outside the travel of {lowest:g} to {highest:g} mm: see that "
                f"cnc.axis_positions.{name} has the right axis, unit and travel_mm"
            )
        reach_mm = SLACK_MM + axis.rapid_mm_per_min / 60.0 * max(now_s - self._last_s[place], 0.0)
        moved_mm = abs(mm - self._last_mm[place])
        per_unit = MM_PER_INCH if axis.unit == "mm" else 1.0 / MM_PER_INCH
        other_unit = moved_mm > SLACK_MM and abs(mm * per_unit - self._last_mm[place]) <= SAME_MM
        if np.isnan(moved_mm) or (moved_mm <= reach_mm and not other_unit):
            self._unreachable[place] = 0
            return ""
        self._unreachable[place] += 1
        why = f"it went from {self._last_mm[place]:.6g} to {mm:.6g} mm faster than the axis can"
        if other_unit:
            why = f"it went from {self._last_mm[place]:.6g} to {mm:.6g} mm, which is the same in another unit"
        if self._unreachable[place] >= AGREEING:
            self._jumped[name] = (
                f"{why}: see that the axis was referenced and its unit is right, then position the work again"
            )
        return why

    def believed(self, name: str, time_s: FloatArray, mm: FloatArray) -> FloatArray:
        """Return recorded positions of an axis without those outside its travel and those that it cannot have been at.

        The latter are those that lie farther from the one before, and from the next, than the axis gets.
        """
        axis = self._axes[name]
        lowest, highest = axis.travel_mm
        inside = np.flatnonzero((mm >= lowest - SLACK_MM) & (mm <= highest + SLACK_MM))
        reach_mm = SLACK_MM + axis.rapid_mm_per_min / 60.0 * np.diff(time_s[inside])
        jumps = np.abs(np.diff(mm[inside])) > reach_mm
        slips = (np.append(False, jumps) & np.append(jumps, False))[: len(inside)]
        found = np.full(len(mm), np.nan)
        found[inside[~slips]] = mm[inside[~slips]]
        return found

    def mean_mm(self, now_s: float) -> FloatArray:
        """Return the mean of each axis over the window [mm]; NaN where none has been believed for too long."""
        fresh = now_s - self._last_s <= self._stale_after_s
        return np.where(fresh, self._mean.mean(), np.nan) if fresh.any() else np.full(len(self.names), np.nan)

    def behind(self, degc: FloatArray, now_s: float) -> FloatArray:
        """Return the temperatures [degC], and behind them the positions in the mean [mm], NaN where not known."""
        return np.concatenate([degc, self.mean_mm(now_s)])

    def at_reference(self, degc: FloatArray) -> FloatArray:
        """Return the temperatures at the reference, and behind them the positions at it."""
        return np.concatenate([degc, self.reference_mm])

    def set_reference(self, now_s: float) -> dict[str, float]:
        """Count from where the axes stand now, and return that for a restart [mm].

        The means begin anew there: with where the axes came from in them, an axis that stands still would seem to move.
        An axis that has just jumped is nowhere until its next value is believed.
        """
        jumping = self._unreachable >= AGREEING
        self._last_s[jumping], self._last_mm[jumping], self._unreachable[jumping] = -np.inf, np.nan, 0
        self._jumped.clear()
        self._whole_s[:] = -np.inf
        self.reference_mm = np.where(now_s - self._last_s <= self._stale_after_s, self._last_mm, np.nan)
        self._mean = RollingMean(self._window_s)
        self._mean.add(now_s, self.reference_mm)
        known = zip(self.names, self.reference_mm.tolist(), strict=True)
        return {name: mm for name, mm in known if np.isfinite(mm)}

    def take_up(self, kept: Mapping[str, float]) -> None:
        """Count from where the axes stood at a reference of before."""
        self.reference_mm = np.array([kept.get(name, np.nan) for name in self.names])

    def unknown(self, model: ThermalModel, now_s: float) -> str:
        """Return which position that a model needs is not known, and why, '' when all are."""
        places = self._places(model)
        mean_mm = self.mean_mm(now_s)
        for name, place in zip(model.axis_positions, places, strict=True):
            if name in self._jumped or np.isnan(mean_mm[place]):
                return (
                    f"model {model.model_id} needs the position of axis {self._axes[name].axis} ({name}), which is "
                    f"not known: {self._jumped.get(name) or self._why[name]}"
                )
            if (left_s := self._whole_s[place] - now_s) > 0.0:
                return (
                    f"the position of axis {self._axes[name].axis} ({name}) is back, and model {model.model_id} "
                    f"follows its mean over {self._window_s:g} s, which is whole in {left_s:.0f} s"
                )
        return ""

    def trust(self, model: ThermalModel, now_s: float, imputed: Collection[int]) -> tuple[float, str]:
        """Return how far an estimate may be followed for what is known of the positions, 0..1, and why it is not."""
        if unknown := self.unknown(model, now_s):
            return 0.0, unknown
        places = self._places(model)
        mean_mm, then_mm = self.mean_mm(now_s)[places], self.reference_mm[places]
        if (lost := np.isnan(then_mm)).any():
            name = model.axis_positions[int(np.argmax(lost))]
            return 0.0, f"the position of {name} was not known at the reference: position the work again"
        ids = model.sensor_ids[len(model.sensor_ids) - len(places) :]
        if left_out := [name for name, i in zip(model.axis_positions, ids, strict=True) if i in imputed]:
            return 0.0, f"the position of {left_out[0]} was missing since the reference: position the work again"
        beyond = beyond_positions(model, mean_mm, then_mm)
        if (factor := float(trust_in_positions(beyond))) > 0.0:
            return factor, ""
        worst = int(np.argmax(beyond))
        return 0.0, (
            f"{model.axis_positions[worst]} is {mean_mm[worst]:.4g} mm in the mean, outside the positions at which "
            f"model {model.model_id} was trained: train it there too, or go on when the axis is back"
        )

    def _places(self, model: ThermalModel) -> Sequence[int]:
        return [self.names.index(name) for name in model.axis_positions]
