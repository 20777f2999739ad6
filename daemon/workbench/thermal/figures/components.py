"""Figures 3-7 to 3-11: principal components of the temperatures and of their differences."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daemon.workbench.figures import COLOURS, Axes, Curve, Figure
from daemon.workbench.thermal.figures.campaign import Campaign, Progress
from models.thermal.training.principal_components import SHARE, PrincipalComponents, differences, principal_components

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
