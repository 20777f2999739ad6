"""Where on the simulated machine each listed temperature sensor sits.

A part is a path over nodes; the sensors of one part are spread along it in the order of their list,
so that neighbours read neighbouring temperatures. Labelled sensors have their own place.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.heat import INDEX
from drivers.sim.machine.parameters import NODES
from models.records import FloatArray

Path = tuple[str, ...]

LABELS: dict[str, dict[str, float]] = {
    "A": {"housing_rear": 0.9, "housing_front": 0.1},
    "B": {"housing_front": 0.85, "housing_rear": 0.15},
    "C": {"cast_rear_top": 0.45, "cast_rear_bottom": 0.45, "housing_rear": 0.1},
    "D": {"cast_middle_top": 0.5, "cast_middle_bottom": 0.5},
    "E": {"cast_front_top": 0.45, "cast_front_bottom": 0.45, "housing_front": 0.1},
    "F": {"front_cover": 0.9, "cast_front_top": 0.1},
    "IR": {"nose": 1.0},
}
"""Shares of the nodes that a labelled sensor reads; Room follows from its part."""

_CAST: Path = (
    "cast_rear_bottom",
    "cast_middle_bottom",
    "cast_front_bottom",
    "cast_front_top",
    "cast_middle_top",
    "cast_rear_top",
)

PARTS: dict[tuple[str, str], Path] = {
    ("Ambient", ""): ("air_low", "air_high"),
    ("Spindle unit", "Ram with Z-axis linear guide rail"): ("ram_bottom", "ram_top"),
    ("Spindle unit", "Cast metal"): _CAST,
    ("Spindle unit", "Housing"): ("housing_rear", "housing_front"),
    ("Spindle unit", "Front cover of the spindle"): ("front_cover", "cast_front_bottom"),
    ("Spindle unit", "Spindle nose"): ("nose",),
    ("Spindle unit", ""): _CAST,
    ("X-axis slider", "Z-axis motor coupling cover"): ("z_coupling",),
    ("X-axis slider", "Z-axis motor"): ("z_motor", "z_coupling"),
    ("X-axis slider", "Right side"): ("slider_right", "slider_bottom"),
    ("X-axis slider", "Left side"): ("slider_left", "slider_bottom"),
    ("X-axis slider", "X-axis linear guide"): ("saddle_left", "slider_left", "slider_right", "saddle_right"),
    ("X-axis slider", "Z-axis linear guide"): ("slider_left", "ram_bottom", "slider_right"),
    ("X-axis slider", "X-axis ball-screw nut"): ("x_screw", "slider_bottom"),
    ("X-axis slider", ""): ("slider_bottom", "slider_left", "slider_right"),
    ("Saddle", "Back"): ("saddle_back", "saddle_right"),
    ("Saddle", "Left side"): ("saddle_left", "saddle_back"),
    ("Saddle", "Right side"): ("saddle_right", "saddle_back"),
    ("Saddle", "X-axis linear guide rail"): ("saddle_left", "saddle_front", "saddle_right"),
    ("Saddle", "X-axis motor coupling cover"): ("x_coupling",),
    ("Saddle", "X-axis motor"): ("x_motor", "x_coupling"),
    ("Saddle", "Front"): ("saddle_front", "saddle_left"),
    ("Saddle", "Counter side X-axis ball-screw stand"): ("x_screw", "saddle_right"),
    ("Saddle", "Bottom inside"): ("saddle_front", "saddle_back"),
    ("Saddle", "Y-axis linear guide"): ("saddle_back", "column_front"),
    ("Saddle", "Y-axis ball-screw nut"): ("y_screw", "saddle_back"),
    ("Saddle", ""): ("saddle_back",),
    ("Bed", "Front"): ("bed_front",),
    ("Bed", "Left side"): ("bed_left", "bed_front"),
    ("Bed", "Right side"): ("bed_right", "bed_front"),
    ("Bed", ""): ("bed_front", "bed_left", "bed_right"),
    ("Trunnion table", "A-axis motor"): ("a_motor",),
    ("Trunnion table", "Counter side A-axis motor"): ("a_counter",),
    ("Trunnion table", ""): ("a_motor", "a_counter"),
    ("Column", "Left"): ("column_left", "column_front"),
    ("Column", "Right"): ("column_right", "column_front"),
    ("Column", "Front"): ("column_front", "column_left", "column_right"),
    ("Column", "Top"): ("column_top", "column_left"),
    ("Column", "Y-axis linear guide"): ("column_left", "column_front", "column_right"),
    ("Column", "Y-axis motor coupling cover"): ("y_coupling", "column_top"),
    ("Column", "Y-axis motor"): ("y_motor", "y_coupling"),
    ("Column", "Counter side Y-axis ball-screw stand"): ("y_screw", "column_front"),
    ("Column", ""): ("column_front",),
    ("Cooling circuit of chiller", "Joint for oil coming"): ("chiller_return",),
    ("Cooling circuit of chiller", ""): ("oil",),
}
"""Path of nodes by component and beginning of the part's name; the longest match counts."""

COMPONENTS = frozenset(component for component, _ in PARTS)

_MIXTURES: dict[str, dict[str, float]] = {
    "chiller_return": {"oil": 0.7, "stator": 0.2, "housing_rear": 0.1},
}
"""Places that are no node: the oil on its way back has taken up the stator's heat."""


def sensor_shares(sensors: Sequence[SensorConfig]) -> FloatArray:
    """Return the share of each node in what each sensor touches, shape (sensors, nodes), rows sum to 1."""
    by_path: dict[Path, list[int]] = defaultdict(list)
    shares = np.zeros((len(sensors), len(NODES)))
    for row, sensor in enumerate(sensors):
        if sensor.label in LABELS:
            for name, share in LABELS[sensor.label].items():
                shares[row, INDEX[name]] = share
        else:
            by_path[_path(sensor)].append(row)
    for path, rows in by_path.items():
        for row, position in zip(rows, np.linspace(0.0, len(path) - 1.0, len(rows) + 2)[1:-1], strict=True):
            shares[row] = _point(path, float(position))
    return shares


def _path(sensor: SensorConfig) -> Path:
    matches = [key for key in PARTS if key[0] == sensor.component and sensor.part.startswith(key[1])]
    if not matches:
        known = sorted({component for component, _ in PARTS})
        raise ValueError(
            f"sensor {sensor.id}: the simulated machine has no component {sensor.component!r}; it has {known}"
        )
    return PARTS[max(matches, key=lambda key: len(key[1]))]


def _point(path: Path, position: float) -> FloatArray:
    """Return node shares at `position` (0: first node, 1: second ..) along a path."""
    row = np.zeros(len(NODES))
    first = min(int(position), len(path) - 1)
    second = min(first + 1, len(path) - 1)
    for name, share in ((path[first], 1.0 - (position - first)), (path[second], position - first)):
        for node, part in _MIXTURES.get(name, {name: 1.0}).items():
            row[INDEX[node]] += part * share
    return row
