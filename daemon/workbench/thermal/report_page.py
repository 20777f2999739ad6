"""The report on a recording as one HTML page."""

from pathlib import Path
from typing import Any

from config.html_page import Section
from daemon.workbench.figures import COLOURS, Axes, Curve, Figure, report_page
from daemon.workbench.thermal.estimates import RecordedEstimates
from models.recordings.dataset import Recording
from models.thermal.family import ThermalModel

TIME = "time [h]"
WORDS = {
    "first_60_min_um": "by the rotating spindle, first 60 min",
    "whole_period_um": "by the rotating spindle, whole period",
    "environmental_temperature_variation_error_um": "environmental temperature variation error",
}


def write_report_page(path: Path, report: dict[str, Any], recording: Recording, model: ThermalModel | None) -> None:
    """Write the report with curves of all displacements; raises OSError."""
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
            Section(text=introduction),
            _worst_table("Largest distortion by axis [um]", axes),
            _worst_table("Largest distortion by channel [um]", report["channels"]),
            Section(title="Rotations", text=stable),
            _rotation_table(report),
            Section(title="Environment", text=report["environment"]["why_not"] or _environment(report["environment"])),
            _energy_table(report["energy"]),
        ],
        [_figure(recording, model)],
    )
    path.write_text(page, encoding="utf-8")


def _figure(recording: Recording, model: ThermalModel | None) -> Figure:
    estimates = None if model is None else RecordedEstimates(model, recording)
    hours = recording.time_s / 3600.0
    without, remaining = [], []
    for place, name in enumerate(recording.displacement_names):
        colour = COLOURS[place % len(COLOURS)]
        error_um = recording.displacements_um[:, place] - recording.displacements_um[0, place]
        without.append(Curve(x=hours, y=error_um, label=name, colour=colour))
        if estimates is not None and name in estimates.model.channels:
            left_um = error_um - estimates.since_um(name, 0, recording.rows)
            remaining.append(Curve(x=hours, y=left_um, label=name, colour=colour))
    axes = [Axes(title="without compensation", x_label=TIME, y_label="displacement [um]", curves=without)]
    if remaining:
        axes.append(Axes(title="with compensation", x_label=TIME, y_label="displacement [um]", curves=remaining))
    if recording.speed_rpm is not None:
        speed = Curve(x=hours, y=recording.speed_rpm, label="spindle speed", colour="#444444")
        axes.append(Axes(x_label=TIME, y_label="speed [1/min]", curves=[speed]))
    return Figure(
        number="1", title="Displacements since the first row", note="One reference at the first row.", axes=axes
    )


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
    return f"{len(environment['stretches'])} stretches of settled standstill, {minutes:.0f} min in all{air}."


def _energy_table(energy: dict[str, Any]) -> Section:
    rows = [("chiller in this recording [kWh]", *energy["chiller_kwh"].values())]
    if energy["process"] is not None:
        rows.append(("energy efficiency (1-1)", *energy["process"]["energy_efficiency"].values()))
        rows.append(("parts per hour (1-2)", *[energy["process"]["productivity_per_h"]] * 3))
    head = ("", "chiller always on", "idle reduction", "off")
    return Section(title="Energy", head=head, rows=tuple(rows), kind="numbers")
