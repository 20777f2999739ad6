"""The published regressions of bearing properties on temperatures, and the physical bounds, as data."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from config.loader import load_yaml_model
from config.machine.spindle import Origin
from config.schema.base import Problems, Section, checked
from models.dynamics.bearings import GROUPS, KINDS, parameters_of
from models.dynamics.identification import FIXED
from models.model_file import ModelError
from models.thermomechanics.regression import AxisRegression, Bounds, PropertyRegression, ThermomechanicalModel

SIGNALS = ("IR", "A", "F", "Room")
"""Labels of the sensors of Tables D-1 and D-2: T_IR, T_A, T_F, T_Room."""
TABLES = {"x": "table_d1_x.csv", "y": "table_d2_y.csv"}
PUBLISHED_INTERVAL_MIN = 10.0
PUBLISHED_INTERVALS_MIN = {("x", "kt_34"): 4.0, ("x", "kt_5"): 4.0}
"""Those that differ (section 5.3.2)."""


class BoundDescription(Section):
    """Physical range of one kind of property, or of one property."""

    lowest: float = Field(ge=0, description="lower end, in SI units")
    highest: float = Field(gt=0, description="upper end, in SI units")
    origin: Origin = Field(description="where the numbers come from")
    note: str = Field(min_length=1, description="why these")


class BoundsFile(Section):
    """Physical ranges by kind or by name."""

    bounds: dict[str, BoundDescription] = Field(description="kt, ct, kr, cr, or a name such as kt_34")

    @checked
    def _consistent(self) -> Problems:
        for name, each in self.bounds.items():
            if name.partition("_")[0] not in KINDS or name.endswith("_"):
                sentence = f"is no bearing property; write {', '.join(KINDS)}, or one of them, _ and a group"
                yield ("bounds", name), sentence
            if each.highest <= each.lowest:
                yield ("bounds", name, "highest"), f"must lie above lowest {each.lowest:g}"
        yield from ((("bounds",), f"{kind} is missing") for kind in KINDS if kind not in self.bounds)


def data_folder() -> Path:
    """Return the folder of the shipped tables and bounds."""
    return Path(__file__).parent / "data"


def load_bounds(path: Path | None = None, groups: Sequence[str] = GROUPS) -> dict[str, Bounds]:
    """Return the physical range of each property of these groups; None: as shipped. Raises ConfigurationError."""
    told = load_yaml_model(path or data_folder() / "bounds.yaml", BoundsFile).bounds
    ranges = {name: told.get(name, told[name.partition("_")[0]]) for name in parameters_of(groups)}
    return {name: Bounds(lowest=each.lowest, highest=each.highest) for name, each in ranges.items()}


def published_model(bounds: dict[str, Bounds] | None = None) -> ThermomechanicalModel:
    """Return Tables D-1 and D-2 with bounds; None: as shipped."""
    ranges = bounds or load_bounds()
    return ThermomechanicalModel(
        model_id="tables-d1-d2",
        source="Tables D-1 and D-2: identified at the nose of the published spindle in three warm-up and idle runs",
        created="2021",
        rigid_rotary_inertia="published",
        spindle_sha256="",
        axes={axis: _published_axis(axis, ranges) for axis in TABLES},
    )


def _published_axis(axis: str, ranges: dict[str, Bounds]) -> AxisRegression:
    path = data_folder() / TABLES[axis]
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    if len(rows) < 2 or any(len(row) != len(rows[0]) for row in rows):
        raise ModelError("", "rows of different length", str(path))
    properties = tuple(
        PropertyRegression(
            name=name,
            interval_min=PUBLISHED_INTERVALS_MIN.get((axis, name), PUBLISHED_INTERVAL_MIN),
            coefficients=np.array([float(number) for number in numbers]),
            bounds=ranges[name],
        )
        for name, *numbers in rows[1:]
    )
    return AxisRegression(axis=axis, signals=SIGNALS, properties=properties, fixed=FIXED[5])
