"""The report on a recording as one HTML page."""

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from config.html_page import Section
from daemon.workbench.figures import COLOURS, INK, Axes, Curve, Figure, report_page
from daemon.workbench.thermal.estimates import RecordedEstimates
from drivers.files.recording_origin import Origin
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.family import ThermalModel

TIME = "time [h]"
DISPLACEMENT = "displacement [um]"
WORDS = {
    "first_60_min_um": "by the rotating spindle, first 60 min",
    "whole_period_um": "by the rotating spindle, whole period",
    "environmental_temperature_variation_error_um": "environmental temperature variation error",
}


SHOWN_TEMPERATURES = 8
"""So many temperatures are drawn; the others are named in a note."""
MARGIN = 0.05
"""Above and below the curves, of their range."""


def write_report_page(
    path: Path, report: dict[str, Any], recording: Recording, model: ThermalModel | None, origin: Origin
) -> None:
    """Write the report with curves of temperatures and displacements; raises OSError."""
    drift = report["drift"]
    axes = {axis: {f"worst_{kind}": each[kind] for kind in each} for axis, each in report["axes"].items()}
    introduction = (
        f"Words of {report['standard']}; {report['hours']:g} h, "
        f"{len(report['rotations'])} rotations of the spindle. "
        f"{'Without a model.' if model is None else f'Compensation: {model.model_id}, computed afterwards.'} "
        f"{'The model was trained on a recording of this name. ' if report['seen_in_training'] else ''}"
        "Distortion is the range that a displacement covers, raw as it was measured."
    )
    stable = f"Stable: drifts less than {drift['tolerance_um']:g} um in {drift['ahead_min']:g} min."
    page = report_page(
        f"Thermal distortion: {recording.name}",
        [
            Section(rows=_origin(origin, model), kind="facts"),
            *([Section(title="Warnings", items=tuple(report["warnings"]))] if report["warnings"] else []),
            Section(text=introduction),
            *([_worst_table("Largest distortion by axis [um]", axes)] if axes else []),
            _worst_table("Largest distortion by channel [um]", report["channels"]),
            Section(title="Rotations", text=stable),
            _rotation_table(report),
            Section(title="Environment", text=report["environment"]["why_not"] or _environment(report["environment"])),
            _energy_table(report["energy"]),
        ],
        _figures(recording, None if model is None else RecordedEstimates(model, recording)),
    )
    path.write_text(page, encoding="utf-8")


def _origin(origin: Origin, model: ThermalModel | None) -> tuple[tuple[str, str], ...]:
    """Return of what, when and by which version the report is."""
    begun = "the times of the recording are no dates" if origin.begun_utc_s is None else _date(origin.begun_utc_s)
    return (
        ("machine", origin.machine or "not named: a line `# machine: NAME` at the head of the recording names it"),
        ("recorded from", begun),
        ("report made", _date(time.time())),
        ("Toolpoint", version("toolpoint")),
        ("model", "none" if model is None else model.model_id),
    )


def _date(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _figures(recording: Recording, estimates: RecordedEstimates | None) -> list[Figure]:
    """Return temperatures and speed; measured against estimated; without and with compensation on one scale."""
    hours = recording.time_s / 3600.0
    figures = [_temperatures(recording, hours)]
    measured, estimated, remaining = [], [], []
    for place, name in enumerate(recording.displacement_names):
        colour = COLOURS[place % len(COLOURS)]
        error_um = recording.displacements_um[:, place]
        first = int(np.argmax(np.isfinite(error_um)))
        error_um = error_um - error_um[first]
        measured.append(Curve(x=hours, y=error_um, label=f"{name}, measured", colour=colour))
        if estimates is not None and name in estimates.model.channels:
            found_um = estimates.since_um(name, 0, recording.rows)
            found_um = found_um - found_um[first]
            estimated.append(
                Curve(x=hours, y=found_um, label=f"{name}, estimated", colour=colour, style="dashed", width=2.0)
            )
            remaining.append(Curve(x=hours, y=error_um - found_um, label=f"{name}, with", colour=colour))
    both = [curve for pair in zip(measured, estimated, strict=False) for curve in pair] if estimated else measured
    words = "Displacements, measured and estimated" if estimated else "Displacements"
    axes = [Axes(x_label=TIME, y_label=DISPLACEMENT, curves=both)]
    note = "Since the first value, where the reference is."
    figures.append(Figure(number="2", title=words, note=note, axes=axes, heights=(460,)))
    if remaining:
        names = {curve.label.partition(",")[0] for curve in remaining}
        without = [curve for curve in measured if curve.label.partition(",")[0] in names]
        span = _span([*without, *remaining])
        axes = [
            Axes(title=f"{kind} compensation", x_label=TIME, y_label=DISPLACEMENT, curves=curves, y_range=span)
            for kind, curves in (("without", without), ("with", remaining))
        ]
        note = "On the same scale; one reference, at the first value."
        figures.append(Figure(number="3", title="Without and with compensation", note=note, axes=axes))
    return figures


def _temperatures(recording: Recording, hours: FloatArray) -> Figure:
    """Return the temperatures that changed most, and the spindle speed below them."""
    degc = recording.temperatures_degc[:, : recording.sensors]
    known = np.isfinite(degc).any(axis=0)
    ranges = np.full(degc.shape[1], -1.0)
    ranges[known] = np.nanmax(degc[:, known], axis=0) - np.nanmin(degc[:, known], axis=0)
    shown = sorted(np.argsort(ranges)[::-1][:SHOWN_TEMPERATURES].tolist())
    curves = [Curve(x=hours, y=degc[:, place], label=recording.temperature_names[place]) for place in shown]
    axes = [Axes(x_label=TIME, y_label="temperature [degC]", curves=curves)]
    if recording.speed_rpm is not None:
        speed = Curve(x=hours, y=recording.speed_rpm, label="spindle speed", colour=INK)
        axes.append(Axes(x_label=TIME, y_label="speed [1/min]", curves=[speed]))
    count = degc.shape[1]
    note = f"The {len(shown)} of {count} that changed most." if len(shown) < count else ""
    return Figure(number="1", title="Temperatures", note=note, axes=axes, heights=(370, 200)[: len(axes)])


def _span(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return a range that holds all curves."""
    values = np.concatenate([curve.y[np.isfinite(curve.y)] for curve in curves])
    if not values.size:
        return -1.0, 1.0
    margin = max(MARGIN * float(np.ptp(values)), 0.5)
    return float(values.min()) - margin, float(values.max()) + margin


def _worst_table(title: str, parts: dict[str, Any]) -> Section:
    with_model = any(value is not None for part in parts.values() for value in part["worst_with"].values())
    kinds = ("without", "with") if with_model else ("without",)
    head = ("", *(f"{words}, {kind}" for words in WORDS.values() for kind in kinds))
    rows = tuple(
        (name, *(part[f"worst_{kind}"].get(key) for key in WORDS for kind in kinds)) for name, part in parts.items()
    )
    return Section(title=title, head=head, rows=rows, kind="numbers")


def _rotation_table(report: dict[str, Any]) -> Section:
    head = ("from [h]", "minutes", "speed [1/min]", "channel", "first 60 min [um]", "whole [um]", "at the end [um]",
              "stable after [min]", "advised warm-up [min]")  # fmt: skip
    rows = []
    for place, turn in enumerate(report["rotations"]):
        speeds = sorted({turn["lowest_rpm"], turn["highest_rpm"]} - {None})
        for name, channel in report["channels"].items():
            each = channel["distortion_by_rotating_spindle"][place]
            without = each["without"]
            rows.append(
                (turn["from_h"], turn["minutes"], " to ".join(f"{speed:.0f}" for speed in speeds), name,
                 without["first_60_min_um"], without["whole_period_um"], without["end_um"],
                 without["time_to_stability_min"], each["warm_up"]["wait_min"])
            )  # fmt: skip
    return Section(head=head, rows=tuple(rows), kind="numbers")


def _environment(environment: dict[str, Any]) -> str:
    minutes = sum(stretch["minutes"] for stretch in environment["stretches"])
    ranges = [s["temperature_range_k"] for s in environment["stretches"] if s["temperature_range_k"] is not None]
    air = f"; the air ({', '.join(environment['ambient'])}) varied by at most {max(ranges):.2f} K" if ranges else ""
    count = len(environment["stretches"])
    return f"{count} {'stretch' if count == 1 else 'stretches'} of settled standstill, {minutes:.0f} min in all{air}."


def _energy_table(energy: dict[str, Any]) -> Section:
    rows = [("chiller in this recording [kWh]", *energy["chiller_kwh"].values())]
    if energy["process"] is not None:
        rows.append(("energy efficiency (1-1)", *energy["process"]["energy_efficiency"].values()))
        rows.append(("parts per hour (1-2)", *[energy["process"]["productivity_per_h"]] * 3))
    head = ("", "chiller always on", "idle reduction", "off")
    return Section(title="Energy", head=head, rows=tuple(rows), kind="numbers")
