"""A control whose Z axis takes an offset and a slope: configuration, macro map, and the guard on its control."""

import json
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from control_rig import LINES, SENSOR_IDS

from config.records.commissioning import CommissionedAxis, CommissionedSlope
from config.schema import Configuration
from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig, CompensationConfig
from config.schema.guard import GuardConfig
from drivers.guard.check import block_check
from drivers.guard.text import GuardStatus
from drivers.sim.nc.custom_macro import MacroControl
from drivers.sim.nc.nc import MacroTable
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.nc.sinumerik import SinumerikControl

PIVOT_MM, TRAVEL_MM = 250.0, (0.0, 500.0)
Z: dict[str, Any] = {"estimate": "Z1", "absolute_bound_um": 50.0, "slew_um_per_min": 100.0, "step_um": 10.0}
SLOPE: dict[str, Any] = {
    "estimate": "Z1_per_m",
    "absolute_bound_um": 120.0,
    "slew_um_per_min": 80.0,
    "step_um": 20.0,
    "slope": {"of": "z", "pivot_mm": PIVOT_MM, "travel_mm": TRAVEL_MM},
}
MAP: dict[str, Any] = {
    "writable": ["120", "500-507"],
    "sequence_a": 500,
    "values": {"z": 502, "z_slope": 503},
    "valid_until": 120,
    "enable": 504,
    "check": 506,
    "sequence_b": 505,
    "echo_applied": {"z": 512, "z_slope": 513},
    "echo_time": 514,
    "echo_status": 515,
    "echo_guard_version": 516,
}
GUARD = GuardConfig(dialect="sinumerik", increment_mm=0.001)
FARTHEST_M = 0.25


def content(directory: Path) -> dict[str, Any]:
    """Return a configuration as a file would hold it, to be changed by a test."""
    return {
        "machine": "sloped",
        "temperatures": {
            "lines": [{"name": n, "port": str(directory / n), "chain": chain} for n, chain in LINES.items()],
            "sensors": [{"id": i, "device": "TMP102", "component": "head", "label": "A"} for i in SENSOR_IDS],
        },
        "cnc": {
            "opcua": {"endpoint": "opc.tcp://127.0.0.1:1/none", "preset": "sinumerik"},
            "allow_insecure_writes": True,
            "macros": deepcopy(MAP),
            "guard": GUARD.model_dump(),
        },
        "compensation": {
            "axes": {"z": dict(Z), "z_slope": SLOPE | {"slope": dict(SLOPE["slope"])}},
            "reference": {"sequence_numbers": [100], "positioning_dwell_s": 2.0},
            "output": {"safe_sequence_numbers": [900]},
        },
        "history": {"path": str(directory / "history.sqlite")},
        "service": {"socket": str(directory / "s"), "http_port": None},
    }


def sloped(directory: Path) -> Configuration:
    """Return the configuration."""
    return configured(content(directory))


def configured(content: dict[str, Any]) -> Configuration:
    """Return what a file with this content says."""
    return Configuration.model_validate_json(json.dumps(content))


def proved(**slope: Any) -> dict[str, CommissionedAxis]:
    """Return the proof of the offset, and of the slope as it was seen."""
    axis = CommissionedAxis(sign=1, scale=1.0, written_um=5.0, measured_um=5.0)
    seen = CommissionedSlope(**({"of": "z", "pivot_mm": PIVOT_MM, "positions_mm": TRAVEL_MM} | slope))
    return {"z": axis, "z_slope": axis.model_copy(update={"slope": seen})}


class SlopedGuard:
    """The guard's text on its control, at a time; nothing is applied, the operator has an offset and a slope."""

    macros_used: Mapping[str, Any] = MAP

    def __init__(self, *, own_um: float = 0.0, own_um_per_m: float = 0.0, **guard: Any) -> None:
        self.map = MacroMapConfig.model_validate(self.macros_used)
        axes = {name: AxisConfig.model_validate(axis) for name, axis in (("z", Z), ("z_slope", SLOPE))}
        compensation = CompensationConfig(axes=axes)
        self.axes, self.pivots_mm = compensation.outputs, compensation.pivots_mm
        self.macros = MacroTable()
        self.nc = SafePointApplication(self.map, self.axes, GUARD.model_copy(update=guard))
        self.nc.change_own_offset("z", own_um)
        if isinstance(self.nc.control, SinumerikControl):
            self.nc.change_own_offset("z_slope", own_um_per_m)
        self.nc.initialise(self.macros, 1000.0)
        if isinstance(self.nc.control, SinumerikControl):
            self.nc.control.start_timer(1, 1000.0)
        self.sequence = 0.0

    def write(self, z_um: float = 0.0, z_um_per_m: float = 0.0, *, enable: float = 3.0, valid_s: float = 30.0) -> None:
        """Write a whole block, with its check."""
        self.sequence += 1.0
        held: dict[int, float | None] = {
            500: self.sequence,
            502: z_um / 1000.0,
            503: z_um_per_m / 1000.0,
            120: 1000.0 + valid_s,
            504: enable,
            505: self.sequence,
        }
        held[506] = block_check(self.map, self.axes, held, self.pivots_mm)
        for number, value in held.items():
            self.macros.set(number, value)

    def call(self) -> GuardStatus:
        """Call the guard at a safe point."""
        return self.nc.run(self.macros, 1000.0)

    def echo_um(self) -> tuple[float, float]:
        """Return what the echo says of offset [um] and slope [um/m]."""
        z, slope = (self.macros.get(number) for number in (512, 513))
        return (z or 0.0) * 1000.0, (slope or 0.0) * 1000.0

    def moved_um(self, position_mm: float) -> float:
        """Return by how much the axis is moved where it stands [um]."""
        assert isinstance(self.nc.control, SinumerikControl)
        return float(self.nc.control.moved_mm("Z", position_mm)) * 1000.0


class PlacedGuard(SlopedGuard):
    """The same on a FANUC, which has offsets alone: the guard puts the slope in for where the axis stands."""

    def __init__(self, *, own_um: float = 0.0, **guard: Any) -> None:
        super().__init__(own_um=own_um, **{"dialect": "fanuc", "increment_mm": 0.0001} | guard)

    def stand(self, position_mm: float | None) -> None:
        """Bring the axis there (machine position); None: the control does not know where it stands."""
        assert isinstance(self.nc.control, MacroControl)
        self.nc.control.positions_mm[2] = position_mm

    def offset_um(self) -> float:
        """Return the external offset, which moves the tool wherever the axis stands [um]."""
        return float(self.nc.control.external_mm[2]) * 1000.0
