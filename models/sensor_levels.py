"""Whether a sensor that returns counts on from its own past, or from where its neighbours let it be expected.

A sensor that was away is expected to have gone on as before, ever less the longer it was away (a warm-up slows down,
and the spindle may have stopped), but for what those beside it did otherwise. One that its own past explains counts as
before. One at another level is another sensor, or it is wrong: its distance is taken off from then on (`shift_k`), and
when it jumps back the shift is undone. Where neither past nor neighbours prove a level, `uncertainty_k` says by how
much it may be wrong until the next reference. `jumps` says which sensors have jumped although they were heard all the
time: what remembers the past is to remember it at their level of now.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

OWN_K = 0.5
"""So near to where it is expected a sensor that returns is itself [K]."""
OWN_SHARE = 0.5
"""And by this share of what those beside it did otherwise than before."""
LEAST_BESIDE = 2
"""With so many on its component these predict a sensor; with fewer all others do."""
ALONE_K_PER_MIN = 1.0
"""By so much a sensor with fewer others may have departed [K/min]."""
TREND_S = 300.0
"""How a sensor was going is seen over so long before it left [s]."""
SHORTEST_TREND_S = 120.0
TREND_FADES_S = 120.0
"""Time constant with which it slows down after that [s]: chosen on the tuning half of the zoo's machines."""
MOMENT_S = 10.0
"""Moments that are kept lie so far apart [s]."""
CHANGES_KEPT, OF_EACH = 200, 4
"""So many changes of shifts and jumps are kept, but of a whole machine so many of each sensor."""
GAPS_KEPT = 100
BEGINNING_S = -1e11
"""Of a sensor that reads something else, all of the past is another's: older than any history, by any clock [s]."""
JUST_S = 1e-3
"""A sensor was right until so long before its jump [s]."""
UNKNOWN_K = 1e3
"""Stands for an error that nobody knows: more than any sensor is wrong by [K]."""

Changes = tuple[tuple[float, int, float], ...]
"""Time [s], index of a sensor, and its shift before that [K]."""
Gaps = tuple[tuple[float, float, tuple[int, ...]], ...]
"""Begin and end [s], and the indices of sensors."""
BoolArray = npt.NDArray[np.bool_]
GroupArray = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Left:
    """All temperatures when a value of some sensors last counted."""

    at_s: float
    degc: FloatArray
    """Without shifts [degC], shape (n_sensors,); NaN where there was none."""
    trend_k_per_min: FloatArray
    """How each was going before that; 0 where it is not known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorLevels:
    """What every sensor's level counts as; one entry per sensor of the machine."""

    shift_k: FloatArray
    """Taken off what it reads [K]."""
    uncertainty_k: FloatArray
    """By how much its level since the reference may be wrong, with sign [K]."""
    lasting_k: FloatArray
    """By how much its temperature may have been wrong at the reference, with sign [K]."""
    degc: FloatArray
    """Latest temperatures that counted, shifts taken off [degC]; NaN where there is none or it is too old."""
    left: Mapping[int, Left] = field(default_factory=lambda: MappingProxyType({}))
    """By index of each missing sensor: all temperatures when its value last counted."""
    recent: tuple[tuple[float, FloatArray], ...] = ()
    """Time [s] and `degc` of the last moments, oldest first."""
    changes: Changes = ()
    """How shifts have changed, oldest first."""
    jumps: Changes = ()
    """Time [s], index of a sensor, and by how much it counts at another level since [K], oldest first."""
    gaps: Gaps = ()
    """Times within which what sensors were read as says nothing, oldest first."""
    away_s: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({}))
    """By index of each sensor that came back at a level which is doubted: since when it had been away, or wrong [s]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BelievedValues:
    """What cleansing accepts of one cycle of a line; arrays in the cycle's order."""

    now_s: float
    indices: GroupArray
    degc: FloatArray
    """As measured [degC]; NaN where nothing counts in this cycle."""
    returned: BoolArray
    """First values, and values after a gap; a level that took long to be accepted is none."""
    new_level: BoolArray
    """Values farther from the sensor's past than the elapsed time explains."""
    jump_k: FloatArray
    """Change of values at a level that the elapsed time does not explain [K]; 0 for all others."""
    stale: BoolArray
    """Which sensors of the machine have no value that is new enough, shape (n_sensors,)."""
    at_s: FloatArray
    """When a value of each last counted [s], shape (n_sensors,)."""


def first_levels(sensor_count: int) -> SensorLevels:
    """Return the levels before any value: nothing is shifted and nothing doubted."""
    nothing = np.zeros(sensor_count)
    return SensorLevels(shift_k=nothing, uncertainty_k=nothing, lasting_k=nothing, degc=np.full(sensor_count, np.nan))


def with_past(levels: SensorLevels, degc: FloatArray, at_s: FloatArray) -> SensorLevels:
    """Return the levels after a restart: what was read last [degC] and when [s], NaN where nothing."""
    known = np.flatnonzero(np.isfinite(degc))
    if not len(known):
        return levels
    then = Left(at_s=float(at_s[known].max()), degc=degc - levels.shift_k, trend_k_per_min=np.zeros(len(degc)))
    left = {int(i): then for i in known} | dict(levels.left)
    return replace(levels, left=MappingProxyType(left))


def trusted_anew(levels: SensorLevels, wrong: BoolArray) -> SensorLevels:
    """Return the levels at a new reference: what is counted from it is right, temperatures stay as doubted as before.

    `wrong`, shape (n_sensors,): which sensors had been found wrong, nobody knows by how much.
    """
    lasting_k = np.where(wrong, UNKNOWN_K, levels.lasting_k + levels.uncertainty_k)
    return replace(levels, uncertainty_k=np.zeros_like(lasting_k), lasting_k=lasting_k)


def counted_again(levels: SensorLevels, lasting_k: FloatArray) -> SensorLevels:
    """Return the levels when it counts from a reference of before again, since which everything is doubted.

    `lasting_k`, shape (n_sensors,): that of the levels at that reference [K].
    """
    off_k = levels.lasting_k + levels.uncertainty_k - lasting_k
    off_k = np.where(np.abs(off_k) > UNKNOWN_K / 2, levels.uncertainty_k, np.where(np.abs(off_k) <= OWN_K, 0.0, off_k))
    return replace(levels, uncertainty_k=off_k, lasting_k=lasting_k)


def trusted(levels: SensorLevels) -> SensorLevels:
    """Return the levels when a person says that the temperatures are right as they are at the reference."""
    away_s = {index: at_s for index, at_s in levels.away_s.items() if levels.uncertainty_k[index] != 0.0}
    return replace(levels, lasting_k=np.zeros_like(levels.lasting_k), away_s=MappingProxyType(away_s))


def doubted(levels: SensorLevels) -> BoolArray:
    """Return whose temperature as it is may be wrong, shape (n_sensors,)."""
    since = (levels.uncertainty_k != 0.0) & (levels.lasting_k == 0.0)
    return np.asarray(since | (np.abs(levels.lasting_k + levels.uncertainty_k) > OWN_K))


def renewed_levels(levels: SensorLevels, group: GroupArray, seen: BelievedValues) -> SensorLevels:
    """Return the levels after a cycle.

    `group`, shape (n_sensors,): number of the component of each sensor of the machine. `seen`: what is believed of the
    cycle.
    """
    believed = np.isfinite(seen.degc)
    degc = np.where(seen.stale, np.nan, levels.degc)
    degc[seen.indices[believed]] = seen.degc[believed] - levels.shift_k[seen.indices[believed]]
    levels = _with_leaving(levels, seen)
    judged = believed & (seen.returned | (seen.jump_k != 0.0))
    if judged.any():
        before = levels
        levels, degc = _judged(levels, group, seen, judged, degc)
        if (by_k := jumped_k(before, levels)) is not None:  # a jump is no trend
            levels = replace(levels, recent=tuple((at_s, then + by_k) for at_s, then in levels.recent))
    if levels.left:
        here = set(seen.indices[believed].tolist())
        if not here.isdisjoint(levels.left):
            left = {index: then for index, then in levels.left.items() if index not in here}
            levels = replace(levels, left=MappingProxyType(left))
    levels = replace(levels, degc=degc)
    if levels.recent and 0.0 <= seen.now_s - levels.recent[-1][0] < MOMENT_S:
        return levels
    kept = tuple(then for then in levels.recent if seen.now_s - 2.0 * TREND_S < then[0] < seen.now_s)
    return replace(levels, recent=(*kept, (seen.now_s, degc)))


def unshifted(
    levels: SensorLevels, time_s: float, degc: FloatArray, until_s: float = np.inf, mean_s: float = 0.0
) -> FloatArray:
    """Return temperatures of a time in the past [degC] without the shifts of then, at the levels of a later time.

    What a sensor was read as within a gap is NaN, and so is a mean that holds some of that, or two of its levels.

    `time_s`: on the clock of the cycles [s]. `degc`, shape (n_sensors,): as they were read [degC]. `until_s`: the later
    time: what has jumped until then is told as if it had always been there [s]. `mean_s`: they are means over so long
    until `time_s` [s].
    """
    shift_k = levels.shift_k
    if levels.changes:
        shift_k = shift_k.copy()
        for changed_s, index, before_k in reversed(levels.changes):
            if changed_s > time_s:
                shift_k[index] = before_k
    if levels.jumps:
        shift_k = shift_k.copy()
        for jumped_s, index, jump_k in levels.jumps:
            shift_k[index] -= jump_k if time_s < jumped_s <= until_s else 0.0
    inside = [i for from_s, to_s, sensors in levels.gaps for i in sensors if from_s < time_s <= to_s + mean_s]
    inside += [index for at_s, index, _ in (*levels.changes, *levels.jumps) if 0.0 <= time_s - at_s < mean_s]
    if inside:
        shift_k = shift_k.copy()
        shift_k[inside] = np.nan
    return degc - shift_k


def with_gap(levels: SensorLevels, from_s: float, to_s: float, sensors: GroupArray) -> SensorLevels:
    """Return the levels when nothing is known of sensors (indices) between two times [s]."""
    return replace(levels, gaps=_latest((*levels.gaps, (from_s, to_s, tuple(sensors.tolist())))))


def _latest(gaps: Gaps) -> Gaps:
    """Return the latest gaps, and of those before them what begins at the beginning: it may end in a long history."""
    return (*(gap for gap in gaps[:-GAPS_KEPT] if gap[0] < BEGINNING_S / 2), *gaps[-GAPS_KEPT:])


def gone_on(before: SensorLevels, now: SensorLevels, since_s: float) -> SensorLevels:
    """Return the levels after a cycle of an input that had stood since a time [s] and goes on.

    A sensor that is right with it has jumped back; the jump of any other is what was missed, and nothing of the past.

    `before`, `now`: levels before and after the cycle.
    """
    wrong_k = now.lasting_k + now.uncertainty_k
    missed = {each for each in set(now.jumps).difference(before.jumps) if abs(wrong_k[each[1]]) > OWN_K}
    jumps, away_s = [each for each in now.jumps if each not in missed], dict(now.away_s)
    for _, index, by_k in missed:
        away_s.setdefault(index, _wrong_since_s(jumps, index, wrong_k[index] - by_k, since_s))
    return replace(now, jumps=tuple(jumps), away_s=MappingProxyType(away_s))


def jumped_k(before: SensorLevels, now: SensorLevels) -> FloatArray | None:
    """Return by how much sensors have jumped from one cycle to the next [K], shape (n_sensors,); None where none has.

    `before`, `now`: levels before and after a cycle.
    """
    if now.jumps is before.jumps:
        return None
    jump_k = np.zeros(len(now.shift_k))
    for _, index, by_k in set(now.jumps).difference(before.jumps):
        jump_k[index] += by_k
    return jump_k


def undone(before: SensorLevels, now: SensorLevels) -> list[int]:
    """Return the indices of sensors that are themselves again, and were not since they had last come back.

    `before`, `now`: levels before and after a cycle.
    """
    return [] if now.gaps is before.gaps else [i for *_, of in set(now.gaps).difference(before.gaps) for i in of]


def _with_leaving(levels: SensorLevels, seen: BelievedValues) -> SensorLevels:
    """Keep for those that are too old from now on all temperatures of when their value last counted."""
    leaving = np.flatnonzero(seen.stale & np.isfinite(levels.degc))
    if not len(leaving):
        return levels
    left, moments = dict(levels.left), {}
    for index in leaving.tolist():
        after = (k for k, then in enumerate(levels.recent) if then[0] >= seen.at_s[index])
        moment = next(after, None)
        if moment not in moments:
            moments[moment] = _left_at(levels, moment, float(seen.at_s[index]))
        left[index] = moments[moment]
    return replace(levels, left=MappingProxyType(left))


def _left_at(levels: SensorLevels, moment: int | None, at_s: float) -> Left:
    """Return how everything was, and how it was going, at one of the recent moments; None: at the time, after them."""
    at_s, degc = (at_s, levels.degc) if moment is None else levels.recent[moment]
    before = next((then for then in levels.recent if at_s - then[0] <= TREND_S), (at_s, degc))
    if (elapsed_s := at_s - before[0]) < SHORTEST_TREND_S:
        return Left(at_s=at_s, degc=degc, trend_k_per_min=np.zeros_like(degc))
    return Left(at_s=at_s, degc=degc, trend_k_per_min=np.nan_to_num((degc - before[1]) * 60.0 / elapsed_s))


def _judged(
    levels: SensorLevels, group: GroupArray, seen: BelievedValues, judged: BoolArray, degc: FloatArray
) -> tuple[SensorLevels, FloatArray]:
    shift_k, uncertainty_k, changes = levels.shift_k.copy(), levels.uncertainty_k.copy(), list(levels.changes)
    jumps, away_s, again = list(levels.jumps), dict(levels.away_s), dict[float, tuple[int, ...]]()
    counted = degc.copy()
    beside_degc = np.where(levels.uncertainty_k == 0.0, degc, np.nan)
    beside_degc[[*levels.left, *seen.indices[judged].tolist()]] = np.nan
    for place in np.flatnonzero(judged):
        index = int(seen.indices[place])
        off_k, spread_k, near_k = float(seen.jump_k[place]), np.inf, OWN_K
        if seen.jump_k[place] == 0.0 and (then := levels.left.get(index)) is not None:
            common = abs(_common_k(then, seen.indices, degc, seen.now_s)) > OWN_K
            others_degc = beside_degc if common else degc  # with one error those that were away too prove nothing
            off_k, spread_k, near_k = _departure(index, then, group, others_degc, degc[index], seen.now_s)
        elif seen.returned[place]:
            continue
        before_k, wrong_k = shift_k[index], levels.lasting_k[index] + uncertainty_k[index] + off_k
        if abs(off_k) <= near_k:
            continue
        rest_k = 0.0 if abs(before_k + off_k) <= near_k else before_k + off_k
        if abs(rest_k) < abs(before_k) / 2.0 and (
            rest_k == 0.0 or seen.jump_k[place] != 0.0
        ):  # the rest changed meanwhile
            shift_k[index], most_k = rest_k, UNKNOWN_K if index in away_s else abs(rest_k)
            uncertainty_k[index] = np.clip(uncertainty_k[index], -most_k, most_k)
        elif before_k == 0.0 != uncertainty_k[index] and abs(uncertainty_k[index] + off_k) <= near_k:
            uncertainty_k[index] = 0.0
        elif not (seen.returned[place] and seen.new_level[place]):
            uncertainty_k[index] += off_k
        else:
            shift_k[index] += off_k
            uncertainty_k[index] += np.copysign(min(max(spread_k, near_k), abs(off_k)), off_k)
        if shift_k[index] != before_k:
            changes.append((seen.now_s, index, float(before_k)))
            counted[index] = seen.degc[place] - shift_k[index]
        elif abs(wrong_k) <= near_k and index in away_s:
            from_s = away_s.pop(index)
            again[from_s] = (*again.get(from_s, ()), index)
            jumps = [each for each in jumps if each[1] != index or each[0] <= from_s]
        elif abs(wrong_k) <= near_k or not seen.returned[place]:
            jumps.append((seen.now_s, index, off_k))
        else:
            away_s.setdefault(index, _wrong_since_s(jumps, index, wrong_k - off_k, levels.left[index].at_s))
    kept, righted = max(CHANGES_KEPT, OF_EACH * len(shift_k)), tuple((at, seen.now_s, of) for at, of in again.items())
    found = replace(levels, shift_k=shift_k, uncertainty_k=uncertainty_k, changes=tuple(changes[-kept:]))
    gaps = _latest((*levels.gaps, *righted)) if righted else levels.gaps
    return replace(found, jumps=tuple(jumps[-kept:]), gaps=gaps, away_s=MappingProxyType(away_s)), counted


def _wrong_since_s(jumps: list[tuple[float, int, float]], index: int, wrong_k: float, left_s: float) -> float:
    """Return since when a sensor was wrong that left at a time [s], which is that time where it was right then.

    `wrong_k`: by how much it was wrong then [K].
    """
    since_s = left_s
    for at_s, of, by_k in reversed(jumps):
        if abs(wrong_k) > OWN_K and of == index:
            since_s, wrong_k = at_s - JUST_S, wrong_k - by_k
    return since_s if abs(wrong_k) <= OWN_K else left_s


def _expected_degc(then: Left, now_s: float) -> FloatArray:
    going_on_s = TREND_FADES_S * -math.expm1(-max(now_s - then.at_s, 0.0) / TREND_FADES_S)
    return np.asarray(then.degc + then.trend_k_per_min * going_on_s / 60.0)


def _common_k(then: Left, line: GroupArray, degc: FloatArray, now_s: float) -> float:
    """Return by how much a line's sensors have departed in common [K].

    What its sensors do alike, whatever they sit on, no warming does: a whole line may come back with one error.
    """
    change_k = (degc - _expected_degc(then, now_s))[line]
    known = change_k[np.isfinite(change_k)]
    return float(np.median(known)) if len(known) else 0.0


def _departure(
    index: int, then: Left, group: GroupArray, others_degc: FloatArray, own_degc: float, now_s: float
) -> tuple[float, float, float]:
    """Return how far a sensor is from where it is expected, how far those beside it are, and how near is near [K].

    `others_degc`: of those that may explain it, NaN for the rest.
    """
    away_min = (now_s - then.at_s) / 60.0
    expected_degc = _expected_degc(then, now_s)
    change_k = others_degc - expected_degc
    own_k = float(own_degc - expected_degc[index])
    known = np.isfinite(change_k)
    known[index] = False
    beside_k = change_k[known & (group == group[index])]
    if len(beside_k) < LEAST_BESIDE:
        beside_k = change_k[known]
    expected_k = float(np.median(beside_k)) if len(beside_k) else 0.0
    spread_k = ALONE_K_PER_MIN * max(away_min, 0.0)
    if len(beside_k) >= LEAST_BESIDE:
        spread_k = float(np.abs(beside_k - expected_k).max())
    near_k = OWN_K + OWN_SHARE * abs(expected_k)
    alike = known & (group == group[index]) & (np.abs(change_k - own_k) <= OWN_K)
    if alike.any():  # what another one on its component did too is explained
        return float(np.clip(own_k - expected_k, -near_k, near_k)), spread_k, near_k
    return own_k - expected_k, spread_k, near_k
