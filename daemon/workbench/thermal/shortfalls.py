"""What a test has to say beside its figures: harm of a model, what is lost on line, which sensors were excluded."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from models.recordings.findings import said_together
from models.records import FloatArray
from models.thermal.estimation import UNSURE_UM
from models.thermal.features import BoolArray
from models.thermal.training.inputs import Inputs
from models.thermal.training.online import FULL_WEIGHT, HOLD_MIN, NO_WEIGHT

LOST = 0.1
"""On line so much less of the error is removed that it is said why."""
HARDLY = 0.5
"""Where the output would follow for less of the time, it is said why an estimate that makes things worse does."""
BEYOND = 0.05
"""A value lies beyond training when it leaves the range by more than this share of it."""
TURNED_LEFT = 0.8
"""Where a channel is turned round, less than this share of it is left by a model that goes with it."""
MOST_REVERSED = 1 / 3
"""Of more tests than this nobody knows which of them are the wrong way round."""
POSITION_SHARE = 0.9
"""An axis position that is known for less of the time is why less would be had."""
UNSURE_SHARE = 0.5
"""What is imputed is why the output does not follow where it may be off by too much for so much of that time."""
MOST_NAMED = 3
SIGNS = {"slew": "it jumped", "flat": "it stood still", "departure": "the others say otherwise"}
"""What is said of a sensor that the watch excluded, by its sign."""


def beyond_training(inputs: Inputs, trained: BoolArray, tested: BoolArray) -> tuple[str, ...]:
    """Return speed, temperatures and axis positions of a test's rows that training's did not reach, farthest first."""
    columns = [
        (name, values, "mm" if name in inputs.axis_positions else "degC")
        for name, values in zip(inputs.sensor_names, inputs.degc.T, strict=True)
    ]
    if inputs.speed_rpm is not None:
        columns.insert(0, ("spindle speed", np.abs(inputs.speed_rpm), "1/min"))
    found = []
    for name, values, unit in columns:
        low, high = float(values[trained].min()), float(values[trained].max())
        least, most = float(values[tested].min()), float(values[tested].max())
        above, below = most - high, low - least
        share = max(above, below) / max(high - low, 1e-9)
        if share > BEYOND:
            went, limit = (most, high) if above >= below else (least, low)
            found.append((share, f"{name} to {_number(went)} {unit} (training: {_number(limit)})"))
    return tuple(sentence for _, sentence in sorted(found, reverse=True)[:MOST_NAMED])


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.1f}"


def on_line_sentences(tests: Sequence[Mapping[str, Any]], beyond: Mapping[str, Sequence[str]]) -> list[str]:
    """Return why less would be had on line of tests than could be removed, or nothing could, the worst first."""
    lost = []
    for test in tests:
        online, could = test["online"], test["reduction_rmse"]
        if online is None or could is None or online["reduction_rmse"] is None:
            continue
        less = could - online["reduction_rmse"]
        if less > LOST or (could < 0.0 and online["following"] < HARDLY):
            lost.append((less, _on_line_sentence(test, beyond.get(test["name"], ()))))
    lost.sort(key=lambda each: -each[0])
    rest = [f"so it is in {len(lost) - MOST_NAMED} more tests"] if len(lost) > MOST_NAMED else []
    return [sentence for _, sentence in lost[:MOST_NAMED]] + rest


def position_sentences(tests: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return in which tests an axis position that the model needs is not known, the worst first; `tests`: figures."""
    known = {test["name"]: (test["online"] or {}).get("position_known", 1.0) for test in tests}
    worst = sorted((name for name, share in known.items() if share < 1.0), key=lambda name: known[name])
    sentences = [
        f"{name}: an axis position is not known for {1.0 - known[name]:.0%} of the time, in which the output would "
        f"hold, and after {HOLD_MIN:g} min go back to zero; one that is missing where the test begins, or too long for "
        "lags of it, stays unknown until work is positioned again: see in the recording why its fields are empty"
        for name in worst[:MOST_NAMED]
    ]
    rest = [f"so it is in {len(worst) - MOST_NAMED} more tests"] if len(worst) > MOST_NAMED else []
    return sentences + rest


def _on_line_sentence(test: Mapping[str, Any], beyond: Sequence[str]) -> str:
    online, unsure = test["online"], test["online"].get("imputed_unsure", 0.0)
    if (known := online.get("position_known", 1.0)) < POSITION_SHARE:
        cause = f"an axis position is not known for {1.0 - known:.0%} of the time: record it without gaps"
    elif test["excluded"] and unsure > UNSURE_SHARE * (1.0 - online["following"]):
        cause = (
            f"for {unsure:.0%} of the time what is imputed for excluded sensors ({_excluded(test)}) may be off by more "
            f"than {UNSURE_UM:g} um, above which the output holds: look at them, or record 2 more runs in which they "
            "do the same"
        )
    elif unsure > UNSURE_SHARE * (1.0 - online["following"]):
        cause = (
            f"for {unsure:.0%} of the time what is imputed for temperatures that are missing may be off by more than "
            f"{UNSURE_UM:g} um, above which the output holds, and after {HOLD_MIN:g} min goes back to zero: see in the "
            "recording why their fields are empty"
        )
    elif (unread := online.get("speed_unread", 0.0)) > UNSURE_SHARE * (1.0 - online["following"]):
        cause = (
            f"for {unread:.0%} of the time what the spindle did between rows that lie far apart may make more than "
            f"{UNSURE_UM:g} um: record a row a minute at least; a machine reads its speed all the time"
        )
    elif beyond:
        cause = (
            f"it goes beyond training ({', '.join(beyond)}): record 2 runs or cycles that go as far, and train on them"
        )
    elif test["excluded"]:
        cause = (
            f"sensors were excluded ({_excluded(test)}): look at them, or record 2 more runs in which they do the same"
        )
    else:
        cause = (
            "it begins without its past, or goes through a mixture of speeds and temperatures that training has not "
            "seen: record some hours before it too, and 2 more runs like it"
        )
    could = test["reduction_rmse"]
    estimated = f"{could:.0%} of the error could be removed"
    if could < 0.0:
        estimated = f"the estimate makes the error {-could:.0%} larger"
    return (
        f"{test['name']}: {estimated}, on line it would be {round(online['reduction_rmse'], 2) + 0.0:.0%}, because the "
        f"output would follow for {online['following']:.0%} of the time at a mean confidence of "
        f"{online['mean_confidence']:.2f} (below {FULL_WEIGHT:g} an estimate counts less, "
        f"below {NO_WEIGHT:g} not at all); {cause}"
    )


def _excluded(test: Mapping[str, Any]) -> str:
    return ", ".join(dict.fromkeys(one["sensor"] for one in test["excluded"]))


def harm_sentences(
    channels: Mapping[str, Mapping[str, Any]], by_test: Mapping[str, Mapping[str, Mapping[str, Any]]]
) -> list[str]:
    """Return which channels are worse off with the model than without, and in which test most."""
    found = []
    for name, figures in channels.items():
        if (reduction := figures["reduction_rmse"]) is None or reduction >= 0.0:
            continue
        parts = {test: of[name]["reduction_rmse"] for test, of in by_test.items()}
        known = {test: value for test, value in parts.items() if value is not None}
        worst = min(known, key=lambda test: known[test])
        where = f", worst in {worst} ({known[worst]:.0%})" if len(by_test) > 1 else ""
        found.append(
            f"channel {name}: the model leaves {figures['rmse_um']:.3g} um of {figures['rmse_without_um']:.3g} um, "
            f"worse than no compensation{where}; let no axis follow it as it is: look at the sign and the wiring of "
            "the channel there, or record 2 more runs like that test"
        )
    return found


def reversed_sentences(
    channels: Sequence[str], tests: Mapping[str, Sequence[tuple[FloatArray, FloatArray]]], said: Sequence[str] = ()
) -> list[str]:
    """Return in which tests a channel reads the wrong way round: turned back it goes with what the others say."""
    found = []
    for channel, name in enumerate(channels):
        turned = [test for test, parts in tests.items() if _is_turned(parts, channel)]
        if len(turned) > MOST_REVERSED * len(tests):
            continue
        found += [
            f"{test}: {name} reads the wrong way round, by what the other tests say, and spoils each model that is "
            "trained on it. Look how its sensor was mounted, change the sign of the column, or leave the recording out"
            for test in turned
            if not any(one.startswith(f"{test}: ") and "the wrong way round" in one for one in said)
        ]
    return found


def _is_turned(parts: Sequence[tuple[FloatArray, FloatArray]], channel: int) -> bool:
    measured, residual = (np.concatenate([part[which][:, channel] for part in parts]) for which in (0, 1))
    known = np.isfinite(measured) & np.isfinite(residual)
    without, left, turned = (
        float(np.sqrt(np.square(values[known]).mean())) if known.any() else 0.0
        for values in (measured, residual, 2.0 * measured - residual)
    )
    return left > without > 0.0 and turned < TURNED_LEFT * without


def place(test: str, recording: str) -> str:
    """Return where something happened: the recording, and which part of it where a test is a part."""
    return recording if test in ("test", recording) else f"{test} of {recording}"


def fault_sentences(faults: Sequence[Mapping[str, Any]]) -> list[str]:
    found = []
    for fault in faults:
        after, ratio = fault["found_after_min"], fault["max_ratio"]
        met = "not found" if after is None else f"found after {after:.0f} min"
        largest = "" if ratio is None else f", largest residual {ratio:.2f} times fault-free"
        found.append(f"{fault['kind']} {fault['sensor']} in {fault['recording']}: {met}{largest}")
    return found


def false_alarm_sentences(tests: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return which sensors were excluded though no fault was asked for, and what that may mean."""
    alarms = [
        f"{one['sensor']} in {place(test['name'], one['recording'])} after {one['after_hours']:.1f} h "
        f"({SIGNS[one['sign']]})"
        for test in tests
        for one in test["excluded"]
    ]
    if not alarms:
        return ["false alarms: none"]
    meaning = "a sensor that was excluded here is either wrong in that recording, or does there what training never saw"
    return [f"false alarms: {', '.join(alarms)}", meaning]


def columns_sentences(columns: Sequence[str]) -> list[str]:
    """Return what is said of the columns that --common-columns left out."""
    return [f"left out, because not all recordings have them: {', '.join(columns)}"] if columns else []


def temperature_sentences(tests: Sequence[Mapping[str, Any]]) -> list[str]:
    return said_together(
        [
            (test["name"], f"temperature {name} is left out of the model: {why}")
            for test in tests
            for name, why in test["temperatures_left_out"].items()
        ]
    )
