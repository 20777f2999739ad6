"""Figures 3-14 to 3-22: residuals by number of training sets and of sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daemon.workbench.figures import COLOURS, Axes, Curve, Figure, Heat
from daemon.workbench.thermal.figures.campaign import COLD_START, IDLE_REDUCTION, Campaign, Progress
from daemon.workbench.thermal.figures.measured import MINUTES, rotating_and_idle
from models.records import FloatArray
from models.thermal.training.campaign_study import (
    CampaignFits,
    Key,
    ResidualMap,
    by_increasing_speed,
    measured_channel,
    progressive_fits,
    random_sensor_order,
    residual_maps,
)
from models.thermal.training.published import MODELS, PublishedSet

CONTOUR_UM = 10.0
HIGHEST_UM = 30.0
"""Top of the maps' and graphs' scale [um]; larger residuals are drawn as this."""
SHOWN_SETS = (1, 2, 3, 6, 9, 12, 17)
PROPERTIES = (("mean_um", "mean [um]"), ("max_um", "maximum [um]"), ("rmse_um", "RMSE [um]"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Performance:
    """Residuals of all models, and some of the fits that they come from."""

    by_number: list[dict[Key, ResidualMap]]
    """Training sets in the order of their numbers; one for each random order of the sensors."""
    by_speed: list[dict[Key, ResidualMap]]
    """Training sets in the order of increasing spindle speed."""
    fits: list[CampaignFits]
    """With all sensors, after 1, 2 .. training sets by number."""


def campaign_performance(campaign: Campaign, *, intercept: bool, repeats: int, progress: Progress) -> Performance:
    """Return the residuals for several random orders of the sensors (seeds 1, 2 ..)."""
    training, tests = campaign.training, campaign.tests
    sensors = len(campaign.temperature_names)
    by_number, by_speed = [], []
    for seed in range(1, repeats + 1):
        order = random_sensor_order(sensors, seed)
        by_number.append(residual_maps(training, tests, order, intercept=intercept))
        by_speed.append(residual_maps(by_increasing_speed(training), tests, order, intercept=intercept))
        progress("evaluating", seed, repeats)
    fits = progressive_fits(training, np.arange(sensors), intercept=intercept)
    return Performance(by_number=by_number, by_speed=by_speed, fits=fits)


def performance_figures(campaign: Campaign, found: Performance) -> list[Figure]:
    """Return the figures of the residuals of both groups of test sets."""
    figures: list[Figure] = []
    numbers = {COLD_START: ("3-14", "3-15", "3-16", "3-17", "3-18"), IDLE_REDUCTION: ("3-19", "3-20", "3-21", "3-22")}
    for group, places in numbers.items():
        if group not in campaign.tests:
            continue
        figures.append(_residuals(places[0], group, campaign.tests[group], found.fits))
        figures.append(_by_sets(places[1], group, found.by_number))
        figures.append(_by_sensors(places[2], group, found.by_number))
        figures.append(_maps(places[3], group, found.by_number, "in the order of their numbers"))
        if len(places) > 4:
            figures.append(_maps(places[4], group, found.by_speed, "in the order of increasing spindle speed"))
    return figures


def middle(maps: Sequence[dict[Key, ResidualMap]], key: Key, name: str) -> FloatArray:
    """Return the median over the random orders of the sensors, shape (n_sets, n_sensors) [um]."""
    found: FloatArray = np.median([getattr(each[key], name) for each in maps], axis=0)
    return found


def _residuals(number: str, group: str, tests: Sequence[PublishedSet], fits: Sequence[CampaignFits]) -> Figure:
    shown = [count for count in SHOWN_SETS if count <= len(fits)]
    axes = []
    for model in MODELS:
        for test in tests:
            curves: list[Curve] = []
            for place, count in enumerate(shown):
                estimate_um = fits[count - 1].estimates_um(test, model)[:, -1]
                turning, idle = rotating_and_idle(test, test.error_um(measured_channel(model)) - estimate_um)
                colour = COLOURS[place % len(COLOURS)]
                sets = f"{count} training set{'s' if count > 1 else ''}"
                curves.append(Curve(x=test.elapsed_min, y=turning, label=sets, colour=colour))
                curves.append(Curve(x=test.elapsed_min, y=idle, colour=colour, style="dotted", width=0.9))
            title = f"{model}, data set {test.number}"
            axes.append(Axes(title=title, x_label=MINUTES, y_label="residual [um]", curves=curves))
    return Figure(
        number=number,
        title=f"Residuals of the estimates ({group})",
        note="Measured (raw) minus estimated, all sensors; solid while the spindle turns, dotted while it stands.",
        axes=axes,
        columns=len(tests),
    )


def _by_sets(number: str, group: str, maps: Sequence[dict[Key, ResidualMap]]) -> Figure:
    axes = []
    for name, label in PROPERTIES:
        curves = []
        for model in MODELS:
            values = middle(maps, (model, group), name)[:, -1]
            curves.append(Curve(x=np.arange(1.0, 1.0 + len(values)), y=values, label=model))
        axes.append(Axes(x_label="number of training sets", y_label=label, curves=curves, y_range=(0.0, HIGHEST_UM)))
    return Figure(
        number=number,
        title=f"Residuals by number of training sets ({group})",
        note="All sensors, while the spindle turns; mean and maximum of absolute values; larger ones lie above.",
        axes=axes,
        columns=3,
    )


def _by_sensors(number: str, group: str, maps: Sequence[dict[Key, ResidualMap]]) -> Figure:
    axes = []
    for name, label in PROPERTIES:
        curves = []
        for place, model in enumerate(MODELS):
            values = middle(maps, (model, group), name)[-1]
            count = np.arange(1.0, 1.0 + len(values))
            curves.append(Curve(x=count, y=values, label=model, colour=COLOURS[place]))
            for each in maps if len(maps) > 1 else ():
                single = getattr(each[model, group], name)[-1]
                curves.append(Curve(x=count, y=single, colour=COLOURS[place], style="dotted", width=0.5))
        axes.append(Axes(x_label="number of sensors", y_label=label, curves=curves, y_range=(0.0, HIGHEST_UM)))
    return Figure(
        number=number,
        title=f"Residuals by number of temperature sensors ({group})",
        note=f"All training sets; sensors removed at random, median of {len(maps)} orders (dotted: each of them).",
        axes=axes,
        columns=3,
    )


def _maps(number: str, group: str, maps: Sequence[dict[Key, ResidualMap]], order: str) -> Figure:
    axes = []
    for model in MODELS:
        values = middle(maps, (model, group), "max_um")
        heat = Heat(
            x=np.arange(1.0, 1.0 + values.shape[1]),
            y=np.arange(1.0, 1.0 + values.shape[0]),
            values=values,
            contour=CONTOUR_UM,
            highest=HIGHEST_UM,
            unit="um",
        )
        axes.append(Axes(title=model, x_label="number of sensors", y_label="number of training sets", heat=heat))
    return Figure(
        number=number,
        title=f"Largest residual by training sets and sensors ({group})",
        note=f"Training sets {order}; median of {len(maps)} random orders of the sensors; dashed: {CONTOUR_UM:g} um.",
        axes=axes,
        columns=3,
    )
