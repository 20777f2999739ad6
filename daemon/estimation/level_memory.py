"""What every sensor's level counts as, as the store keeps it for the next run."""

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import LevelChange, SensorLevelsDocument, SensorsLeft
from daemon.state_store.store import StateStore
from drivers.clock import Clock
from models.json_values import plain
from models.records import FloatArray
from models.sensor_levels import Left, SensorLevels, first_levels


class LevelMemory:
    """Hands the levels to the store when they have changed, and gets those of the previous run."""

    def __init__(self, history: HistoryWriter, sensor_ids: Sequence[int], clock: Clock) -> None:
        self._store = StateStore(history, clock)
        self._sensor_ids = tuple(sensor_ids)
        self._clock = clock
        self._kept = first_levels(len(self._sensor_ids))

    def keep(self, levels: SensorLevels) -> None:
        """Store the levels, unless they are what is stored."""
        before, self._kept = self._kept, levels
        same = (
            levels.left is before.left,
            levels.uncertainty_k is before.uncertainty_k,
            levels.shift_k is before.shift_k,
        )
        if not all(same):
            self._store.put(self._document(levels))

    def restored(self) -> SensorLevels:
        """Return the levels of the previous run; sensors that are not of this machine any more are left out."""
        levels, kept = first_levels(len(self._sensor_ids)), self._store.get(SensorLevelsDocument)
        if kept is None:
            return levels
        place = {sensor_id: index for index, sensor_id in enumerate(self._sensor_ids)}
        since_s = self._to_utc_s()
        shift_k, uncertainty_k = levels.shift_k.copy(), levels.uncertainty_k.copy()
        for values, of_store in ((shift_k, kept.shift_k), (uncertainty_k, kept.uncertainty_k)):
            for sensor_id, value in of_store.items():
                if sensor_id in place:
                    values[place[sensor_id]] = value
        left: dict[int, Left] = {}
        if kept.sensor_ids == self._sensor_ids:
            for then in kept.left:
                degc = np.array([np.nan if value is None else value for value in then.degc], dtype=np.float64)
                moment = Left(at_s=then.utc_s - since_s, degc=degc, trend_k_per_min=np.array(then.trend_k_per_min))
                left |= dict.fromkeys((place[i] for i in then.away), moment)
        changes = tuple(
            (c.utc_s - since_s, place[c.sensor_id], c.shift_k) for c in kept.changes if c.sensor_id in place
        )
        return SensorLevels(
            shift_k=shift_k, uncertainty_k=uncertainty_k, degc=levels.degc, left=MappingProxyType(left), changes=changes
        )

    def _to_utc_s(self) -> float:
        now = self._clock.now()
        return now.utc_s - now.monotonic_s

    def _document(self, levels: SensorLevels) -> SensorLevelsDocument:
        since_s = self._to_utc_s()
        moments: dict[int, tuple[Left, list[int]]] = {}
        for index, then in levels.left.items():
            moments.setdefault(id(then), (then, []))[1].append(self._sensor_ids[index])
        return SensorLevelsDocument(
            sensor_ids=self._sensor_ids,
            shift_k=self._by_id(levels.shift_k),
            uncertainty_k=self._by_id(levels.uncertainty_k),
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
        )

    def _by_id(self, values: FloatArray) -> dict[int, float]:
        return {self._sensor_ids[index]: float(values[index]) for index in np.flatnonzero(values)}
