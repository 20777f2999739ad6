"""The thermal model in use: in the machine's order of sensors, on the daemon's clock, with the history behind it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import structlog

from daemon.snapshots import Contributions
from daemon.telemetry.metrics import give_memory_back
from models.records import FloatArray, Reference
from models.sensor_levels import OWN_K, Changes, SensorLevels
from models.thermal.estimation import Estimation, Machine, OnlineReference, Samples
from models.thermal.family import ThermalModel

log = structlog.get_logger(__name__)

SPARE_PERIODS = 2.0
"""A rebuild begins this many samples earlier than the states need."""
SHOWN = 20
"""Sensors named in one line of the log."""
PERIOD_S = 60.0
"""Time between the samples of a history where the model does not say [s]."""

History = Callable[[float, float, float], Iterable[tuple[float, FloatArray, float]]]
"""Between two times [s of the monotonic clock] and per period [s]: time, temperatures [degC], spindle speed [1/min]."""
Answer = tuple[Estimation, Reference]
"""The estimate, and the reference it counts from: another record when returned sensors were set anew."""


class ModelInUse:
    """One model in use, owned by the thermal task. Axis positions come behind the machine's temperatures."""

    def __init__(
        self,
        model: ThermalModel,
        sensor_ids: Sequence[int],
        machine: Machine,
        history: History,
        positions: Sequence[str] = (),
    ) -> None:
        self.model = model
        temperatures = model.sensor_ids[: len(model.sensor_ids) - len(model.axis_positions)]
        position = {sensor_id: index for index, sensor_id in enumerate(sensor_ids)}
        self.places: npt.NDArray[np.intp] = np.array([position[i] for i in temperatures], dtype=np.intp)
        """Of the model's sensors in the machine's order; they are set anew when they return."""
        behind = [len(sensor_ids) + list(positions).index(name) for name in model.axis_positions]
        self._inputs = np.array([*self.places, *behind], dtype=np.intp)
        self._online = model.runtime(machine)
        self._period_s = model.period_s or PERIOD_S
        self._history = history
        self.waits = "it was released just now"
        """Why it does not make the estimates yet, where another does; '' when nothing stands against it."""
        self._speed_known = True
        self._lags_right_s = -np.inf
        """Jumps until then are no more to be told from what a sensor had drifted."""
        give_memory_back()  # of reading the file and of preparing the model

    def prepare(self, now_s: float, wrong: Mapping[int, str]) -> None:
        """Fill states and watch from the history of the last hours; once, in a thread, before the first sample.

        `wrong`: sensors that had been found wrong (ID: sign), so that what it tells of them is not to stay.
        """
        if self._online.memory_min > 0.0:
            known_h: list[float] = []
            self._online.rebuild(self._noted(self._samples(now_s, self._online.memory_min), known_h), wrong)
            hours = {"known_h": round(sum(known_h), 2), "of_h": round(self._online.memory_min / 60.0, 2)}
            log.info("states.rebuilt", model=self.model.model_id, confidence=round(self._online.filled, 3), **hours)

    def _noted(self, samples: Samples, known_h: list[float]) -> Samples:
        """Yield samples, noting the hours of those in which a temperature of the model is known."""
        for time_min, degc, speed_rpm in samples:
            if np.isfinite(degc[: len(self.places)]).any():
                known_h.append(self._period_s / 3600.0)
            yield time_min, degc, speed_rpm

    def drifted_before(self, jumps: Changes, reference_s: float) -> bool:
        """Whether one of its sensors jumped before the reference, at which the model in use may have set its lags."""
        since_s = reference_s - self.memory_s
        return any(since_s < at_s <= reference_s and place in self.places for at_s, place, _ in jumps)

    @property
    def memory_s(self) -> float:
        """How far back it is filled from the history [s]."""
        return self._online.memory_min * 60.0

    def on_sample(self, now_s: float, degc: FloatArray, speed_rpm: float) -> None:
        """Take the means of the last minute: temperatures [degC] and spindle speed [1/min], NaN where unknown."""
        self._speed_known = bool(np.isfinite(speed_rpm))
        self._online.on_sample(now_s / 60.0, degc[self._inputs], speed_rpm)

    def jumped(self, jump_k: FloatArray) -> None:
        """Take that sensors have jumped, in the machine's order [K]: what is remembered of them is at their new level.

        So a level that is wrong for a while leaves nothing behind in the lags, and neither does one that stays.
        """
        self._online.jumped(self._of_inputs(jump_k))

    def _of_inputs(self, of_sensors_k: FloatArray) -> FloatArray:
        """Return differences of temperature in the model's order [K], 0 for axis positions."""
        of_inputs_k = np.zeros(len(self._inputs))
        of_inputs_k[: len(self.places)] = of_sensors_k[self.places]
        return of_inputs_k

    def set_reference(
        self,
        reference: Reference,
        now_s: float,
        excluded: Mapping[int, str] | None = None,
        kept: Mapping[str, Any] | None = None,
        inputs: FloatArray | None = None,
        levels: SensorLevels | None = None,
    ) -> None:
        """Count from this reference from now on; `inputs`: its temperatures with the axis positions behind them.

        A new one admits every sensor. One that is taken up again comes with the sensors that were `excluded`
        since (ID: sign) and with what a model has `kept`, this one or another; it may be read up in the
        history, which takes its time: call it in a thread then.
        """
        then_s, jumped_k = reference.time.monotonic_s, np.zeros(len(self._inputs))
        if excluded is None:
            lags_right_s, self._lags_right_s = max(self._lags_right_s, now_s - self.memory_s), now_s
            for at_s, place, jump_k in () if levels is None else levels.jumps:
                jumped_k[self._inputs == place] += jump_k if at_s > lags_right_s else 0.0
        lies_back = excluded is not None and self._online.history_min > 0.0
        admitted = self._online.set_reference(
            OnlineReference(
                time_min=then_s / 60.0,
                now_min=now_s / 60.0,
                degc=(reference.degc if inputs is None else inputs)[self._inputs],
                history=self._samples(then_s, self._online.history_min) if lies_back else None,
                excluded=excluded,
                kept=kept,
                jumped_k=np.where(np.abs(jumped_k) > OWN_K, jumped_k, 0.0),
                shift_k=0.0 if levels is None else self._of_inputs(levels.shift_k),
            )
        )
        if admitted:
            log.info("sensors.readmitted", sensors=list(admitted[:SHOWN]), count=len(admitted))

    def estimate(
        self, reference: Reference, now_s: float, degc: FloatArray, absent: npt.NDArray[np.bool_]
    ) -> Answer | None:
        """Return the thermal error since the reference; None without any usable sensor.

        `absent` says in the machine's order which sensors have been imputed until now.
        """
        away = np.zeros(len(self._inputs), dtype=np.bool_)
        away[: len(self.places)] = absent[self.places]
        estimation, anew = self._online.estimate(now_s / 60.0, degc[self._inputs], away)
        if anew:
            log.info("reference.rebased", reference=reference.reference_id, sensors=list(anew[:SHOWN]), count=len(anew))
            reference = self._rebased(reference)
        return None if estimation is None else (estimation, reference)

    def _rebased(self, reference: Reference) -> Reference:
        """Return the reference with the temperatures that returned sensors count from, where it is what holds them."""
        counted = self._online.reference_degc
        if counted is None:
            return reference
        degc = reference.degc.copy()
        degc[self.places] = counted[: len(self.places)]
        return replace(reference, degc=degc)

    def contributions(self) -> Contributions | None:
        """Return what each sensor adds to the latest estimate, None before one."""
        found = self._online.contributions_um()
        if found is None:
            return None
        return Contributions(sensor_ids=self.model.sensor_ids, channels=self.model.channels, work_out=found)

    def level_um(self, uncertainty_k: FloatArray) -> float:
        """Return by how much the thermal error may be wrong if sensors' levels are wrong by so much [K]."""
        return self._online.level_um(self._of_inputs(uncertainty_k))

    @property
    def excluded(self) -> dict[int, str]:
        """Sensors that must not count until the next reference, by ID, each with the sign by which it was found."""
        return self._online.excluded

    @property
    def kept(self) -> dict[str, Any] | None:
        """What sensors that returned count from, as JSON, where the reference itself does not hold it."""
        return self._online.kept

    def inhibit(self, mean_s: float, least: float) -> str:
        """Return why the model cannot be followed yet with means over a time [s], '' when it can."""
        wanted_s = self.model.period_s
        if wanted_s is not None and abs(wanted_s - mean_s) > 1e-6:
            return (
                f"model {self.model.model_id} needs means over {wanted_s:g} s; "
                f"set compensation.reference.mean_s: {wanted_s:g}"
            )
        known = self._online.filled
        if known >= least:
            return ""
        needed_h = self._online.history_min / 60.0
        inputs = "temperatures and spindle speed" if self.model.needs_speed else "temperatures"
        remedy = "wait, and leave the daemon running, then position the work again"
        if not self._speed_known and self.model.needs_speed:
            remedy = "the control gives no spindle speed: see `toolpoint cnc probe`, or train without it in the map"
        return (
            f"the states of model {self.model.model_id} stand for the last {needed_h:.1f} h of {inputs}, "
            f"of which too little is known (confidence {known:.2f}, {least:g} is needed); {remedy}"
        )

    def _samples(self, until_s: float, past_min: float) -> Samples:
        span_s = past_min * 60.0 + SPARE_PERIODS * self._period_s
        history = self._history(until_s - span_s, until_s, self._period_s)
        return ((time_s / 60.0, degc[self._inputs], rpm) for time_s, degc, rpm in history)
