"""All figures of a campaign in one folder, and their figures as JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from config.html_page import Section
from daemon.workbench.figures import COLOURS, Axes, Curve, Figure, report_page, save_png
from daemon.workbench.thermal.figures.campaign import Campaign, Progress, read_campaign
from daemon.workbench.thermal.figures.measured import measured_figures
from daemon.workbench.thermal.figures.performance import (
    CONTOUR_UM,
    Performance,
    campaign_performance,
    middle,
    performance_figures,
)
from models.thermal.training.principal_components import SHARE, PrincipalComponents, differences, principal_components
from models.thermal.training.published import MODELS

REPORT_FILE = "report.html"


LONGEST_MIN = 30
"""Longest time of a difference [min]."""
SHOWN_COMPONENTS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Components:
    """Principal components of the whole campaign."""

    levels: PrincipalComponents
    changes: PrincipalComponents
    """Of the temperatures since the start of their data set."""
    differences: dict[int, PrincipalComponents]
    """Of the differences over so many minutes."""


def campaign_components(campaign: Campaign, progress: Progress) -> Components:
    """Return the components of all data sets together; raises DatasetError."""
    tables = [each.recording.temperatures_degc for each in campaign.sets.values()]
    longest = min(LONGEST_MIN, max(map(len, tables)) - 2)
    found: dict[int, PrincipalComponents] = {}
    for minutes in range(1, longest + 1):
        found[minutes] = principal_components(differences(tables, minutes))
        progress("principal components", minutes, longest)
    return Components(
        levels=principal_components(np.vstack(tables)),
        changes=principal_components(np.vstack([each.change_k for each in campaign.sets.values()])),
        differences=found,
    )


def component_figures(campaign: Campaign, found: Components) -> list[Figure]:
    sensors = np.arange(1.0, 1.0 + len(campaign.temperature_names))
    loadings = [
        Axes(
            title=f"component {place + 1}",
            x_label="sensor",
            y_label="loading",
            curves=[Curve(x=sensors, y=found.changes.loadings[:, place], colour=COLOURS[place])],
        )
        for place in range(min(SHOWN_COMPONENTS, len(sensors)))
    ]
    figures = [
        Figure(
            number="3-7",
            title="Principal components of the temperature changes",
            note="Sensors in the order of the recording; changes since the start of each data set.",
            axes=loadings,
        ),
        _cumulative("3-8", "temperatures", [("changes since the start", found.changes), ("levels", found.levels)]),
    ]
    for number, minutes in (("3-9", 1), ("3-10", 5)):
        if minutes in found.differences:
            what = f"differences over {minutes} min"
            figures.append(_cumulative(number, what, [(what, found.differences[minutes])]))
    minutes_axis = np.array(list(found.differences), dtype=np.float64)
    counts = np.array([each.dimensions() for each in found.differences.values()], dtype=np.float64)
    figures.append(
        Figure(
            number="3-11",
            title=f"Dimensions at {SHARE:.0%} of the cumulative contribution by the time of a difference",
            note="The shorter the time, the more of a difference is each sensor's own noise.",
            axes=[
                Axes(
                    x_label="time of the difference [min]",
                    y_label="dimensions",
                    curves=[Curve(x=minutes_axis, y=counts)],
                )
            ],
        )
    )
    return figures


def _cumulative(number: str, what: str, parts: Sequence[tuple[str, PrincipalComponents]]) -> Figure:
    curves = []
    for label, each in parts:
        x = np.arange(1.0, 1.0 + len(each.variance_k2))
        counted = f"{label}: {each.dimensions()} at {SHARE:.0%}"
        curves.append(Curve(x=x, y=each.cumulative, label=counted))
    return Figure(
        number=number,
        title=f"Cumulative contribution ratio of {what}",
        note="Of all data sets together.",
        axes=[Axes(x_label="number of components", y_label="cumulative contribution", curves=curves)],
    )


def write_figures(folder: Path, output: Path, *, intercept: bool, repeats: int, progress: Progress) -> dict[str, Any]:
    output.mkdir(parents=True, exist_ok=True)
    campaign = read_campaign(folder, progress)
    components = campaign_components(campaign, progress)
    performance = campaign_performance(campaign, intercept=intercept, repeats=repeats, progress=progress)
    figures = [*measured_figures(campaign), *component_figures(campaign, components)]
    figures += performance_figures(campaign, performance)
    figures.sort(key=lambda figure: figure.file)
    for done, figure in enumerate(figures, start=1):
        save_png(output / figure.file, figure)
        progress("drawing", done, len(figures))
    machine = "the simulated machine" if campaign.index.machine == "simulated" else campaign.index.machine
    introduction = (
        f"{len(campaign.sets)} data sets, {len(campaign.temperature_names)} temperatures, of {machine}. "
        "Every number here was computed from these recordings; none is a published one. "
        "Numbers of figures are those of the dissertation whose analysis is repeated.",
        f"Models by least squares on increments over one minute, {'with' if intercept else 'without'} b0. "
        "Displacements are cleansed in training sets only.",
    )
    title = f"Thermal errors: {campaign.index.name}, {machine}"
    page = report_page(title, [Section(text=text) for text in introduction], figures)
    (output / REPORT_FILE).write_text(page, encoding="utf-8")
    return {
        "campaign": campaign.index.name,
        "machine": campaign.index.machine,
        "report": str(output / REPORT_FILE),
        "figures": {figure.number: figure.file for figure in figures},
        "b0": intercept,
        "sensor_orders": repeats,
        "principal_components": _dimensions(components),
        "tests": {group: _tests(campaign, performance, group) for group in campaign.tests},
    }


def _dimensions(found: Components) -> dict[str, Any]:
    return {
        "share": 0.99,
        "levels": found.levels.dimensions(),
        "changes": found.changes.dimensions(),
        "differences": {str(minutes): each.dimensions() for minutes, each in found.differences.items()},
    }


def _tests(campaign: Campaign, found: Performance, group: str) -> dict[str, Any]:
    models: dict[str, Any] = {}
    for model in MODELS:
        key = (model, group)
        figures = {name: middle(found.by_number, key, name) for name in ("mean_um", "max_um", "rmse_um")}
        by_speed = middle(found.by_speed, key, "max_um")
        models[model] = {
            "by_training_sets": {name: np.round(values[:, -1], 3).tolist() for name, values in figures.items()},
            "by_training_sets_increasing_speed": {"max_um": np.round(by_speed[:, -1], 3).tolist()},
            "by_sensors": {name: np.round(values[-1], 3).tolist() for name, values in figures.items()},
            "share_of_map_below_10_um": {
                "by_number": float(np.mean(figures["max_um"] < CONTOUR_UM)),
                "increasing_speed": float(np.mean(by_speed < CONTOUR_UM)),
            },
        }
    return {"datasets": [each.number for each in campaign.tests[group]], "models": models}
