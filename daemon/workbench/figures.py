"""Figures as data, drawn as PNG by matplotlib and as parts of an HTML page, complete in one file, by plotly."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from config.html_page import Section, html_page
from models.records import FloatArray

COLOURS = ("#0072b2", "#c25400", "#00805c", "#a84b85", "#8a6d00", "#2b86b8", "#54626f", "#6d4bb0", "#16202a")
"""Those of the monitor's pages (`daemon/monitor/pages/style.css`), told apart with every kind of colour vision."""
BODY_COLOURS = {"shaft": "#c9d6e2", "ring": "#9fb4c7", "core": "#e8d9c0", "holder": "#e2d3b4", "tool": "#c2c2c2"}
CONTOUR_COLOUR = "#00805c"
MARK_COLOUR = "#9b4a00"
MARKS_PIXELS = 28
"""The words of marks stand in two rows above the axes, and the title above them."""
TITLE_PIXELS = 26
LABEL_PIXELS = 12
"""A label stands below the axes, on a narrow page two in a line: beside them it took half of their width."""
MOST_IN_WORDS = 110
"""Of marks so many letters are written: of more every second, third ... word."""
FILL_OPACITY = 0.14
INK, GRID = "#16202a", "#e6ebf0"
FONT = "system-ui, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"
DPI = 110
WIDTH_INCH = 10.0
ROW_PIXELS = 370
DASHES = {"solid": "solid", "dotted": "dot", "dashed": "dash"}
"""Style of a line -> plotly's name; matplotlib takes ours."""
MARKERS = {"o": "circle", "x": "x-thin-open", "|": "line-ns-open"}
"""Marker of matplotlib -> plotly's name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """One line, or its points; NaN breaks it."""

    x: FloatArray
    y: FloatArray
    label: str = ""
    """Empty: not in the legend."""
    colour: str = ""
    """Empty: by its place among the curves of its axes."""
    style: str = "solid"
    """solid, dotted, dashed, or none: points alone."""
    width: float = 1.4
    marker: str = ""
    """o, x, |, or empty: none."""
    filled: bool = False
    """The area between it and zero is filled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Heat:
    """A map over evenly spaced positions."""

    x: FloatArray
    y: FloatArray
    values: FloatArray
    """Shape (len(y), len(x))."""
    lowest: float = 0.0
    highest: float
    unit: str = ""
    colours: str = "viridis"
    contour: float | None = None
    written: bool = False
    """Each value is written into its place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A rectangle of a drawn body."""

    left: float
    right: float
    bottom: float
    top: float
    kind: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Axes:
    """One pair of axes: curves, a map or a drawn body."""

    title: str = ""
    x_label: str = ""
    y_label: str = ""
    curves: Sequence[Curve] = field(default_factory=list)
    heat: Heat | None = None
    boxes: Sequence[Box] = ()
    marks: Sequence[tuple[float, str]] = ()
    """Upright lines at positions along x, each with a word."""
    x_ticks: Sequence[tuple[float, str]] = ()
    y_ticks: Sequence[tuple[float, str]] = ()
    """Words instead of numbers."""
    y_range: tuple[float, float] | None = None
    logarithmic: bool = False

    def colour(self, index: int) -> str:
        return self.curves[index].colour or COLOURS[index % len(COLOURS)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """Axes in rows, with a title and, in a report, a number."""

    title: str
    axes: Sequence[Axes]
    number: str = ""
    note: str = ""
    columns: int = 1
    heights: Sequence[int] = ()
    """Of the rows [pixel]; empty: all alike."""
    shared_x: bool = False

    @property
    def file(self) -> str:
        """Name of its PNG: figure-3-02.png for 3-2."""
        chapter, _, place = self.number.partition("-")
        return f"figure-{chapter}-{int(place):02}.png"

    @property
    def row_pixels(self) -> list[int]:
        """Heights of the rows [pixel]."""
        return list(self.heights) or [ROW_PIXELS] * -(-len(self.axes) // self.columns)

    @property
    def heading(self) -> str:
        return f"Fig. {self.number}  {self.title}" if self.number else self.title


def stand_alone(values: FloatArray) -> bool:
    """Return whether most values that are known have no known neighbour, as those of a probe: no line shows them."""
    known = np.concatenate([[False], np.isfinite(values), [False]])
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    return bool(2 * alone.sum() > known.sum())


def save(path: Path, figure: Figure) -> None:
    """Write a figure as a still picture or as a page to zoom into, by the file's ending; raises OSError."""
    if path.suffix.lower() == ".html":
        path.write_text(html_page(figure.title, [picture(figure, alone=True)]), encoding="utf-8")
    else:
        save_png(path, figure)


def report_page(title: str, before: Sequence[Section], figures: Sequence[Figure], after: Sequence[Section] = ()) -> str:
    """Return a page of figures between texts and tables."""
    drawn = [picture(figure, alone=place == 0) for place, figure in enumerate(figures)]
    return html_page(title, [*before, *drawn, *after])


def picture(figure: Figure, *, alone: bool) -> Section:
    """Return a figure as part of a page; the first one of a page (`alone`) brings plotly along."""
    division = _plotly(figure).to_html(include_plotlyjs=alone, full_html=False)
    caption = f"Fig. {figure.number} {figure.title}. {figure.note}" if figure.number else figure.note
    return Section(name=f"figure-{figure.number}" if figure.number else "", picture=division, caption=caption)


def save_png(path: Path, figure: Figure) -> None:
    """Write a figure as a still picture; raises OSError."""
    from matplotlib.figure import Figure as Sheet

    pixels = figure.row_pixels
    sheet = Sheet(figsize=(WIDTH_INCH, 0.4 + sum(pixels) / DPI), dpi=DPI, layout="constrained")
    places = sheet.subplots(
        len(pixels), figure.columns, squeeze=False, sharex=figure.shared_x, height_ratios=pixels
    ).ravel()
    for axes, place in zip(figure.axes, places, strict=False):
        _png_axes(sheet, place, axes)
    for place in places[len(figure.axes) :]:
        place.set_visible(False)
    sheet.suptitle(figure.heading)
    sheet.savefig(path)


def _png_axes(sheet: Any, place: Any, axes: Axes) -> None:
    if axes.heat is not None:
        _png_heat(sheet, place, axes.heat)
    for index, curve in enumerate(axes.curves):
        marker = curve.marker or ("o" if stand_alone(curve.y) else "")
        place.plot(
            curve.x, curve.y, linestyle=curve.style, marker=marker, color=axes.colour(index),
            linewidth=curve.width, label=curve.label or "_",
        )  # fmt: skip
        if curve.filled:
            place.fill_between(curve.x, curve.y, color=axes.colour(index), alpha=FILL_OPACITY, linewidth=0.0)
    if axes.boxes:
        _png_boxes(place, axes.boxes)
    place.set(xlabel=axes.x_label, ylabel=axes.y_label, title=axes.title)
    place.set_yscale("log" if axes.logarithmic else "linear")
    if axes.y_range is not None:
        place.set_ylim(*axes.y_range)
    for ticks, set_ticks in ((axes.x_ticks, place.set_xticks), (axes.y_ticks, place.set_yticks)):
        if ticks:
            set_ticks([at for at, _ in ticks], [word for _, word in ticks])
    for at, _ in axes.marks:
        place.axvline(at, color=MARK_COLOUR, linewidth=1.0)
    for row, (at, word) in enumerate(_named_marks(axes.marks)):
        place.annotate(
            word, (at, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3 + 10 * (row % 2)),
            textcoords="offset points", ha="center", va="bottom", fontsize=8, color=MARK_COLOUR,
        )  # fmt: skip
    if axes.heat is None:
        place.grid(True, alpha=0.3)
    if any(curve.label for curve in axes.curves):
        place.legend(fontsize=7)


def _named_marks(marks: Sequence[tuple[float, str]]) -> list[tuple[float, str]]:
    """Return each word once for marks that follow one another, in the middle of them."""
    named: list[tuple[list[float], str]] = []
    for at, word in sorted(marks):
        if named and named[-1][1] == word:
            named[-1][0].append(at)
        else:
            named.append(([at], word))
    words = [(sum(places) / len(places), word) for places, word in named if word]
    return words[:: max(1, -(-sum(len(word) for _, word in words) // MOST_IN_WORDS))]


def _png_heat(sheet: Any, place: Any, heat: Heat) -> None:
    extent = [edge for values in (heat.x, heat.y) for edge in _edges(values)]
    image = place.imshow(
        heat.values, origin="lower", aspect="auto", extent=extent, cmap=heat.colours,
        vmin=heat.lowest, vmax=heat.highest,
    )  # fmt: skip
    sheet.colorbar(image, ax=place, label=heat.unit)
    if heat.contour is not None and min(heat.values.shape) > 1 and heat.values.min() < heat.contour < heat.values.max():
        place.contour(heat.x, heat.y, heat.values, levels=[heat.contour], colors=CONTOUR_COLOUR, linestyles="dashed")
    if heat.written:
        for row, y in enumerate(heat.y.tolist()):
            for column, x in enumerate(heat.x.tolist()):
                place.annotate(f"{heat.values[row, column]:.2f}", (x, y), ha="center", va="center", fontsize=7)


def _edges(values: FloatArray) -> tuple[float, float]:
    half = 0.5 * float(values[1] - values[0]) if len(values) > 1 else 0.5
    return float(values[0]) - half, float(values[-1]) + half


def _png_boxes(place: Any, boxes: Sequence[Box]) -> None:
    from matplotlib.patches import Rectangle

    for box in boxes:
        corner, width, height = (box.left, box.bottom), box.right - box.left, box.top - box.bottom
        place.add_patch(
            Rectangle(corner, width, height, facecolor=BODY_COLOURS[box.kind], edgecolor="#333333", linewidth=0.6)
        )
    place.autoscale_view()
    place.margins(y=0.15)


def _plotly(figure: Figure) -> Any:
    from plotly.subplots import make_subplots

    pixels = figure.row_pixels
    drawn = make_subplots(
        rows=len(pixels), cols=figure.columns, subplot_titles=[axes.title for axes in figure.axes],
        shared_xaxes=figure.shared_x, row_heights=[height / sum(pixels) for height in pixels],
    )  # fmt: skip
    marked = {axes.title for axes in figure.axes if axes.marks}
    drawn.for_each_annotation(lambda title: title.update(yshift=MARKS_PIXELS if title.text in marked else 0))
    shown: set[str] = {""}
    for index, axes in enumerate(figure.axes):
        place = {"row": index // figure.columns + 1, "col": index % figure.columns + 1}
        _plotly_axes(drawn, axes, place, shown, bar=index == len(figure.axes) - 1)
    title = {} if figure.number else {"title": {"text": figure.title, "yref": "container", "y": 1.0, "pad": {"t": 12}}}
    labels = {curve.label for axes in figure.axes for curve in axes.curves} - {""}
    top = 50 + (TITLE_PIXELS if title else 0) + (MARKS_PIXELS if marked else 0)
    bottom = 70 + LABEL_PIXELS * len(labels)
    drawn.update_layout(height=top + sum(pixels) + bottom - 80, template="plotly_white", **title)
    drawn.update_layout(margin={"t": top, "b": bottom, "l": 60, "r": 20})
    drawn.update_layout(legend={"orientation": "h", "yref": "container", "y": 0.0, "yanchor": "bottom", "x": 0.0})
    drawn.update_layout(font={"family": FONT, "color": INK})
    drawn.update_xaxes(gridcolor=GRID)
    drawn.update_yaxes(gridcolor=GRID)
    return drawn


def _plotly_axes(drawn: Any, axes: Axes, place: dict[str, int], shown: set[str], *, bar: bool) -> None:
    if axes.heat is not None:
        _plotly_heat(drawn, axes.heat, place, bar=bar)
    for index, curve in enumerate(axes.curves):
        points = bool(curve.marker) or stand_alone(curve.y)
        mode = "+".join(["lines"] * (curve.style != "none") + ["markers"] * points)
        line = {"color": axes.colour(index), "width": curve.width, "dash": DASHES.get(curve.style, "solid")}
        drawn.add_scatter(
            x=_plain(curve.x), y=_plain(curve.y), mode=mode, name=curve.label, line=line,
            marker={"symbol": MARKERS.get(curve.marker, "circle"), "color": axes.colour(index)},
            showlegend=curve.label not in shown, legendgroup=curve.label or None, **place,
            **({"fill": "tozeroy", "fillcolor": _transparent(axes.colour(index))} if curve.filled else {}),
        )  # fmt: skip
        shown.add(curve.label)
    if axes.boxes:
        _plotly_boxes(drawn, axes.boxes, place)
    for at, _ in axes.marks:
        drawn.add_vline(x=at, line={"color": MARK_COLOUR, "width": 1}, **place)
    for row, (at, word) in enumerate(_named_marks(axes.marks)):
        drawn.add_annotation(
            x=at, y=1.0, yref="y domain", yanchor="bottom", yshift=14 * (row % 2), text=word, showarrow=False,
            font={"color": MARK_COLOUR, "size": 11}, **place,
        )  # fmt: skip
    drawn.update_xaxes(title_text=axes.x_label, **_plotly_ticks(axes.x_ticks), **place)
    scale = "log" if axes.logarithmic else "linear"
    drawn.update_yaxes(title_text=axes.y_label, type=scale, **_plotly_ticks(axes.y_ticks), **place)
    if axes.y_range is not None:
        drawn.update_yaxes(range=list(axes.y_range), **place)


def _transparent(colour: str) -> str:
    red, green, blue = (int(colour[start : start + 2], 16) for start in (1, 3, 5))
    return f"rgba({red},{green},{blue},{FILL_OPACITY})"


def _plotly_ticks(ticks: Sequence[tuple[float, str]]) -> dict[str, Any]:
    return {"tickvals": [at for at, _ in ticks], "ticktext": [word for _, word in ticks]} if ticks else {}


def _plotly_heat(drawn: Any, heat: Heat, place: dict[str, int], *, bar: bool) -> None:
    common = {"x": heat.x.tolist(), "y": heat.y.tolist(), "z": np.round(heat.values, 2).tolist(), **place}
    written = {"text": np.round(heat.values, 2), "texttemplate": "%{text}"} if heat.written else {}
    drawn.add_heatmap(
        **common, **written, zmin=heat.lowest, zmax=heat.highest, colorscale=heat.colours, showscale=bar,
        colorbar={"title": heat.unit},
    )  # fmt: skip
    if heat.contour is not None:
        drawn.add_contour(
            **common, showscale=False, hoverinfo="skip",
            contours={"start": heat.contour, "end": heat.contour, "size": 1.0, "coloring": "none"},
            line={"color": CONTOUR_COLOUR, "dash": "dash", "width": 2},
        )  # fmt: skip


def _plotly_boxes(drawn: Any, boxes: Sequence[Box], place: dict[str, int]) -> None:
    for box in boxes:
        corners = {"x0": box.left, "x1": box.right, "y0": box.bottom, "y1": box.top}
        drawn.add_shape(type="rect", **corners, fillcolor=BODY_COLOURS[box.kind], line={"width": 0.6}, **place)
    sides = [box.left for box in boxes] + [box.right for box in boxes]
    heights = [box.top for box in boxes]
    # plotly sees no extent in shapes: two points without ink give it one
    drawn.add_scatter(
        x=[min(sides), max(sides)], y=[min(heights), max(heights)], mode="markers", opacity=0.0,
        showlegend=False, hoverinfo="skip", **place,
    )  # fmt: skip


def _plain(values: FloatArray) -> list[float | None]:
    return [float(f"{value:.7g}") if np.isfinite(value) else None for value in np.asarray(values).tolist()]
