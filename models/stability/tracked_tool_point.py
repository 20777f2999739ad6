"""The tool point of a spindle model whose bearings follow temperatures, as the tuning of the speed wants it."""

from collections.abc import Mapping, Sequence

import numpy as np

from models.records import FloatArray
from models.stability.response import ComplexArray, SampledResponse
from models.stability.tool_point import EstimatedToolPoint
from models.thermomechanics.tool_point import ENDS_STAND_HZ, AxisDynamics, ToolPointDynamics, ToolPointTracker

AXES = ("x", "y")


class TrackedToolPoint:
    """`ToolPointTracker` as a `ToolPointEstimator`.

    Parameters
    ----------
    tracker
        Renews the dynamics from the signals of its model.
    labels
        Signal -> indices into the machine's sensor order, whose mean it is; those of the tracker's model.

    Raises
    ------
    ValueError
        When a signal has no sensors.

    """

    def __init__(self, tracker: ToolPointTracker, labels: Mapping[str, Sequence[int]]) -> None:
        signals = tracker.model.signals
        if missing := [signal for signal in signals if not labels.get(signal)]:
            raise ValueError(f"no sensor carries the label {', '.join(missing)}, which {tracker.model.model_id} needs")
        self._tracker = tracker
        self._indices = [np.array(labels[signal], dtype=np.intp) for signal in signals]
        self._ends: tuple[dict[str, float], tuple[str, ...], tuple[EstimatedToolPoint | None, ...]] = ({}, (), ())

    def renew(self, time_s: float, degc: FloatArray) -> EstimatedToolPoint | None:
        """Return the dynamics at a reading of all sensors [degC], shape (n,); None before every signal had a value."""
        dynamics = self._tracker.renew_from(time_s, np.array([_mean(degc[each]) for each in self._indices]))
        if dynamics is None:
            return None
        return EstimatedToolPoint(
            response=_response(dynamics, {}),
            resonance_hz=dynamics.resonance_hz,
            flagged_ends=self._flagged_ends(dynamics),
            doubt=dynamics.doubt,
        )

    def _flagged_ends(self, dynamics: ToolPointDynamics) -> tuple[EstimatedToolPoint | None, ...]:
        """Return the responses at the ends; the same objects as long as neither resonances nor flags have changed."""
        flags = tuple(f"{axis}.{name}" for axis, each in dynamics.axes.items() for name in each.flagged)
        resonance_hz, flagged, kept = self._ends
        moved = any(
            abs(now - resonance_hz.get(axis, np.inf)) > ENDS_STAND_HZ for axis, now in dynamics.resonance_hz.items()
        )
        if flags == flagged and not moved:
            return kept
        found = tuple(
            response for axis, each in dynamics.axes.items() for response in self._ends_of(dynamics, axis, each)
        )
        self._ends = (dynamics.resonance_hz, flags, found)
        return found

    def _ends_of(self, dynamics: ToolPointDynamics, axis: str, each: AxisDynamics) -> list[EstimatedToolPoint | None]:
        tracker = self._tracker.axes[axis]
        parameters = tracker.parameters(each.properties)
        bounds = {known.name: known.bounds for known in each.properties}
        found: list[EstimatedToolPoint | None] = []
        for ends in each.range_ends:
            bound = bounds[ends.name]
            for value, at_hz in ((bound.lowest, ends.at_lowest_hz), (bound.highest, ends.at_highest_hz)):
                if at_hz is None:
                    found.append(None)
                elif value != parameters[ends.name]:
                    receptance = tracker.receptance({**parameters, ends.name: value})
                    resonance_hz = {**dynamics.resonance_hz, axis: at_hz}
                    found.append(
                        EstimatedToolPoint(response=_response(dynamics, {axis: receptance}), resonance_hz=resonance_hz)
                    )
        return found


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _response(dynamics: ToolPointDynamics, instead: Mapping[str, ComplexArray]) -> SampledResponse:
    """Return the matrix of receptances; an axis that is not modelled is rigid."""
    matrix = np.zeros((len(dynamics.frequency_hz), 2, 2), dtype=np.complex128)
    for place, axis in enumerate(AXES):
        if axis in dynamics.axes:
            matrix[:, place, place] = instead.get(axis, dynamics.axes[axis].receptance_m_per_n)
    return SampledResponse(frequency_hz=dynamics.frequency_hz, receptance=matrix)
