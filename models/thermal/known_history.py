"""What a model in use remembers from one sample to the next, and how much of the past of its lags it knows."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.features import BoolArray
from models.thermal.model import LinearParameters
from models.thermal.start import NORMAL_95, grown_unknown
from models.thermal.watch import WatchState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelState:
    """State of a model from one sample to the next."""

    time_min: float
    """Time of the latest sample [min], on the caller's clock."""
    degc: FloatArray
    """Latest known temperatures [degC], shape (n_sensors,)."""
    missing: npt.NDArray[np.bool_]
    """Which of them the latest sample did not hold."""
    known_min: FloatArray
    """When each sensor was last known [min], shape (n_sensors,)."""
    since_min: FloatArray
    """Since when each sensor has been known without a longer gap [min], shape (n_sensors,)."""
    unknown: FloatArray
    """Share of each lag, those of speed last, that nobody recorded, when temperature or speed was last known, 0..1."""
    unread: FloatArray
    """Share of each lag of speed that was not read in a gap, 0..1; of a machine at rest, and where it begins, none."""
    interval_min: float
    """How long the sample before it was ago [min]."""
    speed_rpm: float
    """Latest known spindle speed [1/min]."""
    speed_known_min: float
    lagged: FloatArray
    """Lags of temperatures [degC], shape (n_lags, n_sensors)."""
    known_lagged: FloatArray
    """Lags of each sensor when it was last known [degC], shape (n_lags, n_sensors)."""
    speed_lagged: FloatArray
    """Lags of the inputs from speed, shape (n_speed_lags, 2)."""
    watch: WatchState | None
    """Memory of the watch of the sensors; None when the model carries none."""


class KnownHistory:
    """What is unknown of a model's lags; pure in the state.

    `model`: the model. `bridge_min`: a longer interval without samples is a gap [min]. Spindle speed changes at
    once: of it one that is longer than two rows of the model, or than samples usually come in, is a gap.
    """

    def __init__(self, model: LinearParameters, bridge_min: float) -> None:
        layout = model.layout
        self._temperatures = layout.sensors - len(model.axis_positions)
        self._rest_is_known = not model.axis_positions  # where axes have dwelt shows in no temperature
        self._start = model.start
        self._band_um = model.band_um
        self._bridge_min = bridge_min
        self._speed_bridge_min = max(1.0, 2.5 * model.period_min)
        self.constants_min = np.array([*layout.lags_min, *layout.speed_lags_min])
        self.of_speed: BoolArray = np.arange(len(self.constants_min)) >= len(layout.lags_min)

    def at_first(self, degc: FloatArray, speed_rpm: float) -> FloatArray:
        """Return the share of each lag that is unknown at a first sample, shape (n_lags,)."""
        share = self._start.unknown_at_start(degc) if self._start is not None and self._rest_is_known else 1.0
        return np.where(self.of_speed & ~np.isfinite(speed_rpm), 1.0, share)

    def after(
        self, state: ModelState, time_min: float, degc: FloatArray, speed_known: bool
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the shares of each lag that are unknown and unread after a sample, and which lags begin anew for it.

        Result, of shape (n_lags,) each: after a silence of all sensors the lags of a machine that stands at rest tell
        more when they begin anew than when they go on through the gap.

        `state`: before it. `time_min`, `degc`: of the sample. `speed_known`: whether it holds spindle speed.
        """
        renewed = np.where(self.of_speed, speed_known, self._latest(np.where(np.isfinite(degc), 1.0, -np.inf)) > 0.0)
        unknown = np.where(renewed, self._unknown(state, time_min), state.unknown)
        share = self._at_rest(state, time_min, degc)
        rests = (share < unknown) & (~self.of_speed | speed_known) if share < 1.0 else np.zeros_like(self.of_speed)
        unread = self._unread(state, time_min) if speed_known else state.unread
        return np.where(rests, share, unknown), np.where(rests, 0.0, unread), rests

    def _at_rest(self, state: ModelState, time_min: float, degc: FloatArray) -> float:
        """Return what is unknown of lags that begin anew after a silence of all sensors; 1 where that is no choice."""
        latest_min = float(np.max(state.known_min))
        if self._start is None or not self._rest_is_known or time_min - latest_min <= self._bridge_min:
            return 1.0
        if np.isfinite(latest_min) and not np.isfinite(degc[state.known_min >= latest_min]).all():
            return 1.0
        return self._start.unknown_at_start(degc)

    def worth(self, state: ModelState) -> float:
        """Return what a reference now would be worth, 0..1."""
        return 0.0 if self._speed_is_gone(state) else self._known(self._unknown(state, state.time_min))

    def since(self, state: ModelState, reference: ModelState) -> tuple[float, FloatArray, float]:
        """Return how far the estimate since a reference may be followed, 0..1, and what it may be off by more.

        Result: also what widens its band, as the variance over the square of the band inside the domain, shape
        (n_channels,); by how much it may be off because spindle speed was not read, since the reference or shortly
        before it, of the worst channel [um].
        """
        then = self._unknown(reference, reference.time_min)
        left = then * np.exp(-max(state.time_min - reference.time_min, 0.0) / self.constants_min)
        now = self._unknown(state, state.time_min)
        later = np.sqrt(np.maximum(np.square(now) - np.square(left), 0.0))
        known = 0.0 if self._speed_is_gone(state) else self._known(then, later)
        none = np.zeros(len(self._band_um))
        if self._start is None or not len(self.constants_min):
            return known, none, 0.0
        unsure_um2 = NORMAL_95**2 * (self._start.variance_um2(then - left) + self._start.variance_um2(later))
        wider = np.divide(unsure_um2, np.square(self._band_um), out=none, where=self._band_um > 0.0)
        of_speed_um2 = self._start.variance_um2(np.where(self.of_speed, later, 0.0))
        of_speed_um2 += self._start.variance_um2(self._unread(reference, reference.time_min))
        return known, wider, NORMAL_95 * float(np.sqrt(of_speed_um2.max(initial=0.0)))

    def _speed_is_gone(self, state: ModelState) -> bool:
        """Whether spindle speed, which the model needs, is not known for longer than is bridged."""
        return bool(self.of_speed.any()) and state.time_min - state.speed_known_min > self._bridge_min

    def _known(self, *unknown: FloatArray) -> float:
        """Return how far an estimate may be followed of whose lags several shares are unknown, each for itself.

        A model that says nothing of that, of a version before, must have its lags filled.
        """
        if not len(self.constants_min):
            return 1.0
        if self._start is None:
            return float(np.clip(1.0 - max(share.max() for share in unknown), 0.0, 1.0))
        return self._start.known(np.sum([self._start.variance_um2(share) for share in unknown], axis=0))

    def _latest(self, known_min: FloatArray) -> float:
        """Return until when the past is known [min]: a temperature tells of all others, a position of itself alone."""
        count = self._temperatures
        return float(min(known_min[:count].max(initial=-np.inf), known_min[count:].min(initial=np.inf)))

    def _unknown(self, state: ModelState, time_min: float) -> FloatArray:
        """Return the share of each lag that is unknown at a time, shape (n_lags,)."""
        since_min = time_min - self._latest(state.known_min)
        of_degc = grown_unknown(state.unknown, since_min, self.constants_min, self._bridge_min)
        return np.where(self.of_speed, self._grown_by_speed(state.unknown, state, time_min), of_degc)

    def _unread(self, state: ModelState, time_min: float) -> FloatArray:
        """Return the share of each lag of speed that was not read in a gap, at a time, shape (n_lags,)."""
        return np.where(self.of_speed, self._grown_by_speed(state.unread, state, time_min), 0.0)

    def _grown_by_speed(self, share: FloatArray, state: ModelState, time_min: float) -> FloatArray:
        since_min = time_min - state.speed_known_min
        bridge_min = max(self._speed_bridge_min, 1.5 * state.interval_min)
        return grown_unknown(share, since_min, self.constants_min, bridge_min)
