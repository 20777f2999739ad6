"""The report of an impact campaign: one HTML page that holds all it needs (Figs 5-2 to 5-13), by plotly."""

from collections.abc import Mapping, Sequence
from html import escape
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from config.machine.spindle_chain import Spindle
from daemon.workbench.dynamics.campaign import CampaignResult
from daemon.workbench.figures import COLOURS
from models.dynamics.bearings import CondensedShaft, properties_from_parameters
from models.dynamics.identification import FIXED
from models.thermomechanics.fitting import INTERVALS_MIN, variables

SHOWN_RESPONSES = 5
UNITS = {"kt": "N/m", "ct": "N s/m", "kr": "N m/rad", "cr": "N m s/rad"}
STYLE = (
    "body{font-family:sans-serif;max-width:1150px;margin:2em auto;padding:0 1em}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.25em .6em;text-align:right}th:first-child,td:first-child{text-align:left}"
)


def write_report(path: Path, result: CampaignResult, spindle: Spindle) -> None:
    """Write the report as one page."""
    figures = [_temperatures(result)]
    for axis in result.model.axes:
        figures += [_responses(result, spindle, axis), _properties(result, axis)]
    figures += [_matrix(result, "auto"), _matrix(result, "cross")]
    figures += [_determination(result, axis) for axis in result.model.axes]
    warnings = "".join(f"<li>{escape(each)}</li>" for each in result.warnings)
    write_page(
        path,
        f"Impact campaign: {result.model.model_id}",
        [
            f"<ul>{''.join(f'<li>{escape(each)}</li>' for each in result.model.training)}</ul>",
            f"<h2>Warnings</h2><ul>{warnings}</ul>" if warnings else "",
            _regression_table(result),
        ],
        figures,
        [_parameter_table(result)],
    )


def write_page(path: Path, title: str, before: Sequence[str], figures: Sequence[Any], after: Sequence[str]) -> None:
    """Write a page that holds all it needs: text, figures, text."""
    drawn = [figure.to_html(include_plotlyjs=number == 0, full_html=False) for number, figure in enumerate(figures)]
    head = f"<meta charset='utf-8'><title>{escape(title)}</title><style>{STYLE}</style>"
    page = [f"<!doctype html><html lang='en'>{head}<h1>{escape(title)}</h1>", *before, *drawn, *after, "</html>"]
    path.write_text("\n".join(page), encoding="utf-8")


def new_figure(title: str, x: str, y: str, *, logarithmic: bool = False) -> Any:
    """Return an empty figure with its axes named."""
    figure = import_module("plotly.graph_objects").Figure()
    figure.update_layout(title=title, template="plotly_white", height=460, xaxis_title=x, yaxis_title=y)
    if logarithmic:
        figure.update_yaxes(type="log")
    return figure


def _temperatures(result: CampaignResult) -> Any:
    figure = new_figure("Temperatures; ticks: responses (Fig. 5-2)", "time [min]", "temperature [degC]")
    for number, run in enumerate(result.runs):
        told = run.temperatures
        for place, name in enumerate(told.signals):
            if name not in result.selection.candidates:
                continue
            colour = COLOURS[result.selection.candidates.index(name) % len(COLOURS)]
            figure.add_scatter(
                x=told.time_min, y=told.degc[:, place], mode="lines", name=f"{name}, {run.folder.name}",
                line={"color": colour, "dash": ("solid", "dash", "dot")[number % 3]},
            )  # fmt: skip
        for axis, responses in run.responses.items():
            level = float(np.nanmin(told.degc)) - 0.5
            figure.add_scatter(
                x=responses.time_min, y=np.full(len(responses.time_min), level), mode="markers",
                marker={"symbol": "line-ns-open", "size": 9}, name=f"responses {axis}, {run.folder.name}",
            )  # fmt: skip
    return figure


def _responses(result: CampaignResult, spindle: Spindle, axis: str) -> Any:
    title = f"Receptance at the nose, {axis}: solid measured, dashed model (Figs 5-3, 5-4)"
    figure = new_figure(title, "frequency [Hz]", "receptance [m/N]", logarithmic=True)
    shaft = CondensedShaft(spindle.shaft, result.frequency_hz)
    series, responses = result.series[axis][5][0], result.runs[0].responses[axis]
    for number, k in enumerate(np.linspace(0, len(series.time_min) - 1, SHOWN_RESPONSES).astype(int).tolist()):
        values = {**FIXED[5], **dict(zip(series.names, series.values[k].tolist(), strict=True))}
        model = shaft.nose_receptance(properties_from_parameters(values))
        name, colour = f"{series.time_min[k]:.0f} min", COLOURS[number % len(COLOURS)]
        measured = np.abs(responses.measured[k].receptance_m_per_n)
        figure.add_scatter(x=result.frequency_hz, y=measured, mode="lines", name=name, line={"color": colour})
        figure.add_scatter(
            x=result.frequency_hz,
            y=np.abs(model),
            mode="lines",
            showlegend=False,
            line={"color": colour, "dash": "dash"},
        )
    return figure


def _properties(result: CampaignResult, axis: str) -> Any:
    fits = result.fitted[axis]
    subplots = import_module("plotly.subplots")
    titles = [f"{name} [{UNITS[name.partition('_')[0]]}]" for name in fits]
    figure = subplots.make_subplots(rows=len(fits), cols=1, shared_xaxes=True, subplot_titles=titles)
    for number, run in enumerate(result.runs):
        series, minutes = result.series[axis][5][number], result.minutes[axis][number]
        for row, (name, each) in enumerate(fits.items(), start=1):
            k = series.names.index(name)
            colour = COLOURS[number % len(COLOURS)]
            regressed = variables([minutes], each.regression.interval_min) @ each.regression.coefficients
            figure.add_scatter(
                x=series.time_min, y=series.values[:, k], mode="markers", marker={"color": colour},
                name=f"identified, {run.folder.name}", showlegend=row == 1, row=row, col=1,
            )  # fmt: skip
            figure.add_scatter(
                x=minutes.time_min, y=regressed, mode="lines", line={"color": colour},
                name=f"regressed, {run.folder.name}", showlegend=row == 1, row=row, col=1,
            )  # fmt: skip
    title = f"Bearing properties, {axis} (Figs 5-6 to 5-9)"
    figure.update_layout(title=title, template="plotly_white", height=220 * len(fits))
    figure.update_xaxes(title_text="time [min]", row=len(fits), col=1)
    return figure


def _matrix(result: CampaignResult, kind: str) -> Any:
    told = result.selection
    values = told.autocorrelation if kind == "auto" else told.crosscorrelation
    columns = told.candidates if kind == "auto" else told.properties
    title = (
        "Correlation between temperatures (Fig. 5-10)"
        if kind == "auto"
        else "Correlation of temperatures with bearing properties (Fig. 5-11)"
    )
    figure = new_figure(title, "", "")
    figure.add_heatmap(
        z=values, x=list(columns), y=list(told.candidates), zmin=-1.0, zmax=1.0, colorscale="RdBu", reversescale=True,
        text=np.round(values, 2), texttemplate="%{text}",
    )  # fmt: skip
    return figure


def _determination(result: CampaignResult, axis: str) -> Any:
    title = f"Adjusted R^2 over the interval, {axis}: solid with squares, dashed without (Figs 5-12, 5-13)"
    figure = new_figure(title, "interval of the differences [min]", "adjusted R^2")
    curves: list[tuple[str, str]] = [("adjusted_r2", "solid"), ("adjusted_r2_without_squares", "dash")]
    for number, (name, each) in enumerate(result.fitted[axis].items()):
        for attribute, dash in curves:
            told: Mapping[float, float] = getattr(each, attribute)
            figure.add_scatter(
                x=list(INTERVALS_MIN), y=[told[minutes] for minutes in INTERVALS_MIN], mode="lines+markers",
                name=name, showlegend=dash == "solid", line={"color": COLOURS[number % len(COLOURS)], "dash": dash},
            )  # fmt: skip
    return figure


def _regression_table(result: CampaignResult) -> str:
    groups = "; ".join(" ~ ".join(group) for group in result.selection.groups)
    rows = [
        f"<tr><td>{name} {axis}</td><td>{each.regression.interval_min:g}</td>"
        f"<td>{each.adjusted_r2[each.regression.interval_min]:.4f}</td><td>{each.left_out_error:.3f}</td>"
        f"<td>{each.regression.deviation:.3g}</td><td>{each.ridge:g}</td></tr>"
        for axis, fits in result.fitted.items()
        for name, each in fits.items()
    ]
    return (
        f"<h2>Regressions</h2><p>Groups of like signals: {escape(groups)}. "
        f"Used: {escape(', '.join(result.model.signals))}.</p>"
        "<table><tr><th>property</th><th>interval [min]</th><th>adjusted R^2 of least squares</th>"
        "<th>error on left-out stretches / deviation</th><th>what is left over</th><th>penalty [K^2]</th></tr>"
        + "".join(rows)
        + "</table>"
    )


def _parameter_table(result: CampaignResult) -> str:
    rows = []
    for axis, sets in result.series.items():
        for count, found in sets.items():
            values = np.concatenate([each.values for each in found])
            shares = np.mean([each.identifiable for each in found], axis=0)
            rows += [
                f"<tr><td>{name} {axis}</td><td>{count}</td><td>{values[:, k].min():.3g}</td>"
                f"<td>{np.median(values[:, k]):.3g}</td><td>{values[:, k].max():.3g}</td><td>{shares[k]:.0%}</td></tr>"
                for k, name in enumerate(found[0].names)
            ]
    return (
        "<h2>All identified parameters</h2><table><tr><th>parameter</th><th>varied together</th><th>least</th>"
        "<th>median</th><th>largest</th><th>responses that determine it</th></tr>" + "".join(rows) + "</table>"
    )
