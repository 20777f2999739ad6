"""Pictures of modes, responses, identifications and studies: PNG by matplotlib, HTML by plotly.

Both libraries are imported when something is drawn, never by the daemon. An HTML file holds all that it needs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from config.spindle import SegmentDescription
from config.spindle_chain import Spindle
from daemon.dynamics.responses import response
from models.dynamics.bearings import PARAMETERS, CondensedShaft, properties_from_parameters
from models.dynamics.measurement import Measurement
from models.records import FloatArray

PIXELS = (1100, 700)
DPI = 110
COLOURS = ("#0b5fa5", "#c8401a", "#2e8b57", "#8a5ca8", "#b8860b", "#444444")
BODY_COLOURS = {"shaft": "#c9d6e2", "ring": "#9fb4c7", "core": "#e8d9c0", "holder": "#e2d3b4", "tool": "#c2c2c2"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """One curve."""

    x: FloatArray
    y: FloatArray
    label: str
    dashed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A rectangle of the drawn spindle [mm]."""

    left: float
    right: float
    bottom: float
    top: float
    kind: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One pair of axes."""

    lines: list[Line]
    x_label: str
    y_label: str
    logarithmic: bool = False
    boxes: list[Box] = field(default_factory=list)
    marks: Sequence[tuple[float, str]] = field(default_factory=list)
    """Positions along x with a word, such as bearings."""


def modes_picture(path: Path, spindle: Spindle, found: dict[str, Any]) -> None:
    """Draw mode shapes over the drawn spindle (Figs. 4-10, 5-15)."""
    lines = [
        Line(
            x=np.array(mode["points_mm"]),
            y=np.array(mode["shape"]),
            label=f"mode {number}: {mode['frequency_hz']:.1f} Hz",
        )
        for number, mode in enumerate(found["modes"], start=1)
    ]
    shapes = Panel(lines=lines, x_label="", y_label="displacement (largest = 1)")
    save(path, [shapes, spindle_panel(spindle)], found["name"] or "modes", heights=(3, 2))


def response_picture(path: Path, spindle: Spindle, found: dict[str, Any]) -> None:
    """Draw a receptance as magnitude and phase (Figs. 4-12, 5-14)."""
    values = np.array(found["receptance_re"]) + 1j * np.array(found["receptance_im"])
    label = f"{found['at']}, rotary inertia {found['rigid_rotary_inertia']}"
    panels = _response_panels([(np.array(found["frequency_hz"]), values, label, False)])
    save(path, panels, found["name"] or "frequency response", heights=(3, 2))


def identified_picture(path: Path, spindle: Spindle, measurement: Measurement, found: dict[str, Any]) -> None:
    """Draw a measurement and the response of the identified model."""
    values = {**found["values"], **found["fixed"]}
    everything = {name: values.get(name, 0.0) for name in PARAMETERS}
    shaft = CondensedShaft(spindle.shaft, measurement.frequency_hz)
    model = shaft.nose_receptance(properties_from_parameters(everything))
    panels = _response_panels(
        [
            (measurement.frequency_hz, measurement.receptance_m_per_n, "measured", False),
            (measurement.frequency_hz, model, f"model, {len(found['values'])} parameters identified", True),
        ]
    )
    save(path, panels, found["name"] or "identification", heights=(3, 2))


def comparison_picture(path: Path, spindles: Sequence[tuple[str, Spindle]], at: str, frequency_hz: FloatArray) -> None:
    """Draw the responses of several layouts (Fig. 4-14)."""
    curves = [
        (frequency_hz, response(spindle, at, frequency_hz), spindle.description.name or Path(file).stem, False)
        for file, spindle in spindles
    ]
    save(path, _response_panels(curves), f"comparison at the {at}", heights=(3, 2))


def sensitivity_picture(path: Path, found: dict[str, Any]) -> None:
    """Draw the change of each mode over the variations (Table 4-4)."""
    count = len(found["baseline"])
    names = [f"{each['moduli']} {each['percent']:+g} %" for each in found["variations"]]
    places = np.arange(len(names), dtype=np.float64)
    lines = [
        Line(
            x=places,
            y=np.array([each["modes"][k]["change_percent"] for each in found["variations"]]),
            label=f"mode {k + 1}: {found['baseline'][k]['frequency_hz']:.1f} Hz",
        )
        for k in range(count)
    ]
    panel = Panel(
        lines=lines,
        x_label="moduli of the composites",
        y_label="change of the frequency [%]",
        marks=list(zip(places.tolist(), names, strict=True)),
    )
    save(path, [panel], found["name"] or "sensitivity", heights=(1,))


def spindle_panel(spindle: Spindle) -> Panel:
    """Return the drawn spindle: segments with rings, cores and bores, holder and tool in front, bearings."""
    told = spindle.description
    boxes: list[Box] = []
    place = 0.0
    for segment in told.segments:
        boxes += _boxes(segment, place, "shaft")
        place += segment.length_mm
    start = 0.0
    for name in ("holder", "tool"):
        body = getattr(told, name)
        if body is not None:
            start -= sum(segment.length_mm for segment in body.segments)
            place = start
            for segment in body.segments:
                boxes += _boxes(segment, place, name)
                place += segment.length_mm
    marks = [(bearing.position_mm, bearing.group) for bearing in told.bearings or ()]
    return Panel(lines=[], x_label="distance from the nose [mm]", y_label="radius [mm]", boxes=boxes, marks=marks)


def _boxes(segment: SegmentDescription, left: float, kind: str) -> list[Box]:
    tubes = [(segment.inner_mm, segment.outer_mm, kind)]
    if segment.ring:
        tubes.append((segment.outer_mm, segment.ring.outer_mm, "ring"))
    if segment.core:
        tubes.append((segment.core.inner_mm, segment.inner_mm, "core"))
    right = left + segment.length_mm
    return [
        Box(left=left, right=right, bottom=sign * inner / 2.0, top=sign * outer / 2.0, kind=each)
        for inner, outer, each in tubes
        for sign in (1.0, -1.0)
    ]


def _response_panels(curves: Sequence[tuple[FloatArray, Any, str, bool]]) -> list[Panel]:
    magnitude = [Line(x=x, y=np.abs(values), label=label, dashed=dashed) for x, values, label, dashed in curves]
    phase = [
        Line(x=x, y=np.degrees(np.angle(values)), label=label, dashed=dashed) for x, values, label, dashed in curves
    ]
    return [
        Panel(lines=magnitude, x_label="", y_label="receptance [m/N]", logarithmic=True),
        Panel(lines=phase, x_label="frequency [Hz]", y_label="phase [deg]"),
    ]


def save(path: Path, panels: Sequence[Panel], title: str, heights: Sequence[int]) -> None:
    """Write panels below each other as a still picture or as a page to zoom into, by the file's ending."""
    if path.suffix.lower() == ".html":
        _save_html(path, panels, title, heights)
    else:
        _save_png(path, panels, title, heights)


def _save_png(path: Path, panels: Sequence[Panel], title: str, heights: Sequence[int]) -> None:
    figure_class = import_module("matplotlib.figure").Figure
    rectangle = import_module("matplotlib.patches").Rectangle
    size = (PIXELS[0] / DPI, PIXELS[1] / DPI)
    figure = figure_class(figsize=size, dpi=DPI, layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=len(panels) > 1, squeeze=False, height_ratios=list(heights))[:, 0]
    for panel, axis in zip(panels, axes, strict=True):
        for index, line in enumerate(panel.lines):
            style = "--" if line.dashed else "-"
            axis.plot(line.x, line.y, style, color=COLOURS[index % len(COLOURS)], label=line.label, linewidth=1.4)
        for box in panel.boxes:
            corner, width, height = (box.left, box.bottom), box.right - box.left, box.top - box.bottom
            axis.add_patch(
                rectangle(corner, width, height, facecolor=BODY_COLOURS[box.kind], edgecolor="#333333", linewidth=0.6)
            )
        if panel.boxes:
            axis.autoscale_view()
            axis.margins(y=0.15)
        _marks(axis, panel)
        axis.set(xlabel=panel.x_label, ylabel=panel.y_label, yscale="log" if panel.logarithmic else "linear")
        axis.grid(True, alpha=0.3)
        if panel.lines:
            axis.legend(fontsize=8)
    axes[0].set_title(title)
    figure.savefig(path)


def _marks(axis: Any, panel: Panel) -> None:
    if not panel.boxes and panel.marks:
        axis.set_xticks([place for place, _ in panel.marks], [word for _, word in panel.marks])
        return
    for place, word in panel.marks:
        axis.axvline(place, color="#c8401a", linewidth=1.0)
        axis.annotate(word, (place, axis.get_ylim()[1]), ha="center", va="top", fontsize=8, color="#c8401a")


def _save_html(path: Path, panels: Sequence[Panel], title: str, heights: Sequence[int]) -> None:
    subplots = import_module("plotly.subplots")
    shares = [height / sum(heights) for height in heights]
    figure = subplots.make_subplots(rows=len(panels), cols=1, shared_xaxes=True, row_heights=shares)
    for row, panel in enumerate(panels, start=1):
        for index, line in enumerate(panel.lines):
            figure.add_scatter(
                x=line.x.tolist(),
                y=line.y.tolist(),
                mode="lines",
                name=line.label,
                showlegend=row == 1,
                line={"color": COLOURS[index % len(COLOURS)], "dash": "dash" if line.dashed else "solid"},
                row=row,
                col=1,
            )
        for box in panel.boxes:
            corners = {"x0": box.left, "x1": box.right, "y0": box.bottom, "y1": box.top}
            figure.add_shape(
                type="rect", **corners, fillcolor=BODY_COLOURS[box.kind], line={"width": 0.6}, row=row, col=1
            )
        if panel.boxes:
            _frame(figure, panel, row)
        elif panel.marks:
            ticks = {"tickvals": [place for place, _ in panel.marks], "ticktext": [word for _, word in panel.marks]}
            figure.update_xaxes(**ticks, row=row, col=1)
        figure.update_xaxes(title_text=panel.x_label, row=row, col=1)
        figure.update_yaxes(title_text=panel.y_label, type="log" if panel.logarithmic else "linear", row=row, col=1)
    figure.update_layout(title=title, height=PIXELS[1], template="plotly_white")
    path.write_text(figure.to_html(include_plotlyjs=True, full_html=True), encoding="utf-8")


def _frame(figure: Any, panel: Panel, row: int) -> None:
    """Give drawn boxes an extent that plotly sees, and mark the bearings."""
    sides = [box.left for box in panel.boxes] + [box.right for box in panel.boxes]
    heights = [box.top for box in panel.boxes]
    figure.add_scatter(
        x=[min(sides), max(sides)], y=[min(heights), max(heights)], mode="markers", opacity=0.0,
        showlegend=False, hoverinfo="skip", row=row, col=1,
    )  # fmt: skip
    for place, word in panel.marks:
        figure.add_vline(x=place, line={"color": "#c8401a", "width": 1}, annotation_text=word, row=row, col=1)
