"""The model of increments on line: temperatures now and at the reference, and nothing else."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import structlog

from daemon.estimation.online_model import Answer
from models.records import FloatArray, Reference
from models.thermal.estimate import linear_estimator
from models.thermal.model import ThermalModel
from models.thermal.rebase import rebased_reference_degc

log = structlog.get_logger(__name__)

SHOWN = 20
"""Sensors named in one line of the log."""


class IncrementsOnLine:
    """A telescoped model; lets sensors that return count on from where they were imputed."""

    def __init__(self, model: ThermalModel, position: Mapping[int, int], components: Sequence[str]) -> None:
        self.model = model
        self._order = np.array([position[i] for i in model.sensor_ids], dtype=np.intp)
        self._estimator = linear_estimator(model, tuple(components[i] for i in self._order))
        self._excluded: dict[int, str] = {}
        self._out = np.zeros(len(self._order), dtype=bool)

    @property
    def rebased(self) -> npt.NDArray[np.intp]:
        """All of the model's sensors."""
        return self._order

    @property
    def excluded(self) -> dict[int, str]:
        """What another model has excluded since the reference; this one finds nobody."""
        return self._excluded

    def prepare(self, now_s: float) -> None:
        """There are no states to fill."""

    def take(self, now_s: float, degc: FloatArray, speed_rpm: float) -> None:
        """There are no states to advance."""

    @property
    def kept(self) -> None:
        """Nothing: what returned sensors count from stands in the reference."""
        return None

    def refer(
        self,
        reference: Reference,
        now_s: float,
        excluded: Mapping[int, str] | None = None,
        kept: Mapping[str, Any] | None = None,
    ) -> None:
        """Count from this reference; sensors that are known to be wrong stay out until the next one."""
        self._excluded = dict(excluded or {})
        self._out = np.isin(self.model.sensor_ids, list(self._excluded))

    def estimate(
        self, reference: Reference, now_s: float, degc: FloatArray, absent: npt.NDArray[np.bool_]
    ) -> Answer | None:
        """Return the thermal error since the reference, which is re-based for sensors that have returned."""
        elapsed_min = max((now_s - reference.time.monotonic_s) / 60.0, 0.0)
        now = np.where(self._out, np.nan, degc[self._order])
        reference = self._rebased(reference, now, absent[self._order], elapsed_min)
        outcome = self._estimator.renew(now, reference.degc[self._order], elapsed_min)
        return None if outcome is None else (outcome, reference)

    def obstacle(self) -> str:
        """Increments can be followed at once."""
        return ""

    def _rebased(
        self, reference: Reference, now: FloatArray, absent: npt.NDArray[np.bool_], elapsed_min: float
    ) -> Reference:
        """Let a sensor that returns go on from where it was imputed, so that its return moves nothing."""
        then = reference.degc[self._order]
        back = np.isfinite(now) & (absent | ~np.isfinite(then))
        counted = rebased_reference_degc(self._estimator, now, then, back, elapsed_min)
        if counted is then:
            return reference
        at_reference = reference.degc.copy()
        at_reference[self._order] = counted
        ids = [self.model.sensor_ids[i] for i in np.flatnonzero(back)]
        log.info("reference.rebased", reference=reference.reference_id, sensors=ids[:SHOWN], count=len(ids))
        return replace(reference, degc=at_reference)
