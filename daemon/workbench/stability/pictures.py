"""Pictures of lobes, responses, spectrograms and surface profiles."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daemon.workbench.dynamics.pictures import response_figure
from daemon.workbench.figures import INK, Axes, Curve, Figure, Heat, save
from models.records import FloatArray
from models.stability.frf_modal_fit import ModalFit
from models.stability.lobes import StabilityLobes
from models.stability.response import ComplexArray, modal_receptance
from models.stability.spectra import SpectrumFrame

SHOWN_OVER_MINIMUM = 8.0
"""Lobes are drawn up to this multiple of their lowest depth, unless a deeper one is asked for."""
COLOUR_RANGE_DB = 60.0
CHATTER_COLOUR = "#ff5a36"
"""Seen on every colour of the map."""


def lobes_picture(
    path: Path,
    diagrams: Sequence[tuple[str, StabilityLobes]],
    *,
    commanded: Sequence[float | None] = (),
    depth_mm: float | None = None,
) -> None:
    """Draw the lobes of one or more states, filled where a cut is stable, and the working point of each state."""
    lowest = [lobes.minimum.depth_mm for _, lobes in diagrams if lobes.minimum]
    finite = [float(np.min(lobes.limiting_depth_mm)) for _, lobes in diagrams]
    top = SHOWN_OVER_MINIMUM * max(lowest or [depth for depth in finite if np.isfinite(depth)] or [1.0])
    top = max(top, 1.5 * (depth_mm or 0.0))
    curves = [
        Curve(x=lobes.speed_rpm, y=np.minimum(lobes.limiting_depth_mm, top), label=f"{name}: stable below", filled=True)
        for name, lobes in diagrams
    ]
    speeds = diagrams[0][1].speed_rpm
    if depth_mm is not None:
        level = np.array([depth_mm, depth_mm])
        curves.append(Curve(x=speeds[[0, -1]], y=level, label=f"programmed {depth_mm:g} mm", style="dashed"))
    for (name, _), speed in zip(diagrams, commanded, strict=False):
        if speed is not None:
            label = f"commanded, {name}: {speed:.0f} 1/min"
            curves.append(Curve(x=np.array([speed, speed]), y=np.array([0.0, top]), label=label, style="dashed"))
            if depth_mm is not None:
                label = f"working point, {name}: {speed:.0f} 1/min, {depth_mm:g} mm"
                point = np.array([speed]), np.array([depth_mm])
                curves.append(Curve(x=point[0], y=point[1], label=label, style="none", marker="o", colour=INK))
    axes = Axes(
        x_label="spindle speed [1/min]", y_label="limiting depth of cut [mm]", curves=curves, y_range=(0.0, 1.02 * top)
    )
    save(path, Figure(title="Stability lobes", axes=[axes], heights=(620,)))


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
    across, orders = times[[0, -1]], range(1, int(frequency_hz[-1] / tooth_passing_hz) + 1)
    curves = [
        Curve(
            x=across, y=np.full(2, order * tooth_passing_hz), colour="#7fd4ff", style="dotted", width=0.8,
            label=f"teeth pass at {tooth_passing_hz:.1f} Hz, and its multiples" if order == 1 else "",
        )
        for order in orders
    ]  # fmt: skip
    if chatter_hz is not None:
        label = f"chatter at {chatter_hz:.1f} Hz"
        curves.append(
            Curve(x=across, y=np.full(2, chatter_hz), colour=CHATTER_COLOUR, style="dashed", width=2.0, label=label)
        )
    heat = Heat(
        x=times, y=frequency_hz, values=level_db, lowest=ceiling - COLOUR_RANGE_DB, highest=ceiling,
        unit="power density [dB re 1 (m/s²)²/Hz]",
    )  # fmt: skip
    axes = Axes(x_label="time [s]", y_label="frequency [Hz]", heat=heat, curves=curves)
    save(path, Figure(title=title, axes=[axes], heights=(620,)))


def profile_picture(path: Path, profiles: Sequence[tuple[str, FloatArray]], *, title: str) -> None:
    """Draw surface profiles, one for each depth: position [mm] and height [um], shape (n, 2) (Fig. 5-22)."""
    curves = [Curve(x=points[:, 0], y=points[:, 1], label=name) for name, points in profiles]
    axes = Axes(x_label="position [mm]", y_label="height [µm]", curves=curves)
    save(path, Figure(title=title, axes=[axes]))
