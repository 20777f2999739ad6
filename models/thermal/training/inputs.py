"""What models with lags are fitted on: temperatures, their lags, lagged spindle speed, and displacements, row by row.

Rows of several recordings stand in one table. A run is a stretch without a long gap; its lags begin
as if its first row had lasted for ever, and the zero of its displacements is its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.recordings.jumps import remove_sudden_jumps
from models.records import FloatArray
from models.thermal.features import BRIDGE_MIN, BoolArray, IntArray, Layout, feature_table

TEMPERATURE_LAGS_MIN = (10.0, 30.0, 90.0, 240.0)
"""Time constants of the lags of temperatures [min]."""
SPEED_LAGS_MIN = (3.0, 10.0, 30.0, 90.0, 240.0)
"""Time constants of the lags of spindle speed and of its square [min]."""
NEW_RUN_MIN = 60.0
"""After a longer gap [min], and at least three rows, a run of its own begins."""
LARGEST_MISSING_SHARE = 0.2
"""A temperature that misses more of the training rows than this is left out of the model."""
SMALLEST_SPAN_K = 1e-6
"""A temperature that moves less in training [K] is constant."""
SHORTEST_MEAN_S = 60.0
"""A model of rows that lie farther apart is followed with means over this [s], or over what they were averaged to."""
JUMP_UM = 3.0
"""Larger jumps at spindle on/off are taken out of displacements that are trained on [um] (section 3.3.1)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """All rows of one or more recordings, averaged, with what models are fitted on."""

    recording_names: tuple[str, ...]
    sensor_names: tuple[str, ...]
    channels: tuple[str, ...]
    layout: Layout
    recording: IntArray
    """Index of the recording of each row, shape (n,)."""
    run: IntArray
    """Index of the run of each row, shape (n,), increasing."""
    time_min: FloatArray
    """Time since the recording's first row [min], shape (n,)."""
    speed_rpm: FloatArray | None
    """Spindle speed [1/min], shape (n,), bridged; None when a recording has none."""
    speed_missing: BoolArray
    """Rows in which spindle speed was not known, shape (n,)."""
    degc: FloatArray
    """Temperatures [degC], shape (n, n_sensors), bridged: always finite."""
    missing: BoolArray
    """Where a temperature was not measured, shape (n, n_sensors)."""
    long_missing: BoolArray
    """Of these, where it was missing for longer than is bridged."""
    features: FloatArray
    """Temperatures, their lags and lagged speed, shape (n, layout.columns)."""
    measured_um: FloatArray
    """Displacements as measured [um], shape (n, n_channels), NaN where missing."""
    cleansed_um: FloatArray
    """Displacements without jumps at spindle on/off, for training."""
    speed_scale_rpm: float
    """Speed that stands for 1 in the features [1/min]."""
    sample_s: float
    """Recordings of rows closer together were averaged to this time between rows [s]."""
    axis_positions: tuple[str, ...] = ()
    """The last of `sensor_names`, when they are axis positions [mm]."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.time_min)

    @property
    def period_min(self) -> float:
        """Median time between rows [min]."""
        return self.step_min(np.ones(self.rows, dtype=np.bool_))

    @property
    def mean_s(self) -> float:
        """Time over which a model of these rows must have means on line [s].

        Rows that lie farther apart than they were averaged over say what was at one instant, or nobody knows over how
        long. A mean over all of the time between them is late by half of that, and what moved lies behind.
        """
        return min(60.0 * self.period_min, max(self.sample_s, SHORTEST_MEAN_S))

    def step_min(self, rows: BoolArray) -> float:
        """Median time between some rows of a recording [min]; `rows`, shape (n,)."""
        steps = np.diff(self.time_min[rows])[np.diff(self.recording[rows]) == 0]
        return float(np.median(steps)) if len(steps) else float("nan")

    def rows_between(self, from_hours: float, to_hours: float) -> BoolArray:
        """Return which rows lie in ``from_hours <= time < to_hours`` of their recording."""
        return (self.time_min >= 60.0 * from_hours - 1e-9) & (self.time_min < 60.0 * to_hours - 1e-9)

    def trainable(self) -> BoolArray:
        """Return which rows have everything that a fit needs, shape (n,)."""
        known = np.isfinite(self.cleansed_um).all(axis=1) & ~self.long_missing.any(axis=1)
        return np.asarray(known & ~self.speed_missing)


def build_inputs(
    recordings: Sequence[Recording],
    *,
    sample_s: float,
    lags_min: tuple[float, ...] = TEMPERATURE_LAGS_MIN,
    speed_lags_min: tuple[float, ...] = SPEED_LAGS_MIN,
) -> Inputs:
    """Return the rows of recordings with their lags.

    Result: with as many rows as the averaged recordings have. Raises DatasetError when the recordings do not have the
    same columns or sampling.

    `recordings`: with the same columns; each counts its time from its own first row. Spindle speed is used when all of
    them have it. `sample_s`: they are averaged to this time between rows [s]. `lags_min`, `speed_lags_min`: time
    constants [min].
    """
    require_same_columns(recordings)
    averaged = averaged_recordings(recordings, sample_s)
    with_speed = all(r.speed_rpm is not None and np.isfinite(r.speed_rpm).any() for r in averaged)
    scale_rpm = 1.0
    if with_speed:
        scale_rpm = max(float(np.nanmax(np.abs(r.speed_rpm))) for r in averaged if r.speed_rpm is not None) or 1.0
    layout = Layout(
        sensors=len(averaged[0].temperature_names),
        lags_min=lags_min,
        speed_lags_min=speed_lags_min if with_speed else (),
    )
    parts = [_one(recording, layout, with_speed, scale_rpm) for recording in averaged]
    cleansed = [_without_jumps(raw).downsampled(sample_s).displacements_um for raw in recordings]
    runs = np.concatenate(
        [part.run + sum(int(p.run[-1]) + 1 for p in parts[:i] if len(p.run)) for i, part in enumerate(parts)]
    )
    return Inputs(
        recording_names=tuple(recording.name for recording in recordings),
        sensor_names=averaged[0].temperature_names,
        channels=averaged[0].displacement_names,
        layout=layout,
        recording=np.repeat(np.arange(len(averaged)), [recording.rows for recording in averaged]),
        run=runs,
        time_min=np.concatenate([recording.time_s for recording in averaged]) / 60.0,
        speed_rpm=np.concatenate([part.speed_rpm for part in parts]) if with_speed else None,
        speed_missing=np.concatenate([part.speed_missing for part in parts]),
        degc=np.vstack([part.degc for part in parts]),
        missing=np.vstack([~np.isfinite(recording.temperatures_degc) for recording in averaged]),
        long_missing=np.vstack([part.long_missing for part in parts]),
        features=np.vstack([part.features for part in parts]),
        measured_um=np.vstack([recording.displacements_um for recording in averaged]),
        cleansed_um=np.vstack(cleansed),
        speed_scale_rpm=scale_rpm,
        sample_s=sample_s,
        axis_positions=averaged[0].axis_positions,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Part:
    run: IntArray
    degc: FloatArray
    long_missing: BoolArray
    speed_rpm: FloatArray
    speed_missing: BoolArray
    features: FloatArray


def _one(recording: Recording, layout: Layout, with_speed: bool, scale_rpm: float) -> _Part:
    time_min = recording.time_s / 60.0
    period_min = float(np.median(np.diff(time_min))) if len(time_min) > 1 else 0.0
    run = np.concatenate([[0], np.cumsum(np.diff(time_min) > max(NEW_RUN_MIN, 3.0 * period_min))]).astype(np.intp)
    degc, long_missing = bridged(time_min, recording.temperatures_degc)
    speed_rpm, speed_missing = np.zeros(recording.rows), np.zeros((recording.rows, 1), dtype=np.bool_)
    if with_speed and recording.speed_rpm is not None:
        table, speed_missing = bridged(time_min, recording.speed_rpm[:, None])
        speed_rpm = table[:, 0]
    features = np.empty((recording.rows, layout.columns))
    for index in range(int(run[-1]) + 1):
        rows = run == index
        features[rows] = feature_table(layout, time_min[rows], degc[rows], speed_rpm[rows], scale_rpm)
    return _Part(
        run=run,
        degc=degc,
        long_missing=long_missing,
        speed_rpm=speed_rpm,
        speed_missing=speed_missing[:, 0],
        features=features,
    )


def bridged(time_min: FloatArray, values: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return a table with straight lines over what is missing, and where it was missing for longer than is bridged.

    Result: finite values and the mask, both of shape (n, n_columns).

    `time_min`, shape (n,): increasing times [min]. `values`, shape (n, n_columns): NaN where missing; zeros come out of
    a column without any value.
    """
    filled = values.copy()
    longest_min = max(BRIDGE_MIN, 2.5 * float(np.median(np.diff(time_min)))) if len(time_min) > 1 else BRIDGE_MIN
    long_missing = np.zeros(values.shape, dtype=np.bool_)
    for column in range(values.shape[1]):
        known = np.flatnonzero(np.isfinite(values[:, column]))
        if len(known) == len(values):
            continue
        if not len(known):
            filled[:, column] = 0.0
            long_missing[:, column] = True
            continue
        filled[:, column] = np.interp(time_min, time_min[known], values[known, column])
        edges = np.searchsorted(known, np.arange(len(values)))
        after = np.where(edges < len(known), time_min[known[np.minimum(edges, len(known) - 1)]], np.inf)
        before = np.where(edges > 0, time_min[known[np.maximum(edges - 1, 0)]], -np.inf)
        long_missing[:, column] = ~np.isfinite(values[:, column]) & (after - before > longest_min)
    return filled, long_missing


def _without_jumps(recording: Recording) -> Recording:
    if recording.speed_rpm is None:
        return recording
    cleansed_um = remove_sudden_jumps(recording.time_s, recording.displacements_um, recording.speed_rpm, JUMP_UM)
    return replace(recording, displacements_um=cleansed_um)


def averaged_recordings(recordings: Sequence[Recording], sample_s: float) -> list[Recording]:
    """Return recordings averaged to a time between rows [s].

    Raises DatasetError when averaging leaves no more rows than temperatures.
    """
    averaged = [recording.downsampled(sample_s) for recording in recordings]
    before, left = sum(r.rows for r in recordings), sum(r.rows for r in averaged)
    if averaged and left < before and left <= len(averaged[0].temperature_names):
        raise DatasetError(
            f"{recordings[0].name}: averaged to sample_s {sample_s:g} s, {left} of {before} rows remain, too few for "
            f"{len(averaged[0].temperature_names)} temperatures: the recordings last "
            f"{sum(float(np.ptp(r.time_s)) for r in recordings):.3g} s in all. Where the time counts minutes, hours or "
            "days, say so in the map (time_unit: min, h or d); else lower sample_s in the map"
        )
    return averaged


def require_same_columns(recordings: Sequence[Recording]) -> None:
    """Raise DatasetError unless there is a recording and all have the same columns."""
    if not recordings:
        raise DatasetError("there is no recording to train on")
    first = recordings[0]
    for other in recordings[1:]:
        for kind in ("temperature_names", "displacement_names", "axis_positions"):
            if (mine := getattr(first, kind)) != (theirs := getattr(other, kind)):
                differing = sorted(set(mine) ^ set(theirs)) or ["their order"]
                raise DatasetError(
                    f"{first.name} and {other.name} have different {kind.replace('_', ' ')}: {', '.join(differing[:8])}"
                )
        if first.pivots_mm != other.pivots_mm:
            raise DatasetError(
                f"{first.name} and {other.name} tell slopes about different pivots: {dict(first.pivots_mm)} and "
                f"{dict(other.pivots_mm)}; give one pivot_mm in the map"
            )


def unusable_sensors(inputs: Inputs, rows: BoolArray) -> dict[str, str]:
    """Return the temperatures that no model may be fitted on in these rows, and why."""
    found = {}
    for sensor, name in enumerate(inputs.sensor_names):
        missing = inputs.missing[rows, sensor]
        if missing.mean() > LARGEST_MISSING_SHARE:
            found[name] = f"{missing.mean():.0%} of its training rows are missing"
        elif np.ptp(inputs.degc[rows, sensor]) < SMALLEST_SPAN_K:
            found[name] = f"constant at {inputs.degc[rows, sensor][0]:g} in training"
    return found


def temperatures_alone(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings without axis positions; those come last, so that sensors keep their indices."""
    return [with_sensors(recording, recording.temperature_names[: recording.sensors]) for recording in recordings]


def with_sensors(recording: Recording, names: Sequence[str]) -> Recording:
    """Return the recording with the named temperatures only, in that order."""
    columns = [recording.temperature_names.index(name) for name in names]
    return replace(
        recording,
        temperature_names=tuple(names),
        temperatures_degc=recording.temperatures_degc[:, columns],
        axis_positions=tuple(name for name in names if name in recording.axis_positions),
    )
