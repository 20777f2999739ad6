"""What is known of the sensors since the reference; it is kept with the reference, so a restart forgets none of it."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import structlog

from daemon.estimation.model_in_use import ModelInUse
from models.control.reference_records import LabelOrigin, SensorsSinceReference
from models.json_values import plain
from models.records import FloatArray, Reference
from models.thermal.mean_increment import MeanIncrement, first_mean_increment, renewed_mean_increment

log = structlog.get_logger(__name__)

Places = npt.NDArray[np.intp]


class SinceReference:
    """Who is away, who is excluded, and what every label's mean counts from; owned by the thermal task."""

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

    def begin(self, reference: Reference) -> None:
        """Count from a new reference: nobody has been away since, and nobody is excluded."""
        self._reference_id = reference.reference_id
        self._told = None
        self.absent = np.zeros(len(self._sensor_ids), dtype=np.bool_)
        self.excluded = {}
        self.of_model = None
        self._means = {label: first_mean_increment(reference.degc[places]) for label, places in self._labels.items()}

    def take_up(self, reference: Reference, kept: SensorsSinceReference | None) -> None:
        """Go on from a reference of before, with what was kept of it."""
        self.begin(reference)
        if kept is None or kept.reference_id != reference.reference_id:
            return
        self._told = kept
        self.absent = np.isin(self._sensor_ids, kept.absent)
        self.excluded = dict(kept.excluded)
        self.of_model = None if kept.of_model is None else dict(kept.of_model)
        for label, places in self._labels.items():
            found = kept.labels.get(label)
            if found is not None and found.sensor_ids == self._ids(places):
                self._means[label] = _mean_from(found)
        log.info("sensors.restored", absent=len(kept.absent), excluded=sorted(self.excluded))

    def label_increments(self, degc: FloatArray) -> dict[str, float]:
        """Renew the mean increment of each label since the reference [degC]; labels without a sensor are left out."""
        self._means = {
            label: renewed_mean_increment(mean, degc[self._labels[label]]) for label, mean in self._means.items()
        }
        means_k = {label: mean.mean_k for label, mean in self._means.items()}
        return {label: mean_k for label, mean_k in means_k.items() if math.isfinite(mean_k)}

    def update(self, degc: FloatArray, online: ModelInUse) -> None:
        """Remember who was away in an estimate, and who is excluded.

        A sensor that the model does not know counts as away until a model sets it anew.
        """
        away = self.absent.copy()
        away[online.places] = False
        self.absent = away | ~np.isfinite(degc)
        of_others = {i: sign for i, sign in self.excluded.items() if i not in online.model.sensor_ids}
        self.excluded = of_others | online.excluded
        self.of_model = online.kept

    def changed(self) -> SensorsSinceReference | None:
        """Return what is to be kept for a restart when it has changed since it was told, else None."""
        sensors = SensorsSinceReference(
            reference_id=self._reference_id,
            absent=self._ids(np.flatnonzero(self.absent)),
            excluded={sensor_id: self.excluded[sensor_id] for sensor_id in sorted(self.excluded)},
            of_model=self.of_model,
            labels={label: self._label_origin(label, mean) for label, mean in self._means.items()},
        )
        if sensors == self._told:
            return None
        self._told = sensors
        return sensors

    def _ids(self, places: Places) -> tuple[int, ...]:
        return tuple(self._sensor_ids[place] for place in places)

    def _label_origin(self, label: str, mean: MeanIncrement) -> LabelOrigin:
        """Return what a label's mean counts from; nothing of it changes while nobody comes or goes."""
        counts_from = (mean.reference_degc, mean.counted, mean.offset_k)
        known = self._origins.get(label)
        if known is not None and all(now is then for now, then in zip(counts_from, known[0], strict=True)):
            return known[1]
        origin = LabelOrigin(
            sensor_ids=self._ids(self._labels[label]),
            reference_degc=tuple(plain(mean.reference_degc)),
            counted=tuple(mean.counted.tolist()),
            offset_k=tuple(plain(mean.offset_k)),
        )
        self._origins[label] = (counts_from, origin)
        return origin


def _numbers(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _mean_from(origin: LabelOrigin) -> MeanIncrement:
    """Return a mean as it was kept; where those that counted are now is told by their next temperatures."""
    counted, offset_k = np.array(origin.counted, dtype=np.bool_), _numbers(origin.offset_k)
    return MeanIncrement(
        reference_degc=_numbers(origin.reference_degc),
        counted=counted,
        offset_k=offset_k,
        increment_k=np.full(len(counted), np.nan) if counted.any() else offset_k,
    )
