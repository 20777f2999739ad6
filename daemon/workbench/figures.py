"""Figures as data, drawn as PNG by matplotlib and as parts of one HTML page by plotly, both imported only here."""

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from config.machine.spindle import SegmentDescription
from models.records import FloatArray

COLOURS = ("#0b5fa5", "#c8401a", "#2e8b57", "#8a5ca8", "#b8860b", "#444444", "#1f9e9e", "#d16ba5", "#7a8b00")


DPI = 110


WIDTH_INCH = 10.0


ROW_INCH = 3.4


ROW_PIXELS = 360


CONTOUR_COLOUR = "#1a7f37"


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """One line; NaN breaks it."""

    x: FloatArray
    y: FloatArray
    label: str = ""
    """Empty: not in the legend."""
    colour: str = COLOURS[0]
    style: str = "solid"
    """solid, dotted or dashed."""
    width: float = 1.4


@dataclass(frozen=True, slots=True, kw_only=True)
class Heat:
    """A map with one contour."""

    x: FloatArray
    y: FloatArray
    values: FloatArray
    """Shape (len(y), len(x))."""
    contour: float
    highest: float
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Axes:
    """One pair of axes: curves or a map."""

    title: str = ""
    x_label: str
    y_label: str
    curves: Sequence[Curve] = field(default_factory=list)
    heat: Heat | None = None
    y_top: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A numbered figure."""

    number: str
    title: str
    note: str
    axes: Sequence[Axes]
    columns: int = 1

    @property
    def file(self) -> str:
        """Name of its PNG: figure-3-02.png for 3-2."""
        chapter, _, place = self.number.partition("-")
        return f"figure-{chapter}-{int(place):02}.png"

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of axes."""
        return -(-len(self.axes) // self.columns), self.columns


def save_png(figure: Figure, folder: Path) -> Path:
    """Draw a figure as a still picture; raises OSError."""
    rows, columns = figure.grid
    drawn = import_module("matplotlib.figure").Figure(
        figsize=(WIDTH_INCH, 0.6 + ROW_INCH * rows), dpi=DPI, layout="constrained"
    )
    places = drawn.subplots(rows, columns, squeeze=False).ravel()
    for axes, place in zip(figure.axes, places, strict=False):
        if axes.heat is not None:
            _png_heat(drawn, place, axes.heat)
        for curve in axes.curves:
            place.plot(
                curve.x, curve.y, linestyle=curve.style, color=curve.colour, linewidth=curve.width,
                label=curve.label or "_",
            )  # fmt: skip
        place.set(xlabel=axes.x_label, ylabel=axes.y_label, title=axes.title)
        if axes.y_top is not None:
            place.set_ylim(0.0, axes.y_top)
        if axes.heat is None:
            place.grid(True, alpha=0.3)
        if any(curve.label for curve in axes.curves):
            place.legend(fontsize=7)
    for place in places[len(figure.axes) :]:
        place.set_visible(False)
    drawn.suptitle(f"Fig. {figure.number}  {figure.title}")
    path = folder / figure.file
    drawn.savefig(path)
    return path


def _png_heat(drawn: Any, place: Any, heat: Heat) -> None:
    shown = np.minimum(heat.values, heat.highest)
    image = place.pcolormesh(heat.x, heat.y, shown, cmap="turbo", vmin=0.0, vmax=heat.highest, shading="nearest")
    drawn.colorbar(image, ax=place, label=heat.unit)
    if min(heat.values.shape) > 1 and heat.values.min() < heat.contour < heat.values.max():
        place.contour(heat.x, heat.y, heat.values, levels=[heat.contour], colors=CONTOUR_COLOUR, linestyles="dashed")


def save_html(
    figures: Sequence[Figure], path: Path, *, title: str, introduction: Sequence[str], body: Sequence[str] = ()
) -> None:
    """Write all figures as one page that needs nothing else; `body` is HTML before them. Raises OSError."""
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        f"<title>{html.escape(title)}</title>",
        "<style>body{font-family:sans-serif;max-width:1100px;margin:2em auto;color:#222}"
        "figure{margin:2.5em 0}figcaption{font-size:.95em}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        *(f"<p>{html.escape(line)}</p>" for line in introduction),
        *body,
    ]
    for place, figure in enumerate(figures):
        drawn = _plotly(figure)
        division = drawn.to_html(include_plotlyjs=place == 0, full_html=False)
        caption = f"<b>Fig. {figure.number}</b> {html.escape(figure.title)}. {html.escape(figure.note)}"
        parts.append(f"<figure id='figure-{figure.number}'>{division}<figcaption>{caption}</figcaption></figure>")
    parts.append("</body></html>")
    path.write_text("\n".join(parts), encoding="utf-8")


def _plotly(figure: Figure) -> Any:
    rows, columns = figure.grid
    titles = [axes.title for axes in figure.axes]
    drawn = import_module("plotly.subplots").make_subplots(rows=rows, cols=columns, subplot_titles=titles)
    for index, axes in enumerate(figure.axes):
        place = {"row": index // columns + 1, "col": index % columns + 1}
        if axes.heat is not None:
            _html_heat(drawn, axes.heat, place, bar=index == len(figure.axes) - 1)
        for curve in axes.curves:
            drawn.add_scatter(
                x=_plain(curve.x), y=_plain(curve.y), mode="lines", name=curve.label,
                showlegend=bool(curve.label) and not any(curve.label == c.label for a in figure.axes[:index]
                                                         for c in a.curves),
                legendgroup=curve.label or None,
                line={"color": curve.colour, "width": curve.width,
                      "dash": {"solid": "solid", "dotted": "dot", "dashed": "dash"}[curve.style]},
                **place,
            )  # fmt: skip
        drawn.update_xaxes(title_text=axes.x_label, **place)
        drawn.update_yaxes(title_text=axes.y_label, **place)
        if axes.y_top is not None:
            drawn.update_yaxes(range=[0.0, axes.y_top], **place)
    drawn.update_layout(height=80 + ROW_PIXELS * rows, template="plotly_white", margin={"t": 50})
    return drawn


def _html_heat(drawn: Any, heat: Heat, place: dict[str, int], *, bar: bool) -> None:
    common = {"x": heat.x.tolist(), "y": heat.y.tolist(), "z": np.round(heat.values, 2).tolist(), **place}
    drawn.add_heatmap(
        **common, zmin=0.0, zmax=heat.highest, colorscale="Turbo", showscale=bar, colorbar={"title": heat.unit}
    )
    drawn.add_contour(
        **common, showscale=False, hoverinfo="skip",
        contours={"start": heat.contour, "end": heat.contour, "size": 1.0, "coloring": "none"},
        line={"color": CONTOUR_COLOUR, "dash": "dash", "width": 2},
    )  # fmt: skip


def _plain(values: FloatArray) -> list[float | None]:
    return [round(value, 5) if np.isfinite(value) else None for value in values.tolist()]


PIXELS = (1100, 700)


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
