"""A model with lags on line: its states live from sample to sample, and are rebuilt from the history.

The states need no storage of their own: the store holds every temperature, and a rebuild over four
times the longest lag gives the same states as if the daemon had never been away. Only whom the watch
has excluded, and what sensors that returned count from, does not follow from the temperatures; that is
kept with the reference, and comes back with it.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import structlog

from daemon.estimation.online_model import Answer
from models.records import FloatArray, Reference
from models.thermal.lagged import LaggedEstimator, LagState
from models.thermal.lagged_model import LaggedModel
from models.thermal.lagged_rebase import LagReference, estimate_since, lag_reference, rebased, resumed, returning
from models.thermal.lagged_state import blamed_again, blamed_signs
from models.thermal.watch import MISSING

log = structlog.get_logger(__name__)

SETTLED = 0.999
"""From here on the states count as filled."""
SPARE_PERIODS = 2.0
"""A rebuild begins this many samples earlier than the states need."""
SHOWN = 20
"""Sensors named in one line of the log."""
LATE_PERIODS = 1.5
"""A reference older than this many samples is looked up in the history."""

Samples = Iterable[tuple[float, FloatArray, float]]
"""Time [s of the monotonic clock], temperatures in the machine's order [degC], spindle speed [1/min]."""


class LagsOnLine:
    """Advances the states once per sample of the training's period; estimates with every cycle."""

    def __init__(
        self, model: LaggedModel, position: Mapping[int, int], past: Callable[[float, float, float], Samples]
    ) -> None:
        self.model = model
        self._order = np.array([position[i] for i in model.sensor_ids], dtype=np.intp)
        self._estimator = LaggedEstimator(model)
        self._past = past
        self._period_s = model.period_min * 60.0
        self._state: LagState | None = None
        self._reference: LagReference | None = None
        self._reference_min = 0.0
        self._anew: set[int] = set()
        self._speed_rpm = float("nan")

    def prepare(self, now_s: float) -> None:
        """Fill the states from the history of the last hours."""
        self._state = self._rebuilt(now_s)
        filled = 0.0 if self._state is None else self._estimator.settled(self._state)
        log.info("lags.rebuilt", model=self.model.model_id, filled=round(filled, 3))

    def take(self, now_s: float, degc: FloatArray, speed_rpm: float) -> None:
        """Advance the states when a sample of the training's period is due."""
        self._speed_rpm = speed_rpm
        now = degc[self._order]
        if self._state is None:
            if np.isfinite(now).any():
                self._state = self._estimator.begin(now_s / 60.0, now, speed_rpm)
        elif now_s / 60.0 - self._state.time_min >= self.model.period_min:
            self._state = self._estimator.advance(self._state, now_s / 60.0, now, speed_rpm)

    def refer(
        self,
        reference: Reference,
        now_s: float,
        excluded: Mapping[int, str] | None = None,
        kept: Mapping[str, Any] | None = None,
    ) -> None:
        """Keep the states at the reference; those of a reference from before a restart come from the history."""
        then_s = reference.time.monotonic_s
        late = now_s - then_s > LATE_PERIODS * self._period_s
        state = self._rebuilt(then_s) if late else self._now(now_s, reference.degc[self._order])
        self._reference = None if state is None else lag_reference(self._estimator, state)
        self._reference_min, self._anew = then_s / 60.0, set()
        if excluded is None:
            self._readmit()
        elif self._state is not None:
            self._state = blamed_again(self.model, self._state, excluded)
        if kept is not None and kept["model_id"] == self.model.model_id:
            self._restore(kept)

    @property
    def rebased(self) -> npt.NDArray[np.intp]:
        """All of the model's sensors."""
        return self._order

    @property
    def excluded(self) -> dict[int, str]:
        """Whom the watch has excluded for what they said; who is silent counts again when he speaks."""
        signs = {} if self._state is None else blamed_signs(self.model, self._state)
        return {sensor_id: sign for sensor_id, sign in signs.items() if sign != MISSING}

    @property
    def kept(self) -> dict[str, Any] | None:
        """What the sensors that returned since the reference count from; None while none has."""
        if self._reference is None or not self._anew:
            return None
        then = self._reference.state
        return {
            "model_id": self.model.model_id,
            "reference_degc": {
                str(self.model.sensor_ids[i]): [float(then.degc[i]), *then.lagged[:, i].tolist()]
                for i in sorted(self._anew)
            },
            "shift_degc": self._reference.shift_degc.tolist(),
            "rest_um": self._reference.rest_um.tolist(),
            "rest_after_min": self._reference.rest_since_min - self._reference_min,
        }

    def estimate(
        self, reference: Reference, now_s: float, degc: FloatArray, absent: npt.NDArray[np.bool_]
    ) -> Answer | None:
        """Return the thermal error between the states now and at the reference."""
        state = self._now(now_s, degc[self._order])
        if state is None or self._reference is None:
            return None
        away = [int(i) for i in np.flatnonzero(absent[self._order])]
        if back := returning(self._estimator, state, self._reference, away):
            state = self._rebased(state, self._reference, back, reference)
        outcome = estimate_since(self._estimator, state, self._reference)
        return None if outcome is None else (outcome, reference)

    def obstacle(self) -> str:
        """Return how much history the states still need, or that spindle speed is missing."""
        filled = 0.0 if self._state is None else self._estimator.settled(self._state)
        if filled >= SETTLED:
            return ""
        needed_h = self._estimator.history_min / 60.0
        speed = " and spindle speed" if self.model.layout.speed_lags_min else ""
        return (
            f"the states of model {self.model.model_id} need {needed_h:.1f} h of temperatures{speed} without a longer "
            f"gap, and {filled * needed_h:.1f} h are there; wait, and leave the daemon running"
        )

    def _now(self, now_s: float, degc: FloatArray) -> LagState | None:
        if self._state is None:
            return None
        return self._estimator.advance(self._state, now_s / 60.0, degc, self._speed_rpm, blame=False)

    def _rebased(self, state: LagState, counted: LagReference, back: tuple[int, ...], reference: Reference) -> LagState:
        """Let sensors that return go on from where they were imputed, so that their return moves nothing."""
        found = rebased(self._estimator, state, counted, back)
        if found is None:
            return state
        self._state, self._reference = found
        self._anew |= set(back)
        ids = [self.model.sensor_ids[i] for i in back]
        log.info("reference.rebased", reference=reference.reference_id, sensors=ids[:SHOWN], count=len(ids))
        return self._state

    def _restore(self, kept: Mapping[str, Any]) -> None:
        """Let sensors that returned before a restart count from where they did."""
        if self._reference is None or self._state is None:
            return
        columns = {self.model.sensor_ids.index(int(i)): values for i, values in kept["reference_degc"].items()}
        counted = replace(
            self._reference,
            rest_um=np.array(kept["rest_um"]),
            shift_degc=np.array(kept["shift_degc"]),
            rest_since_min=self._reference_min + kept["rest_after_min"],
        )
        self._anew = set(columns)
        self._state, self._reference = resumed(self._estimator, self._state, counted, columns)

    def _readmit(self) -> None:
        """Let sensors that were blamed count again from a new reference on."""
        if self._state is not None and self._state.watch is not None and self._state.watch.excluded:
            log.info("sensors.readmitted", sensors=[self.model.sensor_ids[i] for i in self._state.watch.excluded])
            self._state = self._estimator.readmit(self._state, self._state.watch.excluded)

    def _rebuilt(self, until_s: float) -> LagState | None:
        span_s = self._estimator.history_min * 60.0 + SPARE_PERIODS * self._period_s
        samples = self._past(until_s - span_s, until_s, self._period_s)
        return self._estimator.rebuild((s / 60.0, degc[self._order], rpm) for s, degc, rpm in samples)
