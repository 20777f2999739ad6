"""Pictures of lobes, responses and spectrograms."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daemon.workbench.dynamics.pictures import response_figure
from daemon.workbench.figures import COLOURS, Axes, Curve, Figure, Heat, save
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
    curves = [
        Curve(x=lobes.speed_rpm, y=np.minimum(lobes.limiting_depth_mm, top), label=name) for name, lobes in diagrams
    ]
    speeds = diagrams[0][1].speed_rpm
    if depth_mm is not None:
        level = np.array([depth_mm, depth_mm])
        curves.append(Curve(x=speeds[[0, -1]], y=level, label=f"programmed {depth_mm:g} mm", style="dashed"))
    for (name, _), speed in zip(diagrams, commanded, strict=False):
        if speed is not None:
            label = f"commanded, {name}: {speed:.0f} 1/min"
            curves.append(Curve(x=np.array([speed, speed]), y=np.array([0.0, top]), label=label, style="dashed"))
    axes = Axes(x_label="spindle speed [1/min]", y_label="limiting depth of cut [mm]", curves=curves)
    save(path, Figure(title=title, axes=[axes], heights=(620,)))


def responses_picture(
    path: Path, responses: Sequence[tuple[str, FloatArray, ComplexArray, ModalFit]], title: str
) -> None:
    """Draw measured receptances and the modes fitted to them, magnitude and phase."""
    curves = []
    for name, frequency_hz, receptance, fit in responses:
        curves.append((frequency_hz, receptance, f"{name}, FRF", False))
        curves.append((frequency_hz, modal_receptance(fit.modes, frequency_hz), f"{name}, modes", True))
    save(path, response_figure(title, curves))


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
    curves = [
        Curve(x=times[[0, -1]], y=np.array([hz, hz]), colour=colour, style="dotted", width=1.0) for hz, colour in marks
    ]
    heat = Heat(
        x=times, y=frequency_hz, values=level_db, lowest=ceiling - COLOUR_RANGE_DB, highest=ceiling,
        unit="power density [dB re 1 (m/s²)²/Hz]", colours="viridis",
    )  # fmt: skip
    axes = Axes(x_label="time [s]", y_label="frequency [Hz]", heat=heat, curves=curves)
    save(path, Figure(title=title, axes=[axes], heights=(620,)))
