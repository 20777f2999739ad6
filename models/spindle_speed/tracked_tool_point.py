"""The tool point of a spindle model whose bearings follow temperatures, as the tuning of the speed needs it."""

from collections.abc import Mapping, Sequence

import numpy as np

from models.records import FloatArray
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.stability.response import ComplexArray, SampledResponse
from models.thermomechanics.history import SignalMeans, TemperatureHistory
from models.thermomechanics.resonance import peaks
from models.thermomechanics.tool_point import (
    ENDS_STAND_HZ,
    AxisDynamics,
    RangeEnds,
    ToolPointDynamics,
    ToolPointTracker,
)

AXES = ("x", "y")
FAR_HZ = 20.0
"""A peak this far off after one step of a sensor is another one [Hz]."""
LEAST_SHARE = 0.5
"""At least this share of a signal's sensors must have a value: one that drifts must not stand for all."""


class TrackedToolPoint:
    """`ToolPointTracker` as a `ToolPointEstimator`.

    Raises ValueError when a signal has no sensors.

    `tracker`: renews the dynamics from the signals of its model. `labels`: signal -> indices into the machine's sensor
    order, whose mean it is; those of the tracker's model.
    """

    def __init__(self, tracker: ToolPointTracker, labels: Mapping[str, Sequence[int]]) -> None:
        signals = tracker.model.signals
        if missing := [signal for signal in signals if not labels.get(signal)]:
            raise ValueError(f"no sensor carries the label {', '.join(missing)}, which {tracker.model.model_id} needs")
        self._tracker = tracker
        self._places = {signal: np.asarray(labels[signal], dtype=np.intp) for signal in signals}
        self._means = SignalMeans([labels[signal] for signal in signals])
        self._history = TemperatureHistory(tracker.model.intervals_min)
        self.known: EstimatedToolPoint | None = None
        """The latest answer of `renew`."""
        self._ends: tuple[
            dict[str, float], tuple[tuple[RangeEnds, ...], ...], tuple[EstimatedToolPoint | None, ...]
        ] = ({}, (), ())

    def renew(self, time_s: float, degc: FloatArray) -> EstimatedToolPoint | None:
        """Return the dynamics at a reading of all sensors [degC], shape (n,); None before every sensor had a value.

        The mean of some of a signal's sensors is at another level than that of all, by which the model was fitted.
        """
        signals = self._means.renew(degc)
        signals[np.array(self._means.unheard()) > 0] = np.nan
        self._history.add(time_s, signals)
        dynamics = self._tracker.renew_from(time_s, signals)
        if dynamics is None:
            return None
        self.known = EstimatedToolPoint(
            response=response_of_axes(dynamics.frequency_hz, _receptances(dynamics)),
            resonance_hz=dynamics.resonance_hz,
            flagged_ends=self._flagged_ends(dynamics),
            inhibit="; ".join(each for each in (dynamics.inhibit, self._few(degc)) if each),
        )
        return self.known

    @property
    def waits(self) -> str:
        """Which signals wait for sensors that have had no value since the start, '' where none does."""
        counts = zip(self._places.items(), self._means.unheard(), strict=True)
        return "; ".join(
            f"{count} of {len(places)} sensors of {signal} have had no value since the start, so its level is not known"
            for (signal, places), count in counts
            if count
        )

    def _few(self, degc: FloatArray) -> str:
        """Return which signals stand on fewer than half of their sensors, '' where none does.

        One that has no value at all has a minute, as the tracker says.
        """
        few = []
        for signal, places in self._places.items():
            count = int(np.isfinite(degc[places]).sum())
            if 0 < count < LEAST_SHARE * len(places):
                few.append(f"only {count} of {len(places)} sensors of {signal} have a value, so it is not followed")
        return "; ".join(few)

    def stepped(self, step_k: float) -> dict[str, EstimatedToolPoint]:
        """Return, for each signal, the dynamics if it read one step [K] more now; nothing is kept.

        A reading that changes at once also changes the difference terms. Empty before `renew` has answered.
        """
        now, known = self._history.mean_degc(), self.known
        if now is None or known is None or not np.isfinite(now).all():
            return {}
        past = {minutes: self._history.mean_degc(minutes) for minutes in self._history.intervals_min}
        differences = {
            minutes: np.zeros(len(now)) if then is None or not np.isfinite(then).all() else now - then
            for minutes, then in past.items()
        }
        signals = self._tracker.model.signals
        return {
            signal: self._moved(known, now, differences, step_k * np.eye(len(now))[place])
            for place, signal in enumerate(signals)
        }

    def _moved(
        self, known: EstimatedToolPoint, degc: FloatArray, differences: Mapping[float, FloatArray], step_k: FloatArray
    ) -> EstimatedToolPoint:
        receptances, resonance_hz = {}, {}
        frequency_hz, names = self._tracker.frequency_hz, self._tracker.model.signals
        for axis, tracker in self._tracker.axes.items():
            columns = [names.index(signal) for signal in tracker.regression.signals]
            changes = {minutes: (change + step_k)[columns] for minutes, change in differences.items()}
            properties = tracker.regression.estimate((degc + step_k)[columns], changes)
            receptances[axis] = tracker.receptance(tracker.parameters(properties))
            found = [peak.frequency_hz for peak in peaks(frequency_hz, receptances[axis])]
            before_hz = known.resonance_hz[axis]
            distance_hz, nearest_hz = min(((abs(each - before_hz), each) for each in found), default=(0.0, before_hz))
            resonance_hz[axis] = nearest_hz if distance_hz < FAR_HZ else before_hz
        return EstimatedToolPoint(response=response_of_axes(frequency_hz, receptances), resonance_hz=resonance_hz)

    def _flagged_ends(self, dynamics: ToolPointDynamics) -> tuple[EstimatedToolPoint | None, ...]:
        """Return the responses at the ends; the same objects as long as neither resonances nor ends have changed."""
        ends = tuple(each.range_ends for each in dynamics.axes.values())
        resonance_hz, before, kept = self._ends
        moved = any(
            abs(now - resonance_hz.get(axis, np.inf)) > ENDS_STAND_HZ for axis, now in dynamics.resonance_hz.items()
        )
        if ends == before and not moved:
            return kept
        found = tuple(
            response for axis, each in dynamics.axes.items() for response in self._ends_of(dynamics, axis, each)
        )
        self._ends = (dynamics.resonance_hz, ends, found)
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
                    response = response_of_axes(dynamics.frequency_hz, {**_receptances(dynamics), axis: receptance})
                    found.append(
                        EstimatedToolPoint(response=response, resonance_hz={**dynamics.resonance_hz, axis: at_hz})
                    )
        return found


def _receptances(dynamics: ToolPointDynamics) -> dict[str, ComplexArray]:
    return {axis: each.receptance_m_per_n for axis, each in dynamics.axes.items()}


def response_of_axes(frequency_hz: FloatArray, receptances: Mapping[str, ComplexArray]) -> SampledResponse:
    """Return the matrix of receptances; an axis that is not modelled is rigid."""
    matrix = np.zeros((len(frequency_hz), 2, 2), dtype=np.complex128)
    for place, axis in enumerate(AXES):
        if axis in receptances:
            matrix[:, place, place] = receptances[axis]
    return SampledResponse(frequency_hz=frequency_hz, receptance=matrix)
