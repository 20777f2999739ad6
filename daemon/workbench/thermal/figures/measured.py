"""Figures 3-2 to 3-6, 3-12 and 3-13: what was measured."""

from collections.abc import Sequence

import numpy as np

from daemon.workbench.figures import COLOURS, Axes, Curve, Figure
from daemon.workbench.thermal.figures.campaign import COLD_START, IDLE_REDUCTION, Campaign
from models.records import FloatArray
from models.thermal.training.published import PublishedSet

MINUTES = "time [min]"
MICROMETRES = "displacement [um]"
AFTER_STANDBY, AFTER_COLD, AFTER_IDLE_REDUCTION = "#2e8b57", "#0b5fa5", "#c8401a"
SHOWN_LABELS = ("A", "B", "C", "D", "E", "F", "IR", "Room")


def measured_figures(campaign: Campaign) -> list[Figure]:
    """Return the figures of the measurement; those whose channels or labels are missing are left out."""
    figures: list[Figure] = []
    if campaign.overview is not None:
        figures.append(_overview(campaign))
    fastest = _fastest(campaign)
    figures.append(_by_previous(campaign, fastest))
    figures.append(_expansion(campaign, fastest))
    if all("Y1" in each.recording.displacement_names for each in fastest):
        figures.append(_inclination(campaign, fastest))
    figures.append(_by_speed(campaign))
    for number, group in (("3-12", COLD_START), ("3-13", IDLE_REDUCTION)):
        if group in campaign.tests:
            figures.append(_tested(number, group, campaign.tests[group]))
    return figures


def _fastest(campaign: Campaign) -> list[PublishedSet]:
    highest = max(each.speed_rpm for each in campaign.training)
    return [each for each in campaign.training if each.speed_rpm > 0.99 * highest]


def _overview(campaign: Campaign) -> Figure:
    assert campaign.overview is not None
    shown = campaign.overview
    days = shown.time_h / 24.0
    return Figure(
        number="3-2",
        title="Spindle speed and temperature Room during the campaign",
        note="Breaks are times at which the machine stood switched off.",
        axes=[
            Axes(x_label="time [d]", y_label="speed [1/min]", curves=[Curve(x=days, y=shown.speed_rpm, label="speed")]),
            Axes(
                x_label="time [d]",
                y_label="Room [degC]",
                curves=[Curve(x=days, y=shown.room_degc, label="Room", colour=COLOURS[1])],
            ),
        ],
    )


def _history(campaign: Campaign, each: PublishedSet) -> tuple[str, str]:
    cooling = campaign.entries[each.number].cooling
    if "after idle reduction" in cooling:
        return AFTER_IDLE_REDUCTION, f"{each.number}: after idle reduction"
    if "cold start" in cooling:
        return AFTER_COLD, f"{each.number}: {cooling}"
    return AFTER_STANDBY, f"{each.number}: after standby"


def _curves(campaign: Campaign, sets: Sequence[PublishedSet], values: Sequence[FloatArray]) -> list[Curve]:
    styles: dict[str, int] = {}
    curves = []
    for each, y in zip(sets, values, strict=True):
        colour, label = _history(campaign, each)
        style = ("solid", "dashed", "dotted")[styles.setdefault(colour, 0) % 3]
        styles[colour] += 1
        curves.append(Curve(x=each.elapsed_min, y=y, label=label, colour=colour, style=style))
    return curves


def _by_previous(campaign: Campaign, sets: list[PublishedSet]) -> Figure:
    return Figure(
        number="3-3",
        title=f"Thermal errors at {sets[0].speed_rpm:.0f} 1/min by the operation before",
        note="Raw displacements since the start of each data set; green after standby, blue from cold, red after "
        "idle reduction.",
        axes=[
            Axes(
                title=channel,
                x_label=MINUTES,
                y_label=MICROMETRES,
                curves=_curves(campaign, sets, [each.error_um(channel) for each in sets]),
            )
            for channel in ("Y2", "Z2")
        ],
    )


def _expansion(campaign: Campaign, sets: list[PublishedSet]) -> Figure:
    shown = next((each for each in sets if each.number == 2), sets[0])
    time_min = shown.elapsed_min
    names = [name for name in ("Z1", "Z2", "Z3") if name in shown.recording.displacement_names]
    lines: dict[str, FloatArray] = {name: shown.error_um(name) for name in names}
    if "Z3" in lines:
        lines["Z3 - Z1"] = lines["Z3"] - lines["Z1"]
    lines["Z1 - Z2"] = lines["Z1"] - lines["Z2"]
    expansion = [
        Curve(x=time_min, y=y, label=label, style="dashed" if "-" in label else "solid") for label, y in lines.items()
    ]
    degc = {label: campaign.labelled_degc(shown, label) for label in SHOWN_LABELS}
    warm = [
        Curve(x=time_min, y=values, label=f"temperature {label}")
        for label, values in degc.items()
        if values is not None
    ]
    return Figure(
        number="3-4",
        title=f"Expansion along Z and temperatures around the spindle unit, data set {shown.number}",
        note="Z3 - Z1: between nose and front cover; Z1 - Z2: length of the test bar.",
        axes=[
            Axes(x_label=MINUTES, y_label=MICROMETRES, curves=expansion),
            Axes(x_label=MINUTES, y_label="temperature [degC]", curves=warm),
        ],
    )


def _inclination(campaign: Campaign, sets: list[PublishedSet]) -> Figure:
    values = [each.error_um("Y2") - each.error_um("Y1") for each in sets]
    return Figure(
        number="3-5",
        title="Inclination Y2 - Y1 of the test bar",
        note="The jump at spindle on and off is left in.",
        axes=[Axes(x_label=MINUTES, y_label="Y2 - Y1 [um]", curves=_curves(campaign, sets, values))],
    )


def _by_speed(campaign: Campaign) -> Figure:
    by_speed: dict[float, PublishedSet] = {}
    for each in campaign.training:
        if not campaign.entries[each.number].cooling:
            by_speed.setdefault(each.speed_rpm, each)
    shown = [by_speed[speed] for speed in sorted(by_speed)] or campaign.training[:1]
    return Figure(
        number="3-6",
        title="Thermal errors by spindle speed",
        note="One data set for each speed, after standby.",
        axes=[
            Axes(
                title=channel,
                x_label=MINUTES,
                y_label=MICROMETRES,
                curves=[
                    Curve(
                        x=each.elapsed_min,
                        y=each.error_um(channel),
                        label=f"{each.speed_rpm:.0f} 1/min (set {each.number})",
                    )
                    for each in shown
                ],
            )
            for channel in ("Y2", "Z2", "Z1")
        ],
    )


def _tested(number: str, group: str, sets: list[PublishedSet]) -> Figure:
    axes = []
    for each in sets:
        assert each.recording.speed_rpm is not None
        curves = [Curve(x=each.elapsed_min, y=each.error_um(name), label=name) for name in ("Y2", "Z2", "Z1")]
        axes.append(Axes(title=f"data set {each.number}", x_label=MINUTES, y_label=MICROMETRES, curves=curves))
        speed = Curve(x=each.elapsed_min, y=each.recording.speed_rpm, label="speed", colour=COLOURS[5])
        axes.append(Axes(title="", x_label=MINUTES, y_label="speed [1/min]", curves=[speed]))
    names = " and ".join(str(each.number) for each in sets)
    return Figure(
        number=number,
        title=f"Thermal errors of the test sets ({group}), data set {names}",
        note="Raw displacements since the start.",
        axes=axes,
        columns=2,
    )


def rotating_and_idle(each: PublishedSet, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a series twice: NaN while the spindle stands, and NaN while it turns."""
    turning = each.rotating
    return np.where(turning, values, np.nan), np.where(turning, np.nan, values)
