"""Pictures of modes, responses, identifications and studies."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from config.machine.spindle import SegmentDescription
from config.machine.spindle_chain import Spindle
from daemon.workbench.dynamics.responses import response
from daemon.workbench.figures import Axes, Box, Curve, Figure, save
from models.dynamics.beam import ComplexArray
from models.dynamics.bearings import CondensedShaft, properties_from_parameters
from models.dynamics.measurement import Measurement
from models.records import FloatArray

PHASE_TICKS = [(float(degrees), f"{degrees}") for degrees in (-180, -90, 0, 90, 180)]


def modes_picture(path: Path, spindle: Spindle, found: dict[str, Any]) -> None:
    """Draw mode shapes over the drawn spindle (Figs. 4-10, 5-15)."""
    curves = [
        Curve(
            x=np.array(mode["points_mm"]),
            y=np.array(mode["shape"]),
            label=f"mode {number}: {mode['frequency_hz']:.1f} Hz",
        )
        for number, mode in enumerate(found["modes"], start=1)
    ]
    axes = [Axes(y_label="displacement (largest = 1)", curves=curves), _drawn_spindle(spindle)]
    save(path, Figure(title=found["name"] or "modes", axes=axes, heights=(380, 250), shared_x=True))


def response_picture(path: Path, found: dict[str, Any]) -> None:
    """Draw a receptance as magnitude and phase (Figs. 4-12, 5-14)."""
    values = np.array(found["receptance_re"]) + 1j * np.array(found["receptance_im"])
    label = f"{found['at']}, rotary inertia {found['rigid_rotary_inertia']}"
    curves = [(np.array(found["frequency_hz"]), values, label, False)]
    save(path, response_figure(found["name"] or "frequency response", curves))


def identified_picture(path: Path, spindle: Spindle, measurement: Measurement, found: dict[str, Any]) -> None:
    """Draw a measurement and the response of the identified model."""
    shaft = CondensedShaft(spindle.shaft, measurement.frequency_hz)
    model = shaft.nose_receptance(properties_from_parameters({**found["values"], **found["fixed"]}))
    curves = [
        (measurement.frequency_hz, measurement.receptance_m_per_n, "measured", False),
        (measurement.frequency_hz, model, f"model, {len(found['values'])} parameters identified", True),
    ]
    save(path, response_figure(found["name"] or "identification", curves))


def comparison_picture(path: Path, spindles: Sequence[tuple[str, Spindle]], at: str, frequency_hz: FloatArray) -> None:
    """Draw the responses of several layouts (Fig. 4-14)."""
    curves = [
        (frequency_hz, response(spindle, at, frequency_hz), spindle.description.name or Path(file).stem, False)
        for file, spindle in spindles
    ]
    save(path, response_figure(f"comparison at the {at}", curves))


def sensitivity_picture(path: Path, found: dict[str, Any]) -> None:
    """Draw the change of each mode over the variations (Table 4-4)."""
    count = len(found["baseline"])
    names = [f"{each['moduli']} {each['percent']:+g} %" for each in found["variations"]]
    places = np.arange(len(names), dtype=np.float64)
    curves = [
        Curve(
            x=places,
            y=np.array([each["modes"][k]["change_percent"] for each in found["variations"]]),
            label=f"mode {k + 1}: {found['baseline'][k]['frequency_hz']:.1f} Hz",
        )
        for k in range(count)
    ]
    ticks = list(zip(places.tolist(), names, strict=True))
    axes = Axes(x_label="moduli of the composites", y_label="change of the frequency [%]", curves=curves, x_ticks=ticks)
    save(path, Figure(title=found["name"] or "sensitivity", axes=[axes], heights=(620,)))


def _drawn_spindle(spindle: Spindle) -> Axes:
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
    marks = [(bearing.position_mm, f"bearings {bearing.group}") for bearing in told.bearings or ()]
    return Axes(x_label="distance from the nose [mm]", y_label="radius [mm]", boxes=boxes, marks=marks)


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


def phase_deg(values: ComplexArray) -> FloatArray:
    """Return phases [deg] in -180 to 180; NaN where the line would cross from one end to the other."""
    phase: FloatArray = np.degrees(np.angle(values))
    phase[1:][np.abs(np.diff(phase)) > 180.0] = np.nan
    return phase


def response_figure(title: str, responses: Sequence[tuple[FloatArray, ComplexArray, str, bool]]) -> Figure:
    """Return magnitude and phase of receptances: frequencies [Hz], values [m/N], label, whether dashed."""
    magnitude, phase = [], []
    for frequency_hz, values, label, dashed in responses:
        style = "dashed" if dashed else "solid"
        magnitude.append(Curve(x=frequency_hz, y=np.abs(values), label=label, style=style))
        phase.append(Curve(x=frequency_hz, y=phase_deg(values), label=label, style=style))
    axes = [
        Axes(y_label="receptance [m/N]", logarithmic=True, curves=magnitude),
        Axes(x_label="frequency [Hz]", y_label="phase [deg]", curves=phase, y_ticks=PHASE_TICKS),
    ]
    return Figure(title=title, axes=axes, heights=(380, 250), shared_x=True)
