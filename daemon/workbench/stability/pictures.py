"""Pictures of lobes, responses and spectrograms: PNG by matplotlib, HTML by plotly, both imported only here."""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import numpy as np

from daemon.workbench.figures import COLOURS, DPI, PIXELS, Line, Panel, save
from models.records import FloatArray
from models.stability.chatter import SpectrumFrame
from models.stability.frf_modal_fit import ModalFit
from models.stability.lobes import StabilityLobes
from models.stability.response import ComplexArray, modal_receptance

SHOWN_OVER_MINIMUM = 8.0
"""Lobes are drawn up to this multiple of their lowest depth, unless a deeper one is asked for."""
COLOUR_RANGE_DB = 60.0


def lobes_picture(
    path: Path,
    diagrams: Sequence[tuple[str, StabilityLobes]],
    *,
    commanded: Sequence[float | None] = (),
    depth_mm: float | None = None,
    title: str = "Stability lobes",
) -> None:
    """Draw the lobes of one or more states, the programmed depth, and the speed commanded in each state."""
    lowest = [lobes.minimum.depth_mm for _, lobes in diagrams if lobes.minimum]
    finite = [float(np.min(lobes.limiting_depth_mm)) for _, lobes in diagrams]
    top = SHOWN_OVER_MINIMUM * max(lowest or [depth for depth in finite if np.isfinite(depth)] or [1.0])
    top = max(top, 1.5 * (depth_mm or 0.0))
    lines = [
        Line(x=lobes.speed_rpm, y=np.minimum(lobes.limiting_depth_mm, top), label=name) for name, lobes in diagrams
    ]
    speeds = diagrams[0][1].speed_rpm
    if depth_mm is not None:
        lines.append(
            Line(x=speeds[[0, -1]], y=np.array([depth_mm, depth_mm]), label=f"programmed {depth_mm:g} mm", dashed=True)
        )
    for (name, _), speed in zip(diagrams, commanded, strict=False):
        if speed is not None:
            label = f"commanded, {name}: {speed:.0f} 1/min"
            lines.append(Line(x=np.array([speed, speed]), y=np.array([0.0, top]), label=label, dashed=True))
    panel = Panel(lines=lines, x_label="spindle speed [1/min]", y_label="limiting depth of cut [mm]")
    save(path, [panel], title, heights=(1,))


def responses_picture(
    path: Path, responses: Sequence[tuple[str, FloatArray, ComplexArray, ModalFit]], title: str
) -> None:
    """Draw measured receptances and the modes fitted to them, magnitude and phase."""
    magnitude, phase = [], []
    for name, frequency_hz, receptance, fit in responses:
        fitted = modal_receptance(fit.modes, frequency_hz)
        for values, label, dashed in ((receptance, f"{name}, FRF", False), (fitted, f"{name}, modes", True)):
            magnitude.append(Line(x=frequency_hz, y=np.abs(values), label=label, dashed=dashed))
            phase.append(Line(x=frequency_hz, y=np.degrees(np.angle(values)), label=label, dashed=dashed))
    panels = [
        Panel(lines=magnitude, x_label="", y_label="receptance [m/N]", logarithmic=True),
        Panel(lines=phase, x_label="frequency [Hz]", y_label="phase [deg]"),
    ]
    save(path, panels, title, heights=(3, 2))


def spectrogram_picture(
    path: Path,
    frames: Sequence[SpectrumFrame],
    *,
    offset_s: float,
    tooth_passing_hz: float,
    chatter_hz: float | None,
    title: str,
) -> None:
    """Draw short-time spectra over time, with the tooth-passing harmonics and the chatter frequency marked."""
    times = np.array([frame.time_s for frame in frames]) + offset_s
    frequency_hz = frames[0].frequency_hz
    level_db = 10.0 * np.log10(np.array([frame.power_density for frame in frames]).T + 1e-30)
    ceiling = float(level_db.max())
    marks = [(order * tooth_passing_hz, COLOURS[5]) for order in range(1, int(frequency_hz[-1] / tooth_passing_hz) + 1)]
    marks += [(chatter_hz, COLOURS[1])] if chatter_hz is not None else []
    if path.suffix.lower() == ".html":
        _spectrogram_html(path, times, frequency_hz, level_db, ceiling, marks, title)
    else:
        _spectrogram_png(path, times, frequency_hz, level_db, ceiling, marks, title)


def _spectrogram_png(
    path: Path,
    times: FloatArray,
    frequency_hz: FloatArray,
    level_db: FloatArray,
    ceiling: float,
    marks: Sequence[tuple[float, str]],
    title: str,
) -> None:
    figure = import_module("matplotlib.figure").Figure(
        figsize=(PIXELS[0] / DPI, PIXELS[1] / DPI), dpi=DPI, layout="constrained"
    )
    axis = figure.subplots()
    half = 0.5 * (times[1] - times[0]) if len(times) > 1 else 0.5
    extent = (times[0] - half, times[-1] + half, frequency_hz[0], frequency_hz[-1])
    image = axis.imshow(
        level_db, origin="lower", aspect="auto", extent=extent, vmin=ceiling - COLOUR_RANGE_DB, vmax=ceiling
    )
    for frequency, colour in marks:
        axis.axhline(frequency, color=colour, linewidth=0.8, linestyle=":")
    figure.colorbar(image, label="power density [dB re 1 (m/s²)²/Hz]")
    axis.set(xlabel="time [s]", ylabel="frequency [Hz]", title=title)
    figure.savefig(path)


def _spectrogram_html(
    path: Path,
    times: FloatArray,
    frequency_hz: FloatArray,
    level_db: FloatArray,
    ceiling: float,
    marks: Sequence[tuple[float, str]],
    title: str,
) -> None:
    figure = import_module("plotly.graph_objects").Figure()
    figure.add_heatmap(
        x=np.round(times, 4).tolist(),
        y=np.round(frequency_hz, 3).tolist(),
        z=np.round(level_db, 1).tolist(),
        zmin=ceiling - COLOUR_RANGE_DB,
        zmax=ceiling,
        colorscale="Viridis",
        colorbar={"title": "dB re 1 (m/s²)²/Hz"},
    )
    for frequency, colour in marks:
        figure.add_hline(y=frequency, line={"color": colour, "width": 1, "dash": "dot"})
    figure.update_layout(
        title=title, height=PIXELS[1], template="plotly_white", xaxis_title="time [s]", yaxis_title="frequency [Hz]"
    )
    path.write_text(figure.to_html(include_plotlyjs=True, full_html=True), encoding="utf-8")
