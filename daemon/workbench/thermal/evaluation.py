"""Evaluates thermal models on recordings: what is trained on, what is tested, and the figures of both."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from config.recordings.recording_map import RecordingMap
from daemon.workbench.thermal.choice_figures import choice_figures, choice_of
from daemon.workbench.thermal.reading import read_alike
from daemon.workbench.thermal.result_pages import Stretch
from daemon.workbench.thermal.shortfalls import (
    beyond_training,
    harm_sentences,
    on_line_sentences,
    place,
    position_sentences,
    reversed_sentences,
)
from models.json_values import finite_or_none
from models.recordings.dataset import DatasetError, Recording
from models.recordings.findings import counted, usable_recordings
from models.records import FloatArray
from models.thermal.bias import BiasFilter
from models.thermal.family import ThermalModel
from models.thermal.features import BoolArray
from models.thermal.model import HyperParameters
from models.thermal.training.advice import advice
from models.thermal.training.choice import Choice
from models.thermal.training.evaluation import moving
from models.thermal.training.families import fold_numbers
from models.thermal.training.folds import MOST_FOLDS, cycles, inner_folds
from models.thermal.training.inputs import Inputs, build_inputs, temperatures_alone, unusable_sensors, with_sensors
from models.thermal.training.left_out_sensors import left_out_sensors
from models.thermal.training.online import (
    Followed,
    compensated_um,
    follow,
    following_share,
    held_shares,
    position_share,
)
from models.thermal.training.prepared import prepare
from models.thermal.training.recipes import RECIPES
from models.thermal.training.train_family import MOST_WATCHED, model_of
from models.thermal.training.trial import Fault, FaultOutcome, Tester, Trial, since_first_known, trial_rows
from models.thermal.training.trust import Trust, independent_folds, judge
from models.thermal.training.watch_fit import fit_watch

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """What is trained on and what is tested."""

    train_hours: tuple[float, float] | None = None
    """Hours of every recording that are trained on; None: all."""
    test_hours: tuple[float, float] | None = None
    """Hours of every recording that are tested, as one run each; None: what the other fields say."""
    leave_out: str | None = None
    """`cycles` or `runs` are left out in turn and tested."""
    probe_min: float | None = None
    """Time between probes that reset the offset [min]."""
    faults: tuple[Fault, ...] = ()
    """Faults, each in a test of its own; sensor `each` stands for every sensor in turn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Part:
    """One training and what is tested on it."""

    name: str
    train: BoolArray
    test: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class _Outcome:
    name: str
    trials: list[Trial]
    trust: Trust
    hyper_parameters: HyperParameters
    faults: list[tuple[str, FaultOutcome]]
    """Each with its recording."""
    dropped: dict[str, str]
    online: list["_Online"]
    """Of each trial."""
    choice: Choice
    beyond: tuple[str, ...]
    """What the test reaches and training did not."""
    reversed_runs: tuple[str, ...]
    """Sentences on runs that were left out of training, because a channel reads the wrong way round in them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Online:
    """What the machine would have got in one trial."""

    followed: Followed
    left_um: FloatArray
    """Measured minus what the output held [um]."""


def read_recordings(
    paths: Sequence[Path], recording_map: RecordingMap | None, progress: Progress, *, common: bool = False
) -> tuple[list[Recording], tuple[str, ...]]:
    """Return recordings with the `common` columns alone, or all, and warnings; raises DatasetError."""
    return usable_recordings(read_alike(paths, recording_map, progress, common=common))


def evaluate(
    recordings: Sequence[Recording],
    sample_s: float,
    model: str,
    protocol: Protocol,
    progress: Progress,
    stretches: list[Stretch] | None = None,
) -> dict[str, Any]:
    """Return the figures of a family on recordings, for JSON; `stretches` takes what a page draws."""
    whole = build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())
    parts = _parts(whole, protocol)
    _require_faults(whole, parts, protocol.faults)
    outcomes = []
    for number, part in enumerate(parts, start=1):
        outcomes.append(_one(recordings, sample_s, model, protocol, part))
        progress("evaluating", number, len(parts))
    if stretches is not None:
        stretches += [_stretch(whole, outcome, index) for outcome in outcomes for index in range(len(outcome.trials))]
    found = {"model": model, **_figures(whole, outcomes, _next(recordings, sample_s, protocol))}
    for name in recordings[0].pivots_mm:
        found["channels"][name]["unit"] = "um/m"
    return found


def _next(recordings: Sequence[Recording], sample_s: float, protocol: Protocol) -> tuple[str, ...]:
    """Return what to record next beside these: of all that may be trained on, not of what one training is left with."""
    inputs = build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())
    trained = _trained(inputs, protocol)
    dropped = unusable_sensors(inputs, trained)
    kept = [with_sensors(one, [name for name in inputs.sensor_names if name not in dropped]) for one in recordings]
    rows = trained & build_inputs(kept, sample_s=sample_s, lags_min=(), speed_lags_min=()).trainable()
    fold, _ = inner_folds(inputs, rows)
    return advice(inputs, rows, independent_folds(inputs, rows, len(fold_numbers(rows, fold))))


def _trained(inputs: Inputs, protocol: Protocol) -> BoolArray:
    """Return which rows may be trained on, where nothing is left out."""
    if protocol.train_hours is None:
        return np.ones(inputs.rows, dtype=np.bool_)
    return inputs.rows_between(*protocol.train_hours)


def _parts(inputs: Inputs, protocol: Protocol) -> list[_Part]:
    trained = _trained(inputs, protocol)
    if protocol.leave_out == "cycles":
        found = cycles(inputs, trained)
        if len(found) < 3:
            raise DatasetError(
                f"{inputs.recording_names[0]}: {counted(len(found), 'cycle')} from one start of the spindle to the "
                "next; to leave one out takes at least 3, so record more, or choose hours for training and test"
            )
        together = np.array_split(np.arange(len(found)), min(len(found), MOST_FOLDS))
        return [_cycles_left_out(found, group.tolist(), trained) for group in together]
    if protocol.leave_out == "runs":
        if len(inputs.recording_names) < 2:
            raise DatasetError("leaving runs out takes at least two recordings; each recording is a run")
        masks = [inputs.recording == index for index in range(len(inputs.recording_names))]
        names = inputs.recording_names
        return [_Part(name=n, train=trained & ~mask, test=mask) for n, mask in zip(names, masks, strict=True)]
    assert protocol.train_hours is not None and protocol.test_hours is not None
    tested = inputs.rows_between(*protocol.test_hours)
    for kind, rows, hours in (("training", trained, protocol.train_hours), ("test", tested, protocol.test_hours)):
        if not rows.any():
            last = float(inputs.time_min.max()) / 60.0
            raise DatasetError(
                f"there is no row in the {kind} hours {hours[0]:g}-{hours[1]:g}; the recordings end at {last:.2f} h"
            )
    if (trained & tested).any():
        raise DatasetError(
            "training and test hours overlap; a model must be tested on what it has not seen, so separate them"
        )
    return [_Part(name="test", train=trained, test=tested)]


def _cycles_left_out(found: Sequence[BoolArray], group: Sequence[int], trained: BoolArray) -> _Part:
    """Return the test of neighbouring cycles, by index from 0, on a model of the others."""
    mask = np.any([found[index] for index in group], axis=0)
    first, last = group[0] + 1, group[-1] + 1
    name = f"cycle {first}" if first == last else f"cycles {first} to {last}"
    return _Part(name=name, train=trained & ~mask, test=mask)


def _require_faults(inputs: Inputs, parts: Sequence[_Part], faults: Sequence[Fault]) -> None:
    for fault in faults:
        temperatures = [name for name in inputs.sensor_names if name not in inputs.axis_positions]
        if fault.sensor != "each" and fault.sensor not in temperatures:
            known = ", ".join(temperatures[:20])
            raise DatasetError(f"fault {fault.kind}: there is no temperature {fault.sensor}; there are {known}")
        if not any(_holds(inputs, rows, fault) for part in parts for rows in trial_rows(inputs, part.test)):
            raise DatasetError(f"fault {fault.kind}: hour {fault.at_hours:g} does not lie in what is tested")


def _holds(inputs: Inputs, rows: np.ndarray[Any, np.dtype[np.intp]], fault: Fault) -> bool:
    at_min = 60.0 * fault.at_hours
    return bool(inputs.time_min[rows[0]] <= at_min + 1e-9 and at_min <= inputs.time_min[rows[-1]])


def _one(recordings: Sequence[Recording], sample_s: float, model: str, protocol: Protocol, part: _Part) -> _Outcome:
    dropped = left_out_sensors(recordings, sample_s, part.train)
    kept = [name for name in recordings[0].temperature_names if name not in dropped]
    chosen = [with_sensors(recording, kept) for recording in recordings]
    prepared = prepare(chosen, sample_s, RECIPES[model], part.train, protocol.probe_min)
    inputs, rows, fold, problem = prepared.inputs, prepared.rows, prepared.fold, prepared.problem
    trust = judge(inputs, rows, fold, problem, probe_min=protocol.probe_min)
    watch = fit_watch(temperatures_alone(chosen), sample_s, rows, fold)
    fit = problem.fit()
    tester = Tester(inputs, fit, watch, protocol.probe_min, trust.bias_filter, rows)
    trials = [tester.run(part.name, stretch) for stretch in trial_rows(inputs, part.test)]
    watched = watch if inputs.layout.sensors <= MOST_WATCHED else None
    made = model_of(model, chosen, prepared, fit, trust, watched)
    online = _online(made, inputs, trials, protocol.probe_min, trust.bias_filter)
    return _Outcome(
        name=part.name,
        trials=trials,
        trust=trust,
        hyper_parameters=problem.hyper_parameters,
        faults=_fault_outcomes(inputs, tester, trials, protocol.faults, dropped),
        dropped=dropped,
        online=online,
        choice=choice_of(model, prepared, trust),
        beyond=beyond_training(inputs, rows, part.test),
        reversed_runs=prepared.reversed_runs,
    )


def _online(
    model: ThermalModel,
    inputs: Inputs,
    trials: Sequence[Trial],
    probe_min: float | None,
    bias_filter: BiasFilter | None,
) -> list[_Online]:
    found = []
    for trial in trials:
        followed = follow(model, inputs, trial.rows)
        held_um = compensated_um(followed, inputs.time_min[trial.rows], trial.measured_um, probe_min, bias_filter)
        found.append(_Online(followed=followed, left_um=since_first_known(trial.measured_um - held_um)))
    return found


def _fault_outcomes(
    inputs: Inputs, tester: Tester, trials: Sequence[Trial], faults: Sequence[Fault], dropped: dict[str, str]
) -> list[tuple[str, FaultOutcome]]:
    found: list[tuple[str, FaultOutcome]] = []
    for fault in faults:
        names = inputs.sensor_names if fault.sensor == "each" else (fault.sensor,)
        for name in names:
            if name in dropped or name in inputs.axis_positions:
                continue
            single = Fault(kind=fault.kind, sensor=name, at_hours=fault.at_hours, amount=fault.amount)
            found += [
                (_recording(inputs, trial), tester.with_fault(trial, single))
                for trial in trials
                if _holds(inputs, trial.rows, single)
            ]
    return found


def _recording(inputs: Inputs, trial: Trial) -> str:
    return inputs.recording_names[int(inputs.recording[trial.rows[0]])]


def _stretch(inputs: Inputs, outcome: _Outcome, index: int) -> Stretch:
    """Return one trial as a page draws it."""
    trial = outcome.trials[index]
    time_h = inputs.time_min[trial.rows] / 60.0
    band_um = trial.band_factor[:, None] * outcome.trust.band_um
    return Stretch(
        name=place(outcome.name, _recording(inputs, trial)),
        time_h=time_h - time_h[0],
        measured_um=trial.measured_um,
        estimated_um=trial.measured_um - trial.residual_um,
        band_um=band_um if np.isfinite(band_um).all() else None,
        online_left_um=outcome.online[index].left_um,
    )


def _figures(inputs: Inputs, outcomes: Sequence[_Outcome], record_next: Sequence[str]) -> dict[str, Any]:
    channels: dict[str, dict[str, Any]] = _channel_figures(inputs.channels, outcomes)
    moves = moving([trial.measured_um for o in outcomes for trial in o.trials])
    counted = [name for name, counts in zip(inputs.channels, moves, strict=True) if counts]
    mean = _mean(channels, counted)
    for name, choice in choice_figures({o.name: o.choice for o in outcomes}, inputs.channels).items():
        channels[name] |= choice
    refusals = [o for o in outcomes if o.trust.refused is not None]
    several = len(outcomes) > 1
    tests = [_test_figures(inputs, outcome, counted) for outcome in outcomes]
    by_test = {o.name: _channel_figures(inputs.channels, [o]) for o in outcomes}
    turned = dict.fromkeys(sentence for o in outcomes for sentence in o.reversed_runs)
    tested = tuple(f"{o.name}: " for o in outcomes)
    said = [f"{one}; as a test it counts in these figures" if one.startswith(tested) else one for one in turned]
    said += record_next
    said += [*reversed_sentences(inputs.channels, _to_be_judged(inputs, outcomes), said)]
    of_channel = {f"channel {name} ": (name, figures) for name, figures in channels.items()}
    unsaid = dict(one for begin, one in of_channel.items() if not any(sentence.startswith(begin) for sentence in said))
    said += harm_sentences(unsaid, by_test)
    said += [*on_line_sentences(tests, {o.name: o.beyond for o in outcomes}), *position_sentences(tests)]
    excluded = [one["sensor"] for test in tests for one in test["excluded"]]
    return {
        "channels": channels,
        "mean": mean,
        "hyper_parameters": {o.name: o.hyper_parameters for o in outcomes} if several else outcomes[0].hyper_parameters,
        "refused": "; ".join(f"{o.name}: {o.trust.refused}" if several else str(o.trust.refused) for o in refusals)
        or None,
        "faults": [
            {**asdict(fault), "recording": recording, "blamed_instead": fault.excluded_instead}  # its name in 0.1.0
            for o in outcomes
            for recording, fault in o.faults
        ],
        "advice": list(dict.fromkeys(said)),
        "false_alarms": len(excluded),
        "false_alarm_sensors": excluded,
        "tests": tests,
    }


MOSTLY = 0.5
"""A test is mostly followed where the output would follow the estimate for more than this share of its rows."""


def _to_be_judged(inputs: Inputs, outcomes: Sequence[_Outcome]) -> dict[str, list[tuple[FloatArray, FloatArray]]]:
    """Return measured errors and residuals of the tests that can tell that a sensor was mounted the wrong way round.

    These are whole recordings, because within one nobody turns a sensor round, in which the output would mostly follow:
    where a test goes beyond training its estimate may have any sign.
    """
    return {
        o.name: [(trial.measured_um, trial.residual_um) for trial in o.trials]
        for o in outcomes
        if o.name in inputs.recording_names and following_share([one.followed for one in o.online]) > MOSTLY
    }


def _test_figures(inputs: Inputs, outcome: _Outcome, counted: Sequence[str]) -> dict[str, Any]:
    mean = _mean(_channel_figures(inputs.channels, [outcome]), counted)
    names = [name for name in inputs.sensor_names if name not in outcome.dropped]
    return {
        "name": outcome.name,
        "rows": sum(len(trial.rows) for trial in outcome.trials),
        "reduction_rmse": mean["reduction_rmse"],
        "reduction_max": mean["reduction_max"],
        "online": mean["online"] | _following([one.followed for one in outcome.online]),
        "held_out_relative_rmse": finite_or_none(outcome.trust.held_out_relative_rmse),
        "forward_skill": [finite_or_none(value) for value in outcome.trust.forward_skill],
        "temperatures_left_out": outcome.dropped,
        "excluded": [
            {
                "sensor": names[fault.sensor],
                "recording": _recording(inputs, trial),
                "after_hours": (fault.time_min - float(inputs.time_min[trial.rows[0]])) / 60.0,
                "sign": fault.sign,
            }
            for trial in outcome.trials
            for fault in trial.faults
            if fault.sign != "missing"
        ],
    }


def _following(parts: Sequence[Followed]) -> dict[str, float]:
    known = position_share(parts)
    found = {"following": following_share(parts)} | ({} if known is None else {"position_known": known})
    return found | held_shares(parts)


def _channel_figures(channels: Sequence[str], outcomes: Sequence[_Outcome]) -> dict[str, dict[str, Any]]:
    return {name: _one_channel(index, outcomes) for index, name in enumerate(channels)}


AVERAGED = (
    "rmse_without_um",
    "rmse_um",
    "max_um",
    "reduction_rmse",
    "reduction_max",
    "band_coverage",
    "band_width_um",
)
"""Figures of a channel of which the mean over the channels is told; of `max_um` it is the largest."""
NO_FIGURES = dict.fromkeys((*AVERAGED, "online", "band"))


def _one_channel(channel: int, outcomes: Sequence[_Outcome]) -> dict[str, Any]:
    trials = [(trial, outcome.trust.band_um) for outcome in outcomes for trial in outcome.trials]
    measured, residual, band = [], [], []
    for trial, band_um in trials:
        known = np.isfinite(trial.residual_um[:, channel])
        measured.append(trial.measured_um[known, channel])
        residual.append(trial.residual_um[known, channel])
        band.append(band_um[channel] * trial.band_factor[known])
    without, remaining, half = np.concatenate(measured), np.concatenate(residual), np.concatenate(band)
    if not len(without):
        return dict(NO_FIGURES)
    rmse, largest = float(np.sqrt(np.square(remaining).mean())), float(np.abs(remaining).max())
    rmse_without, largest_without = float(np.sqrt(np.square(without).mean())), float(np.abs(without).max())
    coverage, width_um = _band_figures(remaining, half)
    return {
        "rmse_um": rmse,
        "max_um": largest,
        "reduction_rmse": 1.0 - rmse / rmse_without if rmse_without > 0.0 else None,
        "reduction_max": 1.0 - largest / largest_without if largest_without > 0.0 else None,
        "band_coverage": coverage,
        "band_width_um": width_um,
        "rmse_without_um": rmse_without,
        "max_without_um": largest_without,
        "online": _online_figures(channel, outcomes, rmse_without),
        "band": {"coverage": coverage, "width_um": width_um},
    }


def _band_figures(residual_um: FloatArray, half_um: FloatArray) -> tuple[float | None, float | None]:
    if not np.isfinite(half_um).all():
        return None, None
    return float((np.abs(residual_um) <= half_um).mean()), float(2.0 * half_um.mean())


def _online_figures(channel: int, outcomes: Sequence[_Outcome], rmse_without_um: float) -> dict[str, float]:
    """Return what the machine would have got on one channel."""
    parts = [part for outcome in outcomes for part in outcome.online]
    left_um = np.concatenate([part.left_um[:, channel] for part in parts])
    rmse = float(np.sqrt(np.square(left_um[np.isfinite(left_um)]).mean()))
    followed = [part.followed for part in parts]
    found = {
        "rmse_um": rmse,
        "mean_confidence": float(np.concatenate([one.confidence for one in followed]).mean()),
        **_following(followed),
    }
    return found | ({"reduction_rmse": 1.0 - rmse / rmse_without_um} if rmse_without_um > 0.0 else {})


def _mean(channels: dict[str, dict[str, Any]], counted: Sequence[str]) -> dict[str, Any]:
    """Return the means over the channels; of what is gone over those that count: one that is noise says nothing."""
    found: dict[str, Any] = {}
    moving_ones = [channels[name] for name in counted]
    for key in AVERAGED:
        values = [figures[key] for figures in (moving_ones if key.startswith("reduction") else channels.values())]
        known = [value for value in values if value is not None]
        found[key] = (max(known) if key == "max_um" else sum(known) / len(known)) if known else None
    for key, names in (
        ("online", ("rmse_um", "reduction_rmse", "mean_confidence")),
        ("band", ("coverage", "width_um")),
    ):
        found[key] = {}
        for name in names:
            parts = [figures[key] or {} for figures in (moving_ones if name == "reduction_rmse" else channels.values())]
            all_of = [part[name] for part in parts if part.get(name) is not None]
            found[key][name] = sum(all_of) / len(all_of) if all_of else None
    return found
