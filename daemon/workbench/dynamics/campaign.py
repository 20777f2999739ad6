"""An impact campaign: responses over time and temperatures -> regressions of the bearings on temperatures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from config.files import read_whole, sha256_of
from config.machine.spindle_chain import Spindle
from config.recordings.recording_map import RecordingMap, usual_map
from config.schema import Configuration
from daemon.workbench.dynamics.identifying import Band, refuse_levels
from daemon.workbench.dynamics.responses import properties
from drivers.files.frf_measurement import read_measurements
from drivers.files.impact_index import ImpactIndexError, first_time, read_index
from drivers.files.recording_csv import read_recording
from drivers.files.recording_lines import read_header
from drivers.files.recording_time import SECONDS
from models.dynamics.beam import ComplexArray
from models.dynamics.bearings import CondensedShaft, parameters_from_properties, parameters_of
from models.dynamics.identification import kept_parameters
from models.dynamics.measurement import Measurement, MeasurementError, average, check_for_identification
from models.dynamics.plausibility import check_frequencies
from models.errors import IdentificationError
from models.records import FloatArray
from models.thermomechanics.artifact import model_to_json
from models.thermomechanics.fitting import FittedProperty, MinuteSeries, fit_axis, minute_series
from models.thermomechanics.regression import Bounds, ThermomechanicalModel
from models.thermomechanics.selection import SignalSelection, select_signals
from models.thermomechanics.series import PropertySeries, identify_series

Progress = Callable[[str, int, int], None]
FEWEST_RESPONSES = 4
TIME_NAMES = ("t", "time", "time_s", "utc_s", "time_min", "time_h", "utc")
LONG_UNITS: dict[str, Literal["min", "h", "iso"]] = {"time_min": "min", "time_h": "h", "utc": "iso"}
NOT_TEMPERATURES = ("rpm", "speed", "speed_rpm", "spindle_speed_rpm")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Temperatures:
    """A recording as signals over time."""

    name: str
    start: float
    """First time in the unit of the time column."""
    seconds_per_unit: float
    time_min: FloatArray
    """Since the first row [min], shape (n,)."""
    signals: tuple[str, ...]
    degc: FloatArray
    """[degC], shape (n, signals)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Responses:
    """The responses of one run along one axis."""

    time_min: FloatArray
    """Since the first row of the recording [min], shape (k,)."""
    measured: tuple[Measurement, ...]
    files: tuple[Path, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One folder of responses with its recording."""

    folder: Path
    temperatures: Temperatures
    responses: dict[str, Responses]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CampaignResult:
    """Everything that a campaign said."""

    runs: tuple[Run, ...]
    frequency_hz: FloatArray
    series: dict[str, dict[int, list[PropertySeries]]]
    """Axis -> number of varied parameters -> one series per run; the regressions stand on the smallest."""
    minutes: dict[str, list[MinuteSeries]]
    """Axis -> per run, with the chosen signals."""
    selection: SignalSelection
    fitted: dict[str, dict[str, FittedProperty]]
    model: ThermomechanicalModel
    warnings: tuple[str, ...]


def read_run(folder: Path, recording: Path, configuration: Configuration | None, band: Band) -> Run:
    """Return a run with its responses cut to the band; raises a driver's error or MeasurementError."""
    temperatures = read_temperatures(recording, configuration)
    by_axis: dict[str, list[tuple[float, Measurement, Path]]] = {}
    for each in read_index(folder):
        minutes = (each.time - temperatures.start) * temperatures.seconds_per_unit / 60.0
        whole = average(read_measurements(each.path))
        measured = whole.between(band.from_hz, band.to_hz)
        try:
            if not band.trust_units and len(whole.frequency_hz):
                check_frequencies(whole.frequency_hz)
            check_for_identification(measured, 5, trust_units=band.trust_units)
        except MeasurementError as error:
            raise MeasurementError(f"{each.path}: {error}") from error
        by_axis.setdefault(each.axis, []).append((minutes, measured, each.path))
    for axis, found in by_axis.items():
        if len(found) < FEWEST_RESPONSES:
            raise ImpactIndexError(f"{folder}: {len(found)} responses along {axis}; at least {FEWEST_RESPONSES} needed")
        if wrong := [m for m, _, _ in found if not -1.0 <= m <= temperatures.time_min[-1] + 1.0]:
            raise ImpactIndexError(
                f"{folder}: a response along {axis} at {wrong[0]:.1f} min of {recording.name}, which lasts "
                f"{temperatures.time_min[-1]:.1f} min; times must be those of the recording"
            )
    return Run(
        folder=folder,
        temperatures=temperatures,
        responses={
            axis: Responses(
                time_min=np.array([m for m, _, _ in found]),
                measured=tuple(each for _, each, _ in found),
                files=tuple(path for _, _, path in found),
            )
            for axis, found in sorted(by_axis.items())
        },
    )


def read_temperatures(path: Path, configuration: Configuration | None) -> Temperatures:
    """Return a recording as signals: means by label with a configuration, columns without; raises a driver's error."""
    header = read_header(path)
    columns = _map(path, header)
    recording = read_recording(path, columns)
    names, degc = recording.temperature_names, recording.temperatures_degc
    if configuration is not None:
        names, degc = _labelled(path, configuration, names, degc)
    seconds = 1.0 if columns.time_unit == "iso" else SECONDS[columns.time_unit]
    start = first_time(path, columns.time)
    return Temperatures(
        name=path.name,
        start=start,
        seconds_per_unit=seconds,
        time_min=recording.time_s / 60.0,
        signals=names,
        degc=degc,
    )


def _map(path: Path, header: Sequence[str]) -> RecordingMap:
    """Return the usual map, or one of a recording that holds temperatures alone."""
    usual = [name for name in header if name[:1] in "tT" and name[1:].isdigit()]
    try:
        return usual_map(header)
    except ValueError:
        time = next((name for name in header if name in TIME_NAMES), None)
        if time is None:
            names = f"{', '.join(TIME_NAMES)}; its columns are {', '.join(header)}"
            raise ImpactIndexError(f"{path}: no column of the recording is a time, called {names}") from None
    others = usual or [name for name in header if name != time and name not in NOT_TEMPERATURES]
    if not others:
        raise ImpactIndexError(f"{path}: the recording has no temperatures; its columns are {', '.join(header)}")
    unit: Literal["s", "min", "h", "iso"] = "s"
    if time in LONG_UNITS:
        unit = LONG_UNITS[time]
    return RecordingMap.model_construct(
        time=time, time_unit=unit, speed=None, temperatures=others, displacements=[], sample_s=60.0
    )


def _labelled(
    path: Path, configuration: Configuration, names: tuple[str, ...], degc: FloatArray
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the means of the sensors of each label; columns are T1, T2 and so on by sensor number."""
    places = {name.upper(): index for index, name in enumerate(names)}
    found: dict[str, FloatArray] = {}
    sensors = configuration.temperatures.every_sensor
    for label, indices in configuration.temperatures.labels.items():
        columns = [places[f"T{sensors[i].id}"] for i in indices if f"T{sensors[i].id}" in places]
        if columns:
            table = degc[:, columns]
            known = np.isfinite(table)
            count = known.sum(axis=1)
            total = np.where(known, table, 0.0).sum(axis=1)
            found[label] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    if not found:
        raise ImpactIndexError(
            f"{path}: no column T1, T2 ... belongs to a labelled sensor of the configuration; label the sensors at the "
            "spindle, or leave --config out and take the columns as they are"
        )
    return tuple(found), np.stack(list(found.values()), axis=1)


def run_campaign(
    runs: Sequence[Run],
    spindle: Spindle,
    spindle_file: Path,
    bounds: dict[str, Bounds],
    *,
    signals: Sequence[str] | None,
    parameter_sets: Sequence[int] = (5,),
    vary: Sequence[str] = (),
    least_squares: bool = False,
    progress: Progress,
    trust_units: bool = False,
) -> CampaignResult:
    """Identify all responses and fit the regressions; raises IdentificationError, MeasurementError."""
    if not spindle.shaft.supports:
        raise IdentificationError(f"{spindle_file}: describes no bearings; give their positions and groups")
    axes, candidates = _common(runs)
    frequency_hz = runs[0].responses[axes[0]].measured[0].frequency_hz
    shaft = CondensedShaft(spindle.shaft, frequency_hz)
    if not trust_units:
        told = [each for run in runs for each in run.responses.values()]
        refuse_levels(shaft, [pair for each in told for pair in zip(each.files, each.measured, strict=True)])
    kept = _kept_sets(spindle, shaft, parameter_sets, vary)
    few = min(kept)
    series = {axis: _series(shaft, frequency_hz, runs, axis, kept, progress) for axis in axes}
    everything = {axis: _minutes(runs, series[axis][few], axis, candidates) for axis in axes}
    selection = _selected(candidates, everything, series)
    chosen = tuple(signals or selection.chosen)
    if unknown := sorted(set(chosen) - set(candidates)):
        raise ImpactIndexError(f"no recording has the signal {', '.join(unknown)}; there are {', '.join(candidates)}")
    places = [candidates.index(name) for name in chosen]
    minutes = {axis: [_only(each, places) for each in found] for axis, found in everything.items()}
    names = series[axes[0]][few][0].names
    fits = {
        axis: fit_axis(axis, chosen, names, minutes[axis], bounds, kept[few], least_squares=least_squares)
        for axis in axes
    }
    model = ThermomechanicalModel(
        model_id="",
        source="impact campaign: " + "; ".join(str(run.folder.name) for run in runs),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        rigid_rotary_inertia=spindle.rotary,
        spindle_sha256=sha256_of(read_whole(spindle_file)),
        axes={axis: fit[0] for axis, fit in fits.items()},
        training=tuple(_training(run) for run in runs),
        shaft_sha256=spindle.description.shaft_sha256(),
    )
    digest = sha256_of(model_to_json(model).encode("ascii"))
    return CampaignResult(
        runs=tuple(runs),
        frequency_hz=frequency_hz,
        series=series,
        minutes=minutes,
        selection=selection,
        fitted={axis: fit[1] for axis, fit in fits.items()},
        model=replace(model, model_id=f"bearings-{digest[:12]}"),
        warnings=_warnings(spindle, series),
    )


def _common(runs: Sequence[Run]) -> tuple[list[str], tuple[str, ...]]:
    axes = sorted(set.intersection(*(set(run.responses) for run in runs)))
    candidates = tuple(
        name for name in runs[0].temperatures.signals if all(name in run.temperatures.signals for run in runs)
    )
    if not axes or not candidates:
        raise ImpactIndexError("the runs have no axis, or no signal, in common; check axes, columns and labels")
    return axes, candidates


def _series(
    shaft: CondensedShaft,
    frequency_hz: FloatArray,
    runs: Sequence[Run],
    axis: str,
    kept: Mapping[int, Mapping[str, float]],
    progress: Progress,
) -> dict[int, list[PropertySeries]]:
    found: dict[int, list[PropertySeries]] = {}
    steps = len(runs) * len(kept)
    for parameters in sorted(kept):
        smaller = max((each for each in found), default=None)
        found[parameters] = []
        for index, run in enumerate(runs):
            told = run.responses[axis]
            responses = [_at(frequency_hz, each, run.folder) for each in told.measured]
            begin = None if smaller is None else found[smaller][index]
            found[parameters].append(identify_series(shaft, responses, told.time_min, kept[parameters], begin))
            progress(f"axis {axis}", sum(map(len, found.values())), steps)
    return found


def few(series: Mapping[int, list[PropertySeries]]) -> list[PropertySeries]:
    """Return the series with the fewest parameters varied, on which the regressions stand."""
    return series[min(series)]


def _kept_sets(
    spindle: Spindle, shaft: CondensedShaft, parameter_sets: Sequence[int], vary: Sequence[str]
) -> dict[int, Mapping[str, float]]:
    """Return number of varied parameters -> the kept ones with their values; raises IdentificationError."""
    stated = parameters_from_properties(properties(spindle))
    count = len(parameters_of(shaft.groups))
    found: dict[int, Mapping[str, float]] = {}
    for parameters in sorted(parameter_sets):
        kept = kept_parameters(shaft.groups, parameters, () if parameters == 12 else vary, stated)
        found[count - len(kept)] = kept
    return found


def _at(frequency_hz: FloatArray, measured: Measurement, folder: Path) -> ComplexArray:
    if not np.array_equal(measured.frequency_hz, frequency_hz):
        raise ImpactIndexError(f"{folder}: responses at different frequencies; measure a campaign with one setting")
    return measured.receptance_m_per_n


def _minutes(
    runs: Sequence[Run], series: Sequence[PropertySeries], axis: str, candidates: tuple[str, ...]
) -> list[MinuteSeries]:
    found = []
    for run, each in zip(runs, series, strict=True):
        columns = [run.temperatures.signals.index(name) for name in candidates]
        degc = run.temperatures.degc[:, columns]
        found.append(minute_series(each.time_min, each.values, run.temperatures.time_min, degc))
    return found


def _selected(
    candidates: tuple[str, ...],
    minutes: dict[str, list[MinuteSeries]],
    series: dict[str, dict[int, list[PropertySeries]]],
) -> SignalSelection:
    """Choose by all axes: correlations between the signals from all minutes, with the properties axis by axis."""
    parts = []
    for axis, found in minutes.items():
        degc = np.concatenate([each.degc for each in found])
        values = np.concatenate([each.values for each in found])
        parts.append(select_signals(candidates, degc, [f"{n} {axis}" for n in few(series[axis])[0].names], values))
    degc = np.concatenate([each.degc for found in minutes.values() for each in found])
    cross = np.concatenate([part.crosscorrelation for part in parts], axis=1)
    return select_signals(
        candidates, degc, [name for part in parts for name in part.properties], None, crosscorrelation=cross
    )


def _only(series: MinuteSeries, columns: Sequence[int]) -> MinuteSeries:
    past = {minutes: table[:, columns] for minutes, table in series.past_degc.items()}
    return replace(series, degc=series.degc[:, columns], past_degc=past)


def _training(run: Run) -> str:
    counts = ", ".join(f"{len(each.measured)} along {axis}" for axis, each in run.responses.items())
    return f"{run.folder.name}: {counts} responses, {run.temperatures.time_min[-1]:.0f} min of {run.temperatures.name}"


def _warnings(spindle: Spindle, series: dict[str, dict[int, list[PropertySeries]]]) -> tuple[str, ...]:
    found = list(spindle.warnings)
    for axis, sets in series.items():
        worst = max(float(each.log_error.max()) for each in few(sets))
        if worst > 0.5:
            found.append(
                f"axis {axis}: a response is not explained (mean |log(H/H_meas)| {worst:.2g}); check units and "
                "direction, or narrow the band to where the beam model holds"
            )
        shares = np.mean([each.identifiable for each in few(sets)], axis=0)
        unseen = [name for name, share in zip(few(sets)[0].names, shares, strict=True) if share < 0.5]
        if unseen:
            found.append(f"axis {axis}: most responses do not determine {', '.join(unseen)} on their own")
    return tuple(found)


def campaign_summary(result: CampaignResult) -> dict[str, Any]:
    """Return what `toolpoint dynamics campaign` prints."""
    return {
        "model_id": result.model.model_id,
        "rigid_rotary_inertia": result.model.rigid_rotary_inertia,
        "warnings": list(result.warnings),
        "signals": {
            "groups": [list(group) for group in result.selection.groups],
            "proposed": list(result.selection.chosen),
            "used": list(result.model.signals),
        },
        "axes": {axis: _axis_summary(result, axis) for axis in result.model.axes},
    }


def _axis_summary(result: CampaignResult, axis: str) -> dict[str, Any]:
    return {
        "responses": sum(len(each.time_min) for each in few(result.series[axis])),
        "minutes": sum(len(each.time_min) for each in result.minutes[axis]),
        "series": {
            str(count): [
                {
                    "run": run.folder.name,
                    "time_min": each.time_min.tolist(),
                    "values": {name: each.values[:, k].tolist() for k, name in enumerate(each.names)},
                    "log_error": each.log_error.tolist(),
                    "identifiable_share": dict(zip(each.names, each.identifiable.tolist(), strict=True)),
                }
                for run, each in zip(result.runs, found, strict=True)
            ]
            for count, found in result.series[axis].items()
        },
        "properties": {
            name: {
                "interval_min": each.regression.interval_min,
                "adjusted_r2": each.adjusted_r2[each.regression.interval_min],
                "ridge_k2": each.ridge,
                "left_out_error": each.left_out_error,
                "deviation": each.regression.deviation,
                "lowest": each.regression.bounds.lowest,
                "highest": each.regression.bounds.highest,
            }
            for name, each in result.fitted[axis].items()
        },
    }
