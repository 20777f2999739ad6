"""Finds temperature sensors that contradict the others: stuck for a while, or different in one recording.

Every sensor is predicted from the others by a ridge that was fitted on the other recordings (on the other parts, where
there are fewer than three), all counted from their means, so that offsets do not matter. What a sensor usually leaves
there tells how well the others know it; a sensor that leaves many times as much in one recording, or whose value stands
still while the others say that it moved, is named. One that is named does not predict any more, so that it cannot draw
others in.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import Recording
from models.records import FloatArray

SAMPLE_S = 300.0
"""Averages over this time are looked at [s]; shorter recordings are looked at as they are."""
FEWEST_PARTS = 3
PARTS = 4
"""With fewer recordings than `FEWEST_PARTS` each is cut into so many parts."""
FEWEST_ROWS = 5
PENALTY_K = 0.1
"""Scatter that every sensor is taken to have [K]."""
CONTRADICTS = 6.0
"""A sensor contradicts the others when it leaves more than so many times what it usually leaves ..."""
CONTRADICTS_K = 1.0
"""... and at least this [K] ..."""
CONTRADICTS_SHARE = 0.5
"""... and this share of what it moves."""
STUCK_S = 1800.0
"""A value that stands still for so long [s] may be stuck ..."""
STUCK_K = 1.0
"""... if the others say that it moved by more than this [K] ..."""
STUCK_TIMES = 3.0
"""... and by more than so many times what it usually leaves."""
STUCK_STEPS = 3.0
"""... and by more than so many of its smallest steps: a coarse sensor stands still until it takes one."""
MOST_SUSPECTED = 8
"""So many sensors are tried as the one that is wrong."""
AGREES_AGAIN = 0.5
"""Without the one that is wrong, the others leave less than this share of what the two worst left."""
MOST_NAMED = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Disagreement:
    """A sensor that contradicts the others in one recording."""

    recording: int
    sensor: int
    row: int | None
    """Row of the recording from which on it stands still, from 0; None: it differs in the recording as a whole."""
    stuck_h: float
    """For how long it stands still [h]; 0: it does not."""
    by_k: float
    """How far it is from what the others say [K]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A stretch of a recording."""

    recording: int
    rows: slice
    centred_k: FloatArray
    """Temperatures minus their means, shape (n, n_sensors)."""


def disagreements(recordings: Sequence[Recording], without: Collection[int] = ()) -> list[Disagreement]:
    """Return what contradicts the rest, the worst first; nothing where there are too few sensors or rows to tell.

    `recordings`: with the same columns, without values that cannot be. `without`: sensors of which is known already
    that something is wrong (indices from 0).
    """
    if not recordings or recordings[0].sensors < 3:
        return []
    if any(r.temperature_names != recordings[0].temperature_names for r in recordings):
        return []
    averaged = [recording.downsampled(SAMPLE_S) for recording in recordings]
    parts = parts_of(averaged, 1 if len(averaged) >= FEWEST_PARTS else PARTS)
    if len(parts) < FEWEST_PARTS:
        return []
    found: list[Disagreement] = []
    trusted = [sensor for sensor in moving(parts) if sensor not in without]
    while len(trusted) >= 3 and len(found) < MOST_NAMED:
        residuals = _left_out(parts, trusted)
        worst = _worst(recordings, averaged, parts, residuals, trusted)
        if worst is None:
            break
        found.append(worst)
        trusted.remove(worst.sensor)
    return found


def moving(parts: Sequence[Part]) -> list[int]:
    """Return which sensors ever move (indices from 0)."""
    sensors = range(parts[0].centred_k.shape[1] if parts else 0)
    return [sensor for sensor in sensors if any(np.ptp(part.centred_k[:, sensor]) > 0.0 for part in parts)]


def parts_of(averaged: Sequence[Recording], pieces: int) -> list[Part]:
    """Return each recording in so many parts, those without enough rows left out."""
    found = []
    for number, recording in enumerate(averaged):
        degc = recording.temperatures_degc[:, : recording.sensors]
        for rows in np.array_split(np.arange(recording.rows), pieces):
            if len(rows) < FEWEST_ROWS:
                continue
            table = degc[rows[0] : rows[-1] + 1]
            known = np.isfinite(table)
            mean = np.where(known, table, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
            centred = np.where(known, table - mean, 0.0)
            found.append(Part(recording=number, rows=slice(int(rows[0]), int(rows[-1]) + 1), centred_k=centred))
    return found


def _left_out(parts: Sequence[Part], sensors: Sequence[int]) -> list[FloatArray]:
    """Return what each sensor leaves in each part when the others predict it by a fit of the other parts [K]."""
    tables = [part.centred_k[:, sensors] for part in parts]
    squares = [table.T @ table for table in tables]
    whole, rows = sum(squares), sum(len(table) for table in tables)
    found = []
    for table, square in zip(tables, squares, strict=True):
        penalty = (rows - len(table)) * PENALTY_K**2 * np.eye(len(sensors))
        precision = np.linalg.inv(whole - square + penalty)
        found.append(table @ precision / np.diag(precision))
    return found


def _worst(
    recordings: Sequence[Recording],
    averaged: Sequence[Recording],
    parts: Sequence[Part],
    residuals: Sequence[FloatArray],
    sensors: Sequence[int],
) -> Disagreement | None:
    left_k = np.array([np.sqrt(np.square(residual).mean(axis=0)) for residual in residuals])
    usual_k = np.maximum(np.median(left_k, axis=0), PENALTY_K)
    stuck = _stuck(recordings, averaged, parts, residuals, sensors, usual_k)
    if stuck is not None:
        return stuck
    moves_k = np.array([part.centred_k[:, sensors].std(axis=0) for part in parts])
    suspected = np.where((left_k < CONTRADICTS_K) | (left_k < CONTRADICTS_SHARE * moves_k), 0.0, left_k / usual_k)
    place = int(np.argmax(suspected.max(axis=1)))
    if not suspected[place].any():
        return None
    ratio = np.where(suspected[place] > 0.0, _times_usual(parts, place, sensors), 0.0)
    column = _culprit(parts, place, ratio, sensors) if ratio.max() >= CONTRADICTS else None
    if column is None:
        return None
    by_k = float(left_k[place, column])
    return Disagreement(recording=parts[place].recording, sensor=sensors[column], row=None, stuck_h=0.0, by_k=by_k)


def _times_usual(parts: Sequence[Part], place: int, sensors: Sequence[int]) -> FloatArray:
    """Return how many times as much as in the others each sensor leaves in a part, which no fit has seen."""
    others = [part for number, part in enumerate(parts) if number != place]
    usual_k = np.median([np.sqrt(np.square(each).mean(axis=0)) for each in _left_out(others, sensors)], axis=0)
    left_k = np.sqrt(np.square(_left_out(parts, sensors)[place]).mean(axis=0))
    return np.asarray(left_k / np.maximum(usual_k, PENALTY_K))


def _culprit(parts: Sequence[Part], place: int, ratio: FloatArray, sensors: Sequence[int]) -> int | None:
    """Return the sensor without which the others agree again in a part; None where no single one is wrong."""
    best, least = None, AGREES_AGAIN * float(np.sort(ratio)[-2:].mean())
    for column in np.argsort(-ratio)[:MOST_SUSPECTED].tolist():
        others = [sensor for sensor in sensors if sensor != sensors[column]]
        largest = float(_times_usual(parts, place, others).max())
        if largest < least:
            best, least = column, largest
    return best


def _stuck(
    recordings: Sequence[Recording],
    averaged: Sequence[Recording],
    parts: Sequence[Part],
    residuals: Sequence[FloatArray],
    sensors: Sequence[int],
    usual_k: FloatArray,
) -> Disagreement | None:
    """Return the sensor that stands still while the others say most clearly that it moved."""
    best, most = None, 1.0
    for part, residual in zip(parts, residuals, strict=True):
        time_s = averaged[part.recording].time_s[part.rows]
        for column, sensor in enumerate(sensors):
            first, stop = _longest_still(part.centred_k[:, sensor])
            if stop - first < FEWEST_ROWS or time_s[stop - 1] - time_s[first] < STUCK_S:
                continue
            moved_k = float(np.ptp(residual[first:stop, column]))
            step_k = _resolution_k(recordings[part.recording].temperatures_degc[:, sensor])
            times = moved_k / max(STUCK_K, STUCK_TIMES * float(usual_k[column]), STUCK_STEPS * step_k)
            if times > most:
                row = int(np.searchsorted(recordings[part.recording].time_s, time_s[first]))
                hours = float(time_s[stop - 1] - time_s[first]) / 3600.0
                best = Disagreement(recording=part.recording, sensor=sensor, row=row, stuck_h=hours, by_k=moved_k)
                most = times
    return best


def _resolution_k(degc: FloatArray) -> float:
    """Return the smallest step between two values of a sensor [K]; 0 where it has one value alone."""
    steps_k = np.diff(np.unique(degc[np.isfinite(degc)]))
    return float(steps_k.min()) if len(steps_k) else 0.0


def _longest_still(values: FloatArray) -> tuple[int, int]:
    """Return the first row, and the one after the last, of the longest stretch of equal values."""
    breaks = np.flatnonzero(np.abs(np.diff(values)) > 1e-6) + 1
    edges = np.concatenate([[0], breaks, [len(values)]])
    longest = int(np.argmax(np.diff(edges)))
    return int(edges[longest]), int(edges[longest + 1])
