"""Keeps which sensors are missing, excluded or at another level, and what they count from, also over a restart."""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import structlog

from daemon.estimation.model_in_use import ModelInUse
from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import (
    InOtherUnit,
    InputsRead,
    LevelChange,
    LevelGap,
    LevelJump,
    SensorLevelsDocument,
    SensorsLeft,
)
from daemon.state_store.store import StateStore
from drivers.clock import Clock
from models.control.reference_records import LabelOrigin, ReferenceDocument, SensorsSinceReference
from models.json_values import plain
from models.records import FloatArray, Reference
from models.sensor_levels import BEGINNING_S, Left, SensorLevels, first_levels, with_gap
from models.thermal.estimation import UNSURE_UM
from models.thermal.family import ThermalModel
from models.thermal.mean_increment import (
    Fading,
    MeanIncrement,
    first_mean_increment,
    hidden_step,
    renewed_mean_increment,
)

log = structlog.get_logger(__name__)

SAME_UM = 1e-6
Places = npt.NDArray[np.intp]


class SinceReference:
    """Which sensors are missing or excluded, and what every label's mean counts from; owned by the thermal task."""

    def __init__(self, sensor_ids: Sequence[int], labels: Mapping[str, Places]) -> None:
        self._sensor_ids = tuple(sensor_ids)
        self._labels = labels
        self._reference_id = ""
        self._told: SensorsSinceReference | None = None
        self._means: dict[str, MeanIncrement] = {}
        self._origins: dict[str, tuple[tuple[npt.NDArray[Any], ...], LabelOrigin]] = {}
        self.absent = np.zeros(len(self._sensor_ids), dtype=np.bool_)
        """Which sensors have been imputed until now, in the machine's order."""
        self.excluded: dict[int, str] = {}
        """Which sensors must not count until the next reference, and by which sign each was found."""
        self.of_model: dict[str, Any] | None = None
        """What the model keeps of sensors that returned."""
        self.found_wrong_um = 0.0
        """What sensors that were found wrong were worth when they were found, all together [um]."""
        self.wrong_in_tool_um = 0.0
        """What sensors that were found wrong have made of the tool term at most [um]."""
        self.positions_mm: Mapping[str, float] = {}
        """Where the axes stood at the reference, as they are read [mm]."""
        self._reference_min = 0.0
        self._rest: dict[str, Fading] = {}
        self._before: tuple[str, tuple[int, ...], FloatArray] | None = None
        self._followed_um: FloatArray | None = None

    def begin(self, reference: Reference) -> None:
        """Count from a new reference: no sensor has been missing since, and none is excluded."""
        self._reference_id = reference.reference_id
        self._told = None
        self._reference_min = reference.time.monotonic_s / 60.0
        self._rest, self._before, self._followed_um = {}, None, None
        self.absent = np.zeros(len(self._sensor_ids), dtype=np.bool_)
        self.excluded = {}
        self.of_model = None
        self.positions_mm = {}
        self.found_wrong_um = self.wrong_in_tool_um = 0.0
        self._means = {label: first_mean_increment(reference.degc[places]) for label, places in self._labels.items()}

    def take_up(self, reference: Reference, kept: SensorsSinceReference | None) -> None:
        self.begin(reference)
        if kept is None or kept.reference_id != reference.reference_id:
            return
        self._told = kept
        self.absent = np.isin(self._sensor_ids, kept.absent)
        self.excluded = dict(kept.excluded)
        self.of_model = None if kept.of_model is None else dict(kept.of_model)
        self._rest = {name: self._fading(rest) for name, rest in kept.rest_um.items()}
        self.positions_mm = kept.positions_mm
        self.found_wrong_um, self.wrong_in_tool_um = kept.found_wrong_um, kept.wrong_in_tool_um
        for label, places in self._labels.items():
            found = kept.labels.get(label)
            if found is not None and found.sensor_ids == self._ids(places):
                self._means[label] = _mean_from(found, self._fading(found.rest_k))
        log.info("sensors.restored", absent=len(kept.absent), excluded=sorted(self.excluded))

    def waits_for_sensors(self, reference: Reference, of_model: Places, heard: npt.NDArray[np.bool_]) -> bool:
        """Whether sensors that counted before a restart have had no value yet: none of them has left for that."""
        needed = np.isin(np.arange(len(self._sensor_ids)), np.concatenate([*self._labels.values(), of_model]))
        return bool((needed & np.isfinite(reference.degc) & ~self.absent & ~heard).any())

    def goes_on_um(
        self, model: ThermalModel, imputed: tuple[int, ...], now_um: FloatArray, time_min: float, followed: bool
    ) -> FloatArray:
        """Return the thermal error, in which no return of a sensor is a step: what it would be fades out [um].

        `followed`: the output may follow it. What it goes on from at a return is what could be followed last: the
        output has stood there since, and what was estimated from too few sensors would only lead it astray.
        """
        rest_um = self._rest_um(model.channels, time_min)
        model_id, away, before_um = self._before or ("", (), now_um)
        if (same := model_id == model.model_id) and set(away) - set(imputed):
            if self._followed_um is not None and not np.allclose(before_um, now_um + rest_um, atol=SAME_UM):
                before_um = self._followed_um
            steps = zip(model.channels, before_um, now_um, strict=True)
            self._rest = {name: hidden_step(np.array([then]), np.array([now]), time_min) for name, then, now in steps}
            rest_um = before_um - now_um
        self._before = (model.model_id, imputed, now_um + rest_um)
        if followed or not same:  # what another model said of its channels is no beginning for this one
            self._followed_um = now_um + rest_um if followed else None
        return now_um + rest_um

    def fading_um(self, channels: Sequence[str], time_min: float, tool_um_per_k: FloatArray) -> float:
        """Return what is still to fade of the worst channel, and of the tool, which takes `tool_um_per_k` [um]."""
        tool_um = sum(
            abs(float(mean.rest.at(time_min)[0])) * float(tool_um_per_k[self._labels[label]].sum())
            for label, mean in self._means.items()
            if mean.rest.amount[0]
        )
        return float(np.abs(self._rest_um(channels, time_min)).max(initial=0.0)) + tool_um

    def _rest_um(self, channels: Sequence[str], time_min: float) -> FloatArray:
        if not self._rest:
            return np.zeros(len(channels))
        nothing = Fading(amount=np.zeros(1))
        return np.array([self._rest.get(name, nothing).at(time_min)[0] for name in channels])

    def _fading(self, kept: Sequence[float]) -> Fading:
        """Return what fades, from its amount and the time after the reference [min]."""
        return Fading(amount=np.array([kept[0]]), since_min=self._reference_min + kept[1])

    def _fading_state(self, rest: Fading) -> tuple[float, float]:
        return float(rest.amount[0]), rest.since_min - self._reference_min if rest.amount[0] else 0.0

    def label_increments(self, degc: FloatArray, time_min: float) -> dict[str, float]:
        """Renew the mean increment of each label since the reference [degC]; labels without a sensor are left out."""
        self._means = {
            label: renewed_mean_increment(mean, degc[self._labels[label]], time_min)
            for label, mean in self._means.items()
        }
        means_k = {label: mean.mean_k for label, mean in self._means.items()}
        return {label: mean_k for label, mean_k in means_k.items() if math.isfinite(mean_k)}

    def wrong_in_tool(self, degc: FloatArray, tool_um_per_k: FloatArray) -> str:
        """Return why the tool term is not followed: means of labels hold sensors that were found wrong; '' when it is.

        It says so until the next reference: a tool may have begun to count while one of them was wrong.
        """
        if not self.excluded:
            return ""
        wrong = np.isin(self._sensor_ids, list(self.excluded)) & (tool_um_per_k > 0.0)
        if not wrong.any():
            return ""
        for label, mean in self._means.items():
            of_label, moved_k = wrong[self._labels[label]], degc[self._labels[label]] - mean.reference_degc
            right_k = moved_k[~of_label & np.isfinite(moved_k)]
            apart_k = np.abs(moved_k - (right_k.mean() if len(right_k) else 0.0))[of_label]
            made_um = float(np.nansum(apart_k * tool_um_per_k[self._labels[label]][of_label]))
            self.wrong_in_tool_um = max(self.wrong_in_tool_um, made_um)
        if self.wrong_in_tool_um <= UNSURE_UM:
            return ""
        named = ", ".join(f"sensor {self._sensor_ids[i]}" for i in np.flatnonzero(wrong)[:3])
        return (
            f"the tool's temperature holds {named}, found wrong, which may be {self.wrong_in_tool_um:.1f} um: "
            "position the work again"
        )

    def update(self, degc: FloatArray, online: ModelInUse, found_wrong_um: float) -> None:
        """Record which sensors were missing in an estimate, which are excluded, and what new ones were worth [um].

        A sensor that the model does not know counts as missing until a model sets it anew.
        """
        away = self.absent.copy()
        away[online.places] = False
        self.absent = away | ~np.isfinite(degc)
        of_others = {i: sign for i, sign in self.excluded.items() if i not in online.model.sensor_ids}
        self.excluded = of_others | online.excluded
        self.of_model = online.kept
        self.found_wrong_um += found_wrong_um

    def changed(self) -> SensorsSinceReference | None:
        """Return what is to be kept for a restart when it has changed since it was last returned, else None."""
        sensors = SensorsSinceReference(
            reference_id=self._reference_id,
            absent=self._ids(np.flatnonzero(self.absent)),
            excluded={sensor_id: self.excluded[sensor_id] for sensor_id in sorted(self.excluded)},
            of_model=self.of_model,
            rest_um={name: self._fading_state(rest) for name, rest in self._rest.items()},
            labels={label: self._label_origin(label, mean) for label, mean in self._means.items()},
            found_wrong_um=self.found_wrong_um,
            wrong_in_tool_um=self.wrong_in_tool_um,
            positions_mm=self.positions_mm,
        )
        if sensors == self._told:
            return None
        self._told = sensors
        return sensors

    def tell(self, deliver: Callable[[SensorsSinceReference], None]) -> None:
        if (sensors := self.changed()) is not None:
            deliver(sensors)

    def _ids(self, places: Places) -> tuple[int, ...]:
        return tuple(self._sensor_ids[place] for place in places)

    def _label_origin(self, label: str, mean: MeanIncrement) -> LabelOrigin:
        """Return what a label's mean counts from; it does not change while no sensor leaves or returns."""
        counts_from = (mean.reference_degc, mean.counted, mean.offset_k, mean.rest.amount)
        known = self._origins.get(label)
        if known is not None and all(now is then for now, then in zip(counts_from, known[0], strict=True)):
            return known[1]
        origin = LabelOrigin(
            sensor_ids=self._ids(self._labels[label]),
            reference_degc=tuple(plain(mean.reference_degc)),
            counted=tuple(mean.counted.tolist()),
            offset_k=tuple(plain(mean.offset_k)),
            rest_k=self._fading_state(mean.rest),
        )
        self._origins[label] = (counts_from, origin)
        return origin


class LevelMemory:
    """Hands the levels to the store when they have changed, and gets those of the previous run."""

    def __init__(self, history: HistoryWriter, reads: Mapping[int, str], clock: Clock) -> None:
        """`reads`: what each sensor reads, by its ID in the machine's order."""
        self._store = StateStore(history, clock)
        self._reads = dict(reads)
        self._sensor_ids = tuple(reads)
        self.anew: list[int] = []
        """Indices of sensors that read something else than in the previous run: what it knew of them is of another."""
        self._clock = clock
        self._kept = first_levels(len(self._sensor_ids))
        self._excluded: dict[int, str] = {}
        self._kept_to_utc_s = self._clock.now().utc_ahead_s
        self.units = self._store.get(InOtherUnit) or InOtherUnit(units={}, degc={})
        self.inputs = self._store.get(InputsRead) or InputsRead(inputs={})
        """Which inputs say another unit, and what inputs say: of the previous run until another is kept."""

    def keep(
        self,
        levels: SensorLevels,
        excluded: Mapping[int, str],
        in_other_unit: InOtherUnit,
        inputs: InputsRead | None = None,
    ) -> None:
        """Store the levels, what was found wrong, which inputs say another unit, what inputs say, if it is other."""
        if in_other_unit is not self.units:
            self.units = in_other_unit
            self._store.put(in_other_unit)
        if inputs is not None and inputs is not self.inputs:
            self.inputs = inputs
            self._store.put(inputs)
        before, self._kept = self._kept, levels
        to_utc_s = self._clock.now().utc_ahead_s
        same = (
            levels.left is before.left,
            levels.uncertainty_k is before.uncertainty_k,
            levels.lasting_k is before.lasting_k,
            levels.shift_k is before.shift_k,
            levels.gaps is before.gaps,
            dict(levels.away_s) == dict(before.away_s),
            self._excluded == excluded,
            abs(self._kept_to_utc_s - to_utc_s) < 1.0,  # what is stored has its times by the calendar
        )
        if not all(same):
            self._kept_to_utc_s, self._excluded = to_utc_s, dict(excluded)
            self._store.put(self._document(levels))

    def excluded_before(self) -> dict[int, str]:
        """Return what had been found wrong when the previous run ended; it holds until a reference says otherwise.

        The levels hold it too: a reference that has ended for good, or was not taken up, leaves no record.
        """
        kept, levels = self._store.get(ReferenceDocument), self._store.get(SensorLevelsDocument)
        sensors = None if kept is None or kept.record is None else kept.record.sensors
        return ({} if levels is None else dict(levels.excluded)) | ({} if sensors is None else dict(sensors.excluded))

    def restored(self) -> SensorLevels:
        """Return the levels of the previous run, without those of sensors that read something else now."""
        kept = self._store.get(SensorLevelsDocument) or self._document(first_levels(len(self._sensor_ids)))
        was = kept.reads or self._reads
        self.anew = [index for index, i in enumerate(self._sensor_ids) if was.get(i) != self._reads[i]]
        levels, now = self._levels_of(kept), self._clock.now()
        return with_gap(levels, BEGINNING_S, now.monotonic_s, np.array(self.anew)) if self.anew else levels

    def _levels_of(self, kept: SensorLevelsDocument) -> SensorLevels:
        place = {i: index for index, i in enumerate(self._sensor_ids) if index not in self.anew}
        since_s = self._clock.now().utc_ahead_s
        stored = kept.shift_k, kept.uncertainty_k, kept.lasting_k
        shift_k, uncertainty_k, lasting_k = ([of.get(i, 0.0) * (i in place) for i in self._sensor_ids] for of in stored)
        left: dict[int, Left] = {}
        if kept.sensor_ids == self._sensor_ids and not self.anew:
            for then in kept.left:
                degc = np.array([np.nan if value is None else value for value in then.degc], dtype=np.float64)
                moment = Left(at_s=then.utc_s - since_s, degc=degc, trend_k_per_min=np.array(then.trend_k_per_min))
                left |= dict.fromkeys((place[i] for i in then.away), moment)
        return SensorLevels(
            shift_k=np.array(shift_k),
            uncertainty_k=np.array(uncertainty_k),
            lasting_k=np.array(lasting_k),
            degc=first_levels(len(self._sensor_ids)).degc,
            left=MappingProxyType(left),
            changes=tuple(
                (c.utc_s - since_s, place[c.sensor_id], c.shift_k) for c in kept.changes if c.sensor_id in place
            ),
            gaps=tuple(
                (g.from_utc_s - since_s, g.to_utc_s - since_s, of)
                for g in kept.gaps
                if (of := tuple(place[i] for i in g.sensor_ids if i in place))
            ),
            away_s=MappingProxyType({place[i]: at - since_s for i, at in kept.away_utc_s.items() if i in place}),
            jumps=tuple((j.utc_s - since_s, place[j.sensor_id], j.jump_k) for j in kept.jumps if j.sensor_id in place),
        )

    def _document(self, levels: SensorLevels) -> SensorLevelsDocument:
        since_s = self._clock.now().utc_ahead_s
        moments: dict[int, tuple[Left, list[int]]] = {}
        for index, then in levels.left.items():
            moments.setdefault(id(then), (then, []))[1].append(self._sensor_ids[index])
        return SensorLevelsDocument(
            sensor_ids=self._sensor_ids,
            reads=self._reads,
            excluded=self._excluded,
            shift_k=self._by_id(levels.shift_k),
            uncertainty_k=self._by_id(levels.uncertainty_k),
            lasting_k=self._by_id(levels.lasting_k),
            away_utc_s={self._sensor_ids[index]: at_s + since_s for index, at_s in levels.away_s.items()},
            left=tuple(
                SensorsLeft(
                    away=tuple(away),
                    utc_s=then.at_s + since_s,
                    degc=tuple(plain(then.degc)),
                    trend_k_per_min=tuple(then.trend_k_per_min.tolist()),
                )
                for then, away in moments.values()
            ),
            changes=tuple(
                LevelChange(utc_s=at_s + since_s, sensor_id=self._sensor_ids[index], shift_k=shift_k)
                for at_s, index, shift_k in levels.changes
            ),
            jumps=tuple(
                LevelJump(utc_s=at_s + since_s, sensor_id=self._sensor_ids[index], jump_k=jump_k)
                for at_s, index, jump_k in levels.jumps
            ),
            gaps=tuple(
                LevelGap(
                    from_utc_s=a + since_s, to_utc_s=b + since_s, sensor_ids=tuple(self._sensor_ids[i] for i in of)
                )
                for a, b, of in levels.gaps
            ),
        )

    def _by_id(self, values: FloatArray) -> dict[int, float]:
        return {self._sensor_ids[index]: float(values[index]) for index in np.flatnonzero(values)}


def _numbers(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _mean_from(origin: LabelOrigin, rest: Fading) -> MeanIncrement:
    """Return a mean as it was kept; where those that counted are now is told by their next temperatures."""
    counted, offset_k = np.array(origin.counted, dtype=np.bool_), _numbers(origin.offset_k)
    return MeanIncrement(
        reference_degc=_numbers(origin.reference_degc),
        counted=counted,
        offset_k=offset_k,
        increment_k=np.full(len(counted), np.nan) if counted.any() else offset_k,
        rest=rest,
    )
