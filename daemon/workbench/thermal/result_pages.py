"""Pages of an evaluation or a replay: measured and estimated on one scale, what is left, what was chosen and why."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from config.html_page import Section
from daemon.workbench.figures import Axes, Curve, Figure, report_page, stand_alone
from daemon.workbench.thermal.shortfalls import (
    columns_sentences,
    false_alarm_sentences,
    fault_sentences,
    temperature_sentences,
)
from models.records import FloatArray

MOST_POINTS = 6000
"""Of each curve; of longer ones every second, third ... row is drawn."""
BETWEEN_H = 0.1
"""Room between two stretches on the axis of time [h]."""
MEASURED, ESTIMATED, LEFT, ONLINE, BAND = "#222222", "#0b5fa5", "#c8401a", "#8a5ca8", "#9fb4c7"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """What was tested as one run, from its own reference."""

    name: str
    time_h: FloatArray
    """Shape (n,), from 0 [h]."""
    measured_um: FloatArray
    """Shape (n, n_channels), NaN where missing."""
    estimated_um: FloatArray
    """What the model says, or what the NC applied, turned round."""
    band_um: FloatArray | None = None
    """Half the width of the band [um]."""
    online_left_um: FloatArray | None = None
    """What the daemon would have left [um], confidence included."""


def evaluation_page(title: str, found: Mapping[str, Any], stretches: Sequence[Stretch]) -> str:
    """Return the page of `daemon.workbench.thermal.evaluation.evaluate`'s figures."""
    left_out = (*columns_sentences(found["columns_left_out"]), *temperature_sentences(found["tests"]))
    of_sensors = (*fault_sentences(found["faults"]), *false_alarm_sentences(found["tests"]))
    before = [
        *_list("Warnings", (*found["warnings"], *left_out)),
        _chosen(found),
        _reached(found),
        *_list("What the test says, and what to do next", found["advice"]),
        *_list("Sensors in the tests", of_sensors),
        *_candidates(found["channels"]),
    ]
    units = {name: its.get("unit", "um") for name, its in found["channels"].items()}
    return report_page(title, before, figures(tuple(units), stretches, units=units))


def replay_page(
    title: str, found: Mapping[str, Any], model: Mapping[str, object], channels: Sequence[str], played: Stretch
) -> str:
    """Return the page of a replay; `found` is what the command writes as JSON, `model` what is said of the model."""
    rows = tuple(
        (name, *(figures[case][key] for key in ("rmse_um", "max_um") for case in ("without", "with")))
        for name, figures in found["channels"].items()
    )
    head = ("channel", "RMSE without [um]", "with", "largest without [um]", "with")
    before = [
        *_list("Warnings", found["warnings"]),
        *_list("What to do next", found["advice"]),
        Section(title="Model", rows=tuple((key, str(value)) for key, value in model.items()), kind="facts"),
        Section(title="Error since the first block", head=head, rows=rows, kind="numbers"),
        Section(
            text=f"{found['cycles']['received']} of {found['cycles']['expected']} cycles arrived; "
            f"{found['writes']['verified']} of {found['writes']['sent']} writes were verified."
        ),
    ]
    drawn = figures(tuple(channels), [played], estimated="applied, turned round")
    return report_page(title, before, drawn)


def figures(
    channels: Sequence[str],
    stretches: Sequence[Stretch],
    estimated: str = "estimated",
    units: Mapping[str, str] = MappingProxyType({}),
) -> list[Figure]:
    """Return a figure per channel: measured and estimated on one scale, and below it what is left on the same hours."""
    starts = np.concatenate([[0.0], np.cumsum([stretch.time_h[-1] + BETWEEN_H for stretch in stretches])])
    marks = [(float(start), stretch.name) for start, stretch in zip(starts, stretches, strict=False)]
    return [
        _figure(
            name,
            index,
            stretches,
            starts.tolist(),
            marks if len(stretches) > 1 else [],
            estimated,
            units.get(name, "um"),
        )
        for index, name in enumerate(channels)
    ]


def _figure(
    name: str,
    channel: int,
    stretches: Sequence[Stretch],
    starts: Sequence[float],
    marks: Sequence[tuple[float, str]],
    estimated: str,
    unit: str,
) -> Figure:
    every = -(-sum(len(stretch.time_h) for stretch in stretches) // MOST_POINTS)

    def curve(values: Sequence[FloatArray], label: str, colour: str, **look: Any) -> Curve:
        """Return the stretches one after the other, with a break between them; what stands alone as points."""
        points = any(stand_alone(one) for one in values)
        shown = [np.isfinite(one) if stand_alone(one) else slice(None, None, every) for one in values]
        hours = [stretch.time_h + start for stretch, start in zip(stretches, starts, strict=False)]
        x, y = (
            np.concatenate([part for one, rows in zip(of, shown, strict=True) for part in (one[rows], [np.nan])])
            for of in (hours, values)
        )
        return Curve(x=x, y=y, label=label, colour=colour, marker="o" if points else "", **look)

    measured = [stretch.measured_um[:, channel] for stretch in stretches]
    model = [stretch.estimated_um[:, channel] for stretch in stretches]
    left = [one - other for one, other in zip(measured, model, strict=True)]
    above = [curve(measured, "measured", MEASURED), curve(model, estimated, ESTIMATED)]
    below = [curve(left, "left: measured minus estimated", LEFT)]
    if all(stretch.online_left_um is not None for stretch in stretches):
        online = [s.online_left_um[:, channel] for s in stretches if s.online_left_um is not None]
        below.append(curve(online, "left on line, by confidence", ONLINE, style="dotted"))
    if all(stretch.band_um is not None for stretch in stretches):
        half = [s.band_um[:, channel] for s in stretches if s.band_um is not None]
        for sign, label in ((1.0, "band"), (-1.0, "")):
            below.append(curve([sign * one for one in half], label, BAND, style="dashed", width=1.0))
    return Figure(
        title=name,
        axes=[
            Axes(title=f"measured and {estimated}", y_label=unit, curves=above, marks=marks),
            Axes(title="what is left", x_label="h", y_label=unit, curves=below),
        ],
        heights=(320, 240),
        shared_x=True,
    )


def _chosen(found: Mapping[str, Any]) -> Section:
    whys: dict[tuple[str, str], list[str]] = {}
    for channel, its in found["channels"].items():
        if chosen := its.get("chosen"):
            whys.setdefault((chosen["family"], chosen["why"]), []).append(channel)
    items = [f"{', '.join(channels)}: {family}: {why}" for (family, why), channels in whys.items()]
    if found["refused"] is not None:
        items.append(f"The gate would not let it be activated: {found['refused']}")
    return Section(title="What was chosen, and why", text=f"Family asked for: {found['model']}.", items=tuple(items))


def _candidates(channels: Mapping[str, Any]) -> list[Section]:
    names = list(dict.fromkeys(name for its in channels.values() for name in its.get("candidates", {})))
    if not names:
        return []
    rows = tuple(
        (name, *(_percent(its.get("candidates", {}).get(name, {}).get("reduction_rmse")) for its in channels.values()))
        for name in names
    )
    tried = [(name, its["candidates"].get(name, {}).get("refused")) for its in channels.values() for name in names]
    refused = dict.fromkeys(f"{name} was refused: {why}" for name, why in tried if why)
    return [
        Section(
            title="What was tried in training",
            text="Share of the RMSE that is gone on what training left out.",
            items=tuple(refused),
            head=("family", *channels),
            rows=rows,
            kind="numbers",
        )
    ]


def _reached(found: Mapping[str, Any]) -> Section:
    reached = ("RMSE without [um]", "RMSE left [um]", "largest left [um]", "of the RMSE gone", "of the largest gone")
    head = ("channel", *reached, "band covers", "band's width [um]", "gone on line", "mean confidence")
    rows = []
    for name, its in (*found["channels"].items(), ("mean", found["mean"])):
        online = its.get("online") or {}
        shares = (_percent(its["reduction_rmse"]), _percent(its["reduction_max"]), _percent(its["band_coverage"]))
        on_line = (_percent(online.get("reduction_rmse")), _percent(online.get("mean_confidence")))
        errors = (its["rmse_without_um"], its["rmse_um"], its["max_um"])
        rows.append((called(name, its), *errors, *shares, its["band_width_um"], *on_line))
    return Section(title="What was reached on what it had not seen", head=head, rows=tuple(rows), kind="numbers")


def called(channel: str, its: Mapping[str, Any]) -> str:
    """Return what a channel is called in a table in um: a slope along an axis with its own unit."""
    return f"{channel} [{its['unit']}]" if "unit" in its else channel


def _list(title: str, sentences: Sequence[str]) -> list[Section]:
    return [Section(title=title, items=tuple(sentences))] if sentences else []


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"
