"""A machine whose spindle speed is tuned: the rig's, with a section `spindle_speed` on the simulated spindle."""

from pathlib import Path
from typing import Any

import numpy as np
from control_rig import machine

from config.machine.published_bearings import load_bounds
from config.schema import Configuration
from config.schema.spindle_speed import SpeedMacrosConfig, SpeedOperationConfig, SpindleSpeedConfig
from models.dynamics.bearings import PARAMETERS
from models.thermomechanics.regression import AxisRegression, PropertyRegression, ThermomechanicalModel

CASE = """\
teeth: 4
diameter_mm: 10
radial_depth_mm: 5
milling: down
kt_n_per_m2: 8.0e8
kr_ratio: 0.3
x: {modes: [{frequency_hz: 620, damping_ratio: 0.02, stiffness_n_per_m: 6.0e6}]}
y: rigid
feed_deg: 0
"""
MACROS = SpeedMacrosConfig(
    sequence_a=530,
    for_tool=531,
    for_speed=532,
    for_feed=533,
    for_depth=534,
    for_radial=535,
    for_kind=536,
    speed=537,
    feed=538,
    valid_until=121,
    enable=539,
    check=541,
    sequence_b=540,
    calls=550,
    called_tool=551,
    called_speed=552,
    called_feed=553,
    called_depth=554,
    called_radial=555,
    called_kind=556,
    called_text=557,
    echo_speed=558,
    echo_feed=559,
    echo_status=560,
)

COLD = {
    "ct_12": 300.0,
    "kr_12": 3.0e6,
    "kt_34": 1.0e8,
    "kt_5": 5.0e7,
    "ct_5": 500.0,
    "kr_5": 1.0e5,
}
"""Bearings at 20 degC."""


def bearing_model(*, stiffening_per_k: float = 0.02, flagged: str = "") -> ThermomechanicalModel:
    """Bearings that stiffen with label A; the property `flagged` is regressed to below its range."""
    bounds = load_bounds()
    properties = []
    for name, cold in COLD.items():
        slope = cold * stiffening_per_k if name.startswith("k") else 0.0
        level = -cold if name == flagged else cold - 20.0 * slope
        properties.append(
            PropertyRegression(name=name, interval_min=0.0, coefficients=np.array([level, slope]), bounds=bounds[name])
        )
    fixed = {name: 1e-5 for name in PARAMETERS if name not in COLD}
    axes = {axis: AxisRegression(axis=axis, signals=("A",), properties=tuple(properties), fixed=fixed) for axis in "xy"}
    return ThermomechanicalModel(
        model_id="made-up",
        source="a test",
        created="2026-01-01",
        rigid_rotary_inertia="correct",
        spindle_sha256="",
        axes=axes,
    )


def speed_machine(folder: Path, *, one_feed_direction: bool = True, **changes: Any) -> Configuration:
    """The rig's machine; T1 is tuned. `changes` go to the section."""
    case = folder / "case.yaml"
    case.write_text(CASE, encoding="utf-8")
    content: dict[str, Any] = {
        "macros": MACROS,
        "thermomechanical_model": folder / "bearings.json",
        "operations": [
            SpeedOperationConfig(
                tool_number=1,
                spindles={"x": Path("simulated_machine"), "y": Path("simulated_machine")},
                case=case,
                depth_mm=0.4,
                one_feed_direction=one_feed_direction,
            )
        ],
        "lowest_rpm": 2000.0,
        "highest_rpm": 12000.0,
        "max_change_percent": 20.0,
        "hysteresis_rpm": 50.0,
        "step_rpm": 200.0,
        "verify_with_sdm": False,  # these cuts are too deep for it, and move the speed far by the lobes alone
    }
    base = machine(folder)
    own = {"allow_writable_model_directory": True}  # everything here belongs to whoever tests
    macros = base.cnc.macros.model_copy(update={"writable": [*base.cnc.macros.writable, "121", "530-541"]})
    document = base.model_copy(
        update={
            "cnc": base.cnc.model_copy(update={"macros": macros}),
            "compensation": base.compensation.model_copy(update=own),
            "spindle_speed": SpindleSpeedConfig(**(content | changes)),
        }
    )
    return Configuration.model_validate(document.model_dump())


def in_dialect(configuration: Configuration, dialect: str) -> Configuration:
    """The machine as it would be with a control of this language."""
    cnc = configuration.cnc
    changed: dict[str, Any] = {"guard": cnc.guard.model_copy(update={"dialect": dialect})}
    if dialect == "sinumerik":
        changed["opcua"] = cnc.opcua.model_copy(update={"preset": "sinumerik", "namespace_uri": None})
    return configuration.model_copy(update={"cnc": cnc.model_copy(update=changed)})
