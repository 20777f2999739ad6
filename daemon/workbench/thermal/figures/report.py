"""All figures of a campaign in one folder, and their figures as JSON."""

from pathlib import Path
from typing import Any

import numpy as np

from config.html_page import Section
from daemon.workbench.figures import report_page, save_png
from daemon.workbench.thermal.figures.campaign import Campaign, Progress, read_campaign
from daemon.workbench.thermal.figures.components import Components, campaign_components, component_figures
from daemon.workbench.thermal.figures.measured import measured_figures
from daemon.workbench.thermal.figures.performance import (
    CONTOUR_UM,
    Performance,
    campaign_performance,
    middle,
    performance_figures,
)
from models.thermal.training.published import MODELS

REPORT_FILE = "report.html"


def write_figures(folder: Path, output: Path, *, intercept: bool, repeats: int, progress: Progress) -> dict[str, Any]:
    """Draw every figure of a campaign and return what they show.

    Raises CampaignIndexError, RecordingFileError, DatasetError; OSError when the output cannot be written.
    """
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
