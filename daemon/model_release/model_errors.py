"""What probes of the history say of the models: the error since the reference, and what the estimate left of it.

As the output's own watch counts it: measured minus what is applied beyond the baseline, which is what the guard had
applied when the work's reference was set.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from config.schema import Configuration
from daemon.history.columns.kinds import ESTIMATES
from daemon.history.reader import HistoryReader
from models.records import ProbeSample
from models.thermal.drift import WEEK_D, judge_drift, weekly_shares

DAY_S = 86_400.0
BEFORE_S = 60.0
"""The guard's echo, and the model in force, are looked for so long before a reference or a probe."""
WARM_UP_S = 30 * DAY_S
"""References are looked for so long before the first probe."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredError:
    """One probe value, as far as it tells of the model."""

    utc_s: float
    axis: str
    model_id: str
    with_um: float
    """What the machine still had, with what was applied."""
    without_um: float
    """What it would have had since the reference without compensation."""
    left_um: float
    """What the estimate alone leaves of that."""


def measured_errors(
    configuration: Configuration,
    reader: HistoryReader,
    um_per_unit: Mapping[str, float] | None,
    *,
    from_utc_s: float,
    to_utc_s: float,
) -> list[MeasuredError]:
    """Return the accepted probe values of a time; `um_per_unit`: see `commissioned_um_per_unit`."""
    probes = [each for each in reader.probes(from_utc_s, to_utc_s) if each.accepted and each.reference_id is not None]
    references = {each.reference_id: each.time.utc_s for each in reader.references(from_utc_s - WARM_UP_S, to_utc_s)}
    found: list[MeasuredError] = []
    for reference_id, group in groupby(probes, key=lambda probe: str(probe.reference_id)):
        set_utc_s, baseline = references.get(reference_id), dict[str, float]()
        if um_per_unit is not None and set_utc_s is not None:
            baseline = _echo(configuration, reader, um_per_unit, set_utc_s)
        for probe in group:
            model_id = _model_in_force(reader, probe.time.utc_s)
            start_um = 0.0 if um_per_unit is None else baseline.get(probe.axis, np.nan)
            each = _of_probe(probe, model_id, start_um)
            if model_id and np.isfinite([each.without_um, each.left_um]).all():
                found.append(each)
    return found


def _of_probe(probe: ProbeSample, model_id: str, baseline_um: float) -> MeasuredError:
    without_um = probe.deviation_um - (probe.applied_um - baseline_um)
    return MeasuredError(
        utc_s=probe.time.utc_s,
        axis=probe.axis,
        model_id=model_id,
        with_um=probe.deviation_um,
        without_um=without_um,
        left_um=without_um - probe.thermal_error_um,
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


def _model_in_force(reader: HistoryReader, utc_s: float) -> str:
    """Return which model made the estimate at a time, '' where none was kept."""
    frame = reader.frame(ESTIMATES, utc_s - BEFORE_S, utc_s + 1.0, {"model_id"})
    return str(frame.texts("model_id")[-1]) if frame.rows else ""


def drift_document(
    errors: Sequence[MeasuredError], *, bound: float | None, least_error_um: float
) -> list[dict[str, Any]]:
    """Return per axis and model, the latest last, the weeks and what they tell; ready for JSON but for its NaN."""
    found = []
    for key in dict.fromkeys((each.axis, each.model_id) for each in errors):
        own = [each for each in errors if (each.axis, each.model_id) == key]
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
                "probes": len(own),
                "rms_um": {name: _rms(own, name) for name in ("with_um", "without_um", "left_um")},
                "weeks": weeks,
                "drift": None if drift is None else asdict(drift),
                "retrain": drift is not None and drift.retrain,
            }
        )
    return found


def _rms(errors: Sequence[MeasuredError], name: str) -> float:
    return float(np.sqrt(np.mean([getattr(each, name) ** 2 for each in errors])))
