"""The report of an impact campaign: one HTML page that holds all it needs (Figs 5-2 to 5-13)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from config.files import write_whole
from config.html_page import Section
from config.machine.spindle_chain import Spindle
from daemon.workbench.dynamics.campaign import CampaignResult, few
from daemon.workbench.figures import COLOURS, Axes, Curve, Figure, Heat, report_page
from models.dynamics.bearings import CondensedShaft, properties_from_parameters
from models.records import FloatArray
from models.thermomechanics.fitting import INTERVALS_MIN, variables

SHOWN_RESPONSES = 5
MINUTES = "time [min]"
UNITS = {"kt": "N/m", "ct": "N s/m", "kr": "N m/rad", "cr": "N m s/rad"}
STYLES = ("solid", "dashed", "dotted")
"""Of the folders, in turn."""


def write_report(path: Path, result: CampaignResult, spindle: Spindle) -> None:
    figures = [_temperatures(result)]
    for axis in result.model.axes:
        figures += [_responses(result, spindle, axis), _properties(result, axis)]
    told = result.selection
    title = "Correlation between temperatures (Fig. 5-10)"
    figures.append(_matrix(title, told.autocorrelation, told.candidates, told.candidates))
    title = "Correlation of temperatures with bearing properties (Fig. 5-11)"
    figures.append(_matrix(title, told.crosscorrelation, told.properties, told.candidates))
    figures += [_determination(result, axis) for axis in result.model.axes]
    before = [Section(items=tuple(result.model.training))]
    if result.warnings:
        before.append(Section(title="Warnings", items=tuple(result.warnings)))
    before.append(_regression_table(result))
    title = f"Impact campaign: {result.model.model_id}"
    write_whole(path, report_page(title, before, figures, [_parameter_table(result)]))


def _temperatures(result: CampaignResult) -> Figure:
    curves = []
    for number, run in enumerate(result.runs):
        told = run.temperatures
        for place, name in enumerate(told.signals):
            if name not in result.selection.candidates:
                continue
            colour = COLOURS[result.selection.candidates.index(name) % len(COLOURS)]
            label, style = f"{name}, {run.folder.name}", STYLES[number % 3]
            curves.append(Curve(x=told.time_min, y=told.degc[:, place], label=label, colour=colour, style=style))
        for axis, responses in run.responses.items():
            level = np.full(len(responses.time_min), float(np.nanmin(told.degc)) - 0.5)
            label = f"responses {axis}, {run.folder.name}"
            curves.append(Curve(x=responses.time_min, y=level, label=label, style="none", marker="|"))
    axes = Axes(x_label=MINUTES, y_label="temperature [degC]", curves=curves)
    return Figure(title="Temperatures; ticks: responses (Fig. 5-2)", axes=[axes])


def _responses(result: CampaignResult, spindle: Spindle, axis: str) -> Figure:
    shaft = CondensedShaft(spindle.shaft, result.frequency_hz)
    series, responses = few(result.series[axis])[0], result.runs[0].responses[axis]
    curves = []
    for number, k in enumerate(np.linspace(0, len(series.time_min) - 1, SHOWN_RESPONSES).astype(int).tolist()):
        values = {**series.kept, **dict(zip(series.names, series.values[k].tolist(), strict=True))}
        model = np.abs(shaft.nose_receptance(properties_from_parameters(values)))
        measured = np.abs(responses.measured[k].receptance_m_per_n)
        label, colour = f"{series.time_min[k]:.0f} min", COLOURS[number % len(COLOURS)]
        curves.append(Curve(x=result.frequency_hz, y=measured, label=label, colour=colour))
        curves.append(Curve(x=result.frequency_hz, y=model, colour=colour, style="dashed"))
    axes = Axes(x_label="frequency [Hz]", y_label="receptance [m/N]", logarithmic=True, curves=curves)
    return Figure(title=f"Receptance at the nose, {axis}: solid measured, dashed model (Figs 5-3, 5-4)", axes=[axes])


def _properties(result: CampaignResult, axis: str) -> Figure:
    axes = []
    for name, each in result.fitted[axis].items():
        curves = []
        for number, run in enumerate(result.runs):
            series, minutes = few(result.series[axis])[number], result.minutes[axis][number]
            values, colour = series.values[:, series.names.index(name)], COLOURS[number % len(COLOURS)]
            regressed = variables([minutes], each.regression.interval_min) @ each.regression.coefficients
            label = f"identified, {run.folder.name}"
            curves.append(Curve(x=series.time_min, y=values, label=label, colour=colour, style="none", marker="o"))
            label = f"regressed, {run.folder.name}"
            curves.append(Curve(x=minutes.time_min, y=regressed, label=label, colour=colour))
        axes.append(Axes(title=f"{name} [{UNITS[name.partition('_')[0]]}]", curves=curves))
    axes[-1] = replace(axes[-1], x_label=MINUTES)
    title = f"Bearing properties, {axis} (Figs 5-6 to 5-9)"
    return Figure(title=title, axes=axes, heights=(220,) * len(axes), shared_x=True)


def _matrix(title: str, values: FloatArray, columns: Sequence[str], rows: Sequence[str]) -> Figure:
    x, y = (np.arange(float(len(names))) for names in (columns, rows))
    heat = Heat(x=x, y=y, values=values, lowest=-1.0, highest=1.0, colours="RdBu_r", written=True)
    x_ticks, y_ticks = list(zip(x.tolist(), columns, strict=True)), list(zip(y.tolist(), rows, strict=True))
    return Figure(title=title, axes=[Axes(heat=heat, x_ticks=x_ticks, y_ticks=y_ticks)])


def _determination(result: CampaignResult, axis: str) -> Figure:
    intervals, curves = np.array(INTERVALS_MIN), []
    for number, (name, each) in enumerate(result.fitted[axis].items()):
        colour = COLOURS[number % len(COLOURS)]
        squares, without = (
            np.array([told[minutes] for minutes in INTERVALS_MIN])
            for told in (each.adjusted_r2, each.adjusted_r2_without_squares)
        )
        curves.append(Curve(x=intervals, y=squares, label=name, colour=colour, marker="o"))
        curves.append(Curve(x=intervals, y=without, colour=colour, marker="o", style="dashed"))
    title = f"Adjusted R^2 over the interval, {axis}: solid with squares, dashed without (Figs 5-12, 5-13)"
    axes = Axes(x_label="interval of the differences [min]", y_label="adjusted R^2", curves=curves)
    return Figure(title=title, axes=[axes])


def _regression_table(result: CampaignResult) -> Section:
    groups = "; ".join(" ~ ".join(group) for group in result.selection.groups)
    rows = [
        (f"{name} {axis}", f"{each.regression.interval_min:g}",
         f"{each.adjusted_r2[each.regression.interval_min]:.4f}", f"{each.left_out_error:.3f}",
         f"{each.regression.deviation:.3g}", f"{each.ridge:g}")
        for axis, fits in result.fitted.items()
        for name, each in fits.items()
    ]  # fmt: skip
    return Section(
        title="Regressions",
        text=f"Groups of like signals: {groups}. Used: {', '.join(result.model.signals)}.",
        head=("property", "interval [min]", "adjusted R^2 of least squares",
              "error on left-out stretches / deviation", "what is left over", "penalty [K^2]"),
        rows=tuple(rows),
        kind="numbers",
    )  # fmt: skip


def _parameter_table(result: CampaignResult) -> Section:
    rows = []
    for axis, sets in result.series.items():
        for count, found in sets.items():
            values = np.concatenate([each.values for each in found])
            shares = np.mean([each.identifiable for each in found], axis=0)
            for k, name in enumerate(found[0].names):
                told = (f"{each:.3g}" for each in (values[:, k].min(), np.median(values[:, k]), values[:, k].max()))
                rows.append((f"{name} {axis}", count, *told, f"{shares[k]:.0%}"))
    head = ("parameter", "varied together", "least", "median", "largest", "responses that determine it")
    return Section(title="All identified parameters", head=head, rows=tuple(rows), kind="numbers")
