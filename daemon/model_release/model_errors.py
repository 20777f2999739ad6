"""What probes and displacements of the history say of the models: the error, and what the estimate left of it.

Of a probe measured minus what is applied beyond the baseline. Of displacements as training takes them, since the first
minute of a stretch under one model and one reference, because their zero says nothing. On an axis with a slope every
place has its own first minute; what is not known there is counted, and not judged.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby, pairwise
from typing import Any, Literal

import numpy as np

from config.schema import Configuration
from daemon.history.columns.kinds import ESTIMATES
from daemon.history.reader import HistoryReader
from daemon.model_release.past_recordings import (
    LEAST_MIN,
    LONGEST_GAP_MIN,
    MINUTE_S,
    Minutes,
    means,
    minutes_of_history,
    used_channels,
)
from drivers.guard.sloped_axes import SAME_PLACE_MM, SlopedAxis, added_um, sloped_axes
from models.records import FloatArray, ProbeSample
from models.thermal.drift import WEEK_D, judge_drift, weekly_shares
from models.thermal.features import BoolArray

DAY_S = 86_400.0
BEFORE_S, CYCLES = 60.0, 2.0
"""The guard's echo, and the estimate in force, are looked for so long before a reference or a probe, the estimate for
so many cycles of the temperatures where that is longer."""
WARM_UP_S = 30 * DAY_S
"""References are looked for so long before the first probe."""
STEP_MIN = 10
"""Of displacements every tenth minute counts: they are means of a minute and change slowly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredError:
    """One probe value or minute of displacements, as far as it tells of the model."""

    source: Literal["probe", "displacement"] = "probe"
    utc_s: float
    axis: str
    model_id: str
    with_um: float
    """What the machine still had, with what was applied."""
    without_um: float
    """What it would have had without compensation since the reference, or since displacements were measured."""
    left_um: float
    """What the estimate alone leaves of that."""


def measured_errors(
    configuration: Configuration,
    reader: HistoryReader,
    um_per_unit: Mapping[str, float] | None,
    *,
    from_utc_s: float,
    to_utc_s: float,
    unjudged: Counter[tuple[str, str]] | None = None,
) -> list[MeasuredError]:
    """Return what was measured in a time, in its order; `um_per_unit`: see `commissioned_um_per_unit`.

    `unjudged` counts what cannot be judged because it is not known where an axis with a slope stood: axis, and why.
    """
    unjudged, sloped = Counter() if unjudged is None else unjudged, sloped_axes(configuration)
    found = _of_probes(configuration, reader, um_per_unit, from_utc_s, to_utc_s, unjudged)
    channels = used_channels(configuration)
    slopes = {name: configuration.compensation.axes[one.slope].estimate or "" for name, one in sloped.items()}
    pieces = minutes_of_history(configuration, reader, channels, um_per_unit, from_utc_s, to_utc_s, temperatures=False)
    estimated = [_Estimated.of_piece(reader, piece, channels, slopes) for piece in (pieces if channels else ())]
    for column, axis in enumerate(channels.values()):
        found += _of_displacements(estimated, column, axis)
        lost = sum(int(each.lost[:, column].sum()) for each in estimated)
        if axis in sloped and lost:
            unjudged[axis, sloped[axis].why_unknown()] += lost
    return sorted(found, key=lambda each: each.utc_s)


def _of_probes(
    configuration: Configuration,
    reader: HistoryReader,
    um_per_unit: Mapping[str, float] | None,
    from_utc_s: float,
    to_utc_s: float,
    unjudged: Counter[tuple[str, str]],
) -> list[MeasuredError]:
    sloped = sloped_axes(configuration)
    probes = [each for each in reader.probes(from_utc_s, to_utc_s) if each.accepted and each.reference_id is not None]
    references = {each.reference_id: each.time.utc_s for each in reader.references(from_utc_s - WARM_UP_S, to_utc_s)}
    found: list[MeasuredError] = []
    for reference_id, group in groupby(probes, key=lambda probe: str(probe.reference_id)):
        set_utc_s, baseline = references.get(reference_id), dict[str, float]()
        if um_per_unit is not None and set_utc_s is not None:
            baseline = _echo(configuration, reader, um_per_unit, set_utc_s)
        for probe in group:
            model_id = _model_in_force(configuration, reader, probe.time.utc_s)
            start_um = 0.0 if um_per_unit is None else baseline.get(probe.axis, np.nan)
            each = _of_probe(probe, model_id, start_um)
            if not model_id or not np.isfinite([each.without_um, each.left_um]).all():
                continue
            if (one := sloped.get(probe.axis)) is not None:
                added = _added_there(configuration, reader, um_per_unit, one, probe, baseline)
                each = _of_probe(probe, model_id, start_um, *added)
                if not np.isfinite(added).all():
                    unjudged[probe.axis, one.why_unknown()] += 1
                    continue
            found.append(each)
    return found


def _added_there(
    configuration: Configuration,
    reader: HistoryReader,
    um_per_unit: Mapping[str, float] | None,
    one: SlopedAxis,
    probe: ProbeSample,
    baseline: Mapping[str, float],
) -> tuple[float, float]:
    """Return what the slope of a probed axis added to estimate and compensation where it stood [um], NaN if unknown."""
    utc_s, applied_per_m = probe.time.utc_s, 0.0
    if um_per_unit is not None:
        echo = _echo(configuration, reader, um_per_unit, utc_s)
        applied_per_m = echo.get(one.slope, np.nan) - baseline.get(one.slope, np.nan)
    positions = reader.cnc(utc_s - BEFORE_S, utc_s + 1.0).positions_mm.get(one.position or "", np.empty(0))
    along_m = float(one.along_m(positions[-1] if len(positions) else np.nan))
    frame = reader.frame(ESTIMATES, _estimated_since_utc_s(configuration, utc_s), utc_s + 1.0, {"thermal_error_um"})
    channel = configuration.compensation.axes[one.slope].estimate or ""
    said = frame.mapping("thermal_error_um").values.get(channel, np.zeros(0)) if frame.rows else np.zeros(0)
    per_m = float(np.nan_to_num(said[-1])) if len(said) else 0.0
    applied_um = added_um(applied_per_m, along_m if one.follows else np.nan)
    return float(added_um(per_m, along_m)), float(applied_um)


def _of_probe(
    probe: ProbeSample, model_id: str, baseline_um: float, estimated_um: float = 0.0, applied_um: float = 0.0
) -> MeasuredError:
    """Return what a probe tells; `estimated_um`, `applied_um`: what a slope adds to both where the axis stood."""
    without_um = probe.deviation_um - (probe.applied_um - baseline_um) - applied_um
    return MeasuredError(
        utc_s=probe.time.utc_s,
        axis=probe.axis,
        model_id=model_id,
        with_um=probe.deviation_um,
        without_um=without_um,
        left_um=without_um - probe.thermal_error_um - estimated_um,
    )


def _echo(
    configuration: Configuration, reader: HistoryReader, um_per_unit: Mapping[str, float], utc_s: float
) -> dict[str, float]:
    """Return what the guard had applied at a time by axis [um]; nothing where no poll was kept."""
    cnc = reader.cnc(utc_s - BEFORE_S, utc_s + 1.0)
    if not len(cnc.time_s):
        return {}
    macros = configuration.cnc.macros.echo_applied
    known = {axis: cnc.macros.get(macros[axis]) for axis in um_per_unit if axis in macros}
    return {axis: float(values[-1]) * um_per_unit[axis] for axis, values in known.items() if values is not None}


def _estimated_since_utc_s(configuration: Configuration, utc_s: float) -> float:
    """Return since when the estimate that was in force at a time may have been made."""
    return utc_s - max(BEFORE_S, CYCLES * configuration.temperatures.shortest_period_s)


def _model_in_force(configuration: Configuration, reader: HistoryReader, utc_s: float) -> str:
    """Return which model made the estimate at a time, '' where none was kept."""
    frame = reader.frame(ESTIMATES, _estimated_since_utc_s(configuration, utc_s), utc_s + 1.0, {"model_id"})
    return str(frame.texts("model_id")[-1]) if frame.rows else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Estimated:
    """Minutes in which displacements were measured, and what was estimated in them."""

    minutes: Minutes
    um: FloatArray
    """Shape (n, n_channels); on an axis with a slope where it stood."""
    lost: BoolArray
    """Where something was measured and estimated, and neither is known where the axis stood."""
    of: list[tuple[str, str, str]]
    """File of the displacements, model and reference of each minute, '' where there was no estimate."""

    @classmethod
    def of_piece(
        cls, reader: HistoryReader, minutes: Minutes, channels: Mapping[str, str], slopes: Mapping[str, str]
    ) -> "_Estimated":
        """`channels`: axis by channel; `slopes`: channel of the slope by its axis."""
        first, count = int(minutes.minute[0]), len(minutes.minute)
        names = {"thermal_error_um", "model_id", "reference_id"}
        frame = reader.frame(ESTIMATES, MINUTE_S * first, MINUTE_S * (first + count), names)
        time_s, values = frame.integers("utc_ms") / 1e3, frame.mapping("thermal_error_um").values
        none = np.full(frame.rows, np.nan)
        names_of_slopes = [slopes.get(axis, "") for axis in channels.values()]
        um, per_m = (
            means(time_s, np.array([values.get(n, none) for n in names]).reshape(len(channels), -1).T, first, count)
            for names in (channels, names_of_slopes)
        )
        there_um = um + added_um(np.nan_to_num(per_m), minutes.along_m)
        lost = minutes.measured & np.isfinite(um) & ~np.isfinite(there_um + minutes.own_um)
        under = zip(frame.texts("model_id"), frame.texts("reference_id"), strict=True)
        known = dict(zip((time_s // MINUTE_S).astype(int).tolist(), under, strict=True))
        of_minute = [known.get(first + number, ("", "")) for number in range(count)]
        named = zip(minutes.file, of_minute, strict=True)
        of = [(file, model or "", reference or "") for file, (model, reference) in named]
        return cls(minutes=minutes, um=there_um, lost=lost, of=of)


def _of_displacements(pieces: Sequence[_Estimated], column: int, axis: str) -> Iterator[MeasuredError]:
    """Yield what displacements of one channel say, of every stretch that is long enough to train on."""
    if not pieces:
        return
    minute = np.concatenate([each.minutes.minute for each in pieces])
    own_um = np.concatenate([each.minutes.own_um[:, column] for each in pieces])
    applied_um = np.concatenate([each.minutes.applied_um[:, column] for each in pieces])
    estimated_um = np.concatenate([each.um[:, column] for each in pieces])
    along_m = np.concatenate([each.minutes.along_m[:, column] for each in pieces])
    places = np.round(np.nan_to_num(along_m, nan=np.inf) * 1e3 / SAME_PLACE_MM)
    of = [each for piece in pieces for each in piece.of]
    known = np.isfinite(own_um) & np.isfinite(estimated_um) & np.array([bool(model) for _, model, _ in of])
    rows = np.flatnonzero(known)
    breaks = [
        number
        for number, (before, row) in enumerate(pairwise(rows.tolist()), 1)
        if minute[row] - minute[before] > LONGEST_GAP_MIN or of[row] != of[before]
    ]
    for run in np.split(rows, breaks):
        if not len(run) or minute[run[-1]] - minute[run[0]] + 1 < LEAST_MIN:
            continue
        _, first, of_place = np.unique(places[run], return_index=True, return_inverse=True)
        zero = run[first[of_place]]
        without_um = own_um[run] - own_um[zero]
        left_um = without_um - (estimated_um[run] - estimated_um[zero])
        with_um = without_um + applied_um[run] - applied_um[zero]
        due = minute[run[0]] + STEP_MIN
        for number in range(len(run)):
            if minute[run[number]] < due:
                continue
            due = minute[run[number]] + STEP_MIN
            if run[number] == zero[number]:
                continue
            yield MeasuredError(
                source="displacement",
                utc_s=MINUTE_S * float(minute[run[number]]),
                axis=axis,
                model_id=of[run[number]][1],
                with_um=float(with_um[number]),
                without_um=float(without_um[number]),
                left_um=float(left_um[number]),
            )


def in_force(found: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return those of `drift_document` that tell of the model of which each axis was measured last."""
    latest = {each["axis"]: each["model_id"] for each in found}
    return [each for each in found if each["model_id"] == latest[each["axis"]]]


def drift_document(
    errors: Sequence[MeasuredError], *, bound: float | None, least_error_um: float
) -> list[dict[str, Any]]:
    """Return per axis, model and source, the latest last, the weeks and what they tell; JSON but for its NaN."""
    by_key: dict[tuple[str, str, str], list[MeasuredError]] = {}
    for each in errors:
        by_key.setdefault((each.axis, each.model_id, each.source), []).append(each)
    found = []
    for key, own in sorted(by_key.items(), key=lambda item: item[1][-1].utc_s):
        columns = (np.array([getattr(e, name) for e in own]) for name in ("utc_s", "without_um", "left_um"))
        time_s, without_um, left_um = columns
        middles, shares = weekly_shares(time_s / DAY_S, without_um, left_um, least_error_um)
        drift = judge_drift(time_s / DAY_S, without_um, left_um, bound=bound, least_error_um=least_error_um)
        weeks = [
            {"from_utc_s": DAY_S * (middle - WEEK_D / 2.0), "share_left": share}
            for middle, share in zip(middles.tolist(), shares.tolist(), strict=True)
        ]
        found.append(
            {
                "axis": key[0],
                "model_id": key[1],
                "source": key[2],
                "values": len(own),
                "rms_um": {name: _rms(own, name) for name in ("with_um", "without_um", "left_um")},
                "weeks": weeks,
                "drift": None if drift is None else asdict(drift),
                "retrain": drift is not None and drift.retrain,
            }
        )
    return found


def _rms(errors: Sequence[MeasuredError], name: str) -> float:
    return float(np.sqrt(np.mean([getattr(each, name) ** 2 for each in errors])))
