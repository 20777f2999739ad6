"""The tool point over a recording: bearing properties, responses and the followed resonance (Figs 5-18, 5-19, 5-26)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from config.files import write_whole
from config.html_page import Section
from config.machine.spindle_chain import Spindle
from daemon.workbench.dynamics.campaign import Temperatures
from daemon.workbench.figures import COLOURS, Axes, Curve, Figure, report_page
from models.errors import RefusedInputError
from models.records import FloatArray
from models.thermomechanics.regression import ThermomechanicalModel
from models.thermomechanics.tool_point import ToolPointDynamics, ToolPointTracker

SHOWN_RESPONSES = 5


class TrackingError(RefusedInputError, ValueError):
    """A recording cannot be followed; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedDay:
    """What was found over a recording."""

    time_min: FloatArray
    """Shape (n,)."""
    dynamics: tuple[ToolPointDynamics, ...]
    warnings: tuple[str, ...]


def warnings_of(model: ThermomechanicalModel, spindles: Mapping[str, Spindle]) -> list[str]:
    """Return a sentence for each axis whose spindle is not computed as the bearings of the model were identified."""
    found = [warning for spindle in spindles.values() for warning in spindle.warnings]
    found += [
        f"axis {axis}: the model {model.model_id} was identified with rigid_rotary_inertia "
        f"{model.rigid_rotary_inertia}, but the spindle is computed with {spindle.rotary}; resonances are shifted"
        for axis, spindle in spindles.items()
        if spindle.rotary != model.rigid_rotary_inertia
    ]
    found += [
        f"axis {axis}: the bearings of {model.model_id} were identified with another shaft; resonances are shifted"
        for axis, spindle in spindles.items()
        if model.shaft_sha256 and model.shaft_sha256 != spindle.description.shaft_sha256()
    ]
    return list(dict.fromkeys(found))


def track_recording(
    temperatures: Temperatures,
    model: ThermomechanicalModel,
    spindles: Mapping[str, Spindle],
    at: str,
    near_hz: float | None,
    every_min: float,
    progress: Callable[[str, int, int], None],
) -> TrackedDay:
    """Follow the resonances of axis -> spindle through a recording; raises TrackingError.

    `at`: nose, holder or tool. `near_hz`: the resonance nearest to this is followed; None: the highest. `progress`:
    what is done, how much of it, and of how much.
    """
    labels = {name: (index,) for index, name in enumerate(temperatures.signals)}
    assemblies = {axis: spindle.assembly(at) for axis, spindle in spindles.items()}
    near = {} if near_hz is None else dict.fromkeys(assemblies, near_hz)
    try:
        tracker = ToolPointTracker(model, assemblies, labels, near_hz=near)
    except ValueError as error:
        raise TrackingError(
            f"{temperatures.name}: {error}; the recording has {', '.join(labels)}. Where these are numbers of sensors, "
            "--config names the configuration that gives them labels"
        ) from error
    columns = [temperatures.signals.index(name) for name in model.signals]
    times: list[float] = []
    found: list[ToolPointDynamics] = []
    due_min = float(temperatures.time_min[0])
    for index, (minute, row) in enumerate(zip(temperatures.time_min.tolist(), temperatures.degc, strict=True)):
        if minute < due_min:
            tracker.observe(60.0 * minute, row[columns])
            continue
        due_min += every_min * (1.0 + (minute - due_min) // every_min)
        dynamics = tracker.renew_from(60.0 * minute, row[columns])
        progress("tool point", index, len(temperatures.time_min))
        if dynamics is not None:
            times.append(minute)
            found.append(dynamics)
    if not found:
        raise TrackingError(f"{temperatures.name}: at no time have all of {', '.join(model.signals)} a temperature")
    return TrackedDay(time_min=np.array(times), dynamics=tuple(found), warnings=tuple(warnings_of(model, spindles)))


def tracking_summary(day: TrackedDay) -> dict[str, Any]:
    """Return what `toolpoint dynamics track` prints."""
    inhibits = [each.inhibit for each in day.dynamics]
    return {
        "model_id": day.dynamics[0].model_id,
        "warnings": list(day.warnings),
        "time_min": day.time_min.tolist(),
        "inhibit": inhibits,
        "doubt": inhibits,  # its name in 0.1.0
        "axes": {axis: _axis_summary(day, axis) for axis in day.dynamics[0].axes},
    }


def _axis_summary(day: TrackedDay, axis: str) -> dict[str, Any]:
    told = [each.axes[axis] for each in day.dynamics]
    names = [each.name for each in told[0].properties]
    return {
        "resonance_hz": [each.resonance_hz for each in told],
        "magnitude_m_per_n": [each.resonance.magnitude_m_per_n for each in told],
        "continuous": [each.resonance.continuous for each in told],
        "confidence": [each.confidence for each in told],
        "properties": {
            name: {
                "raw": [each.properties[k].raw for each in told],
                "value": [each.properties[k].value for each in told],
                "flagged": [each.properties[k].flagged for each in told],
            }
            for k, name in enumerate(names)
        },
    }


def write_tracking_page(path: Path, day: TrackedDay) -> None:
    """Write resonances, responses and bearing properties over time as one page."""
    curves: list[Curve] = []
    figures: list[Figure] = []
    for number, axis in enumerate(day.dynamics[0].axes):
        hz = np.array([each.resonance_hz[axis] for each in day.dynamics])
        curves.append(Curve(x=day.time_min, y=hz, label=axis, colour=COLOURS[number]))
        unusable = [
            k for k, each in enumerate(day.dynamics) if each.inhibit or not each.axes[axis].resonance.continuous
        ]
        curves.append(_crosses(day.time_min[unusable], hz[unusable], COLOURS[number], f"{axis}, not followed"))
        figures += [_responses(day, axis), _properties(day, axis)]
    resonances = Axes(x_label="time [min]", y_label="frequency [Hz]", curves=curves)
    figures.insert(0, Figure(title="Followed resonance at the tool point (Fig. 5-19)", axes=[resonances]))
    warnings = [Section(text=warning) for warning in day.warnings]
    title = f"Tool point over time, model {day.dynamics[0].model_id}"
    write_whole(path, report_page(title, warnings, figures))


def _crosses(x: FloatArray, y: FloatArray, colour: str, label: str = "") -> Curve:
    return Curve(x=x, y=y, label=label, colour=colour, style="none", marker="x")


def _responses(day: TrackedDay, axis: str) -> Figure:
    curves = []
    for k in np.unique(np.linspace(0, len(day.dynamics) - 1, SHOWN_RESPONSES).astype(int)).tolist():
        size = np.abs(day.dynamics[k].axes[axis].receptance_m_per_n)
        curves.append(Curve(x=day.dynamics[k].frequency_hz, y=size, label=f"{day.time_min[k]:.0f} min"))
    axes = Axes(x_label="frequency [Hz]", y_label="receptance [m/N]", logarithmic=True, curves=curves)
    return Figure(title=f"Receptance at the tool point, {axis} (Fig. 5-18)", axes=[axes])


def _properties(day: TrackedDay, axis: str) -> Figure:
    told = [each.axes[axis].properties for each in day.dynamics]
    curves = []
    for k, first in enumerate(told[0]):
        colour, scale = COLOURS[k % len(COLOURS)], abs(first.value) or abs(first.raw) or 1.0
        ratio = np.array([each[k].value / scale for each in told])
        flagged = [place for place, each in enumerate(told) if each[k].flagged]
        curves.append(Curve(x=day.time_min, y=ratio, label=first.name, colour=colour))
        curves.append(_crosses(day.time_min[flagged], ratio[flagged], colour))
    title = f"Bearing properties, {axis}, beside their first value (Fig. 5-26); crosses: flagged"
    return Figure(title=title, axes=[Axes(x_label="time [min]", y_label="ratio", curves=curves)])
