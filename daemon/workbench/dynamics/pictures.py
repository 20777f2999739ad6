"""Pictures of modes, responses, identifications and studies: PNG by matplotlib, HTML by plotly.

Both libraries are imported when something is drawn, never by the daemon. An HTML file holds all that it needs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from config.machine.spindle_chain import Spindle
from daemon.workbench.dynamics.responses import response
from daemon.workbench.figures import Box, Line, Panel, _boxes, save
from models.dynamics.bearings import PARAMETERS, CondensedShaft, properties_from_parameters
from models.dynamics.measurement import Measurement
from models.records import FloatArray


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


def _response_panels(curves: Sequence[tuple[FloatArray, Any, str, bool]]) -> list[Panel]:
    magnitude = [Line(x=x, y=np.abs(values), label=label, dashed=dashed) for x, values, label, dashed in curves]
    phase = [
        Line(x=x, y=np.degrees(np.angle(values)), label=label, dashed=dashed) for x, values, label, dashed in curves
    ]
    return [
        Panel(lines=magnitude, x_label="", y_label="receptance [m/N]", logarithmic=True),
        Panel(lines=phase, x_label="frequency [Hz]", y_label="phase [deg]"),
    ]
