"""A played recording on the simulated NC: its axes are channels, the guard's text runs all the same."""

import numpy as np
import pytest

from config.schema.cnc import MacroMapConfig, RequestMacrosConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import GuardConfig
from config.schema.temperatures import SensorConfig
from drivers.sim.machine.recorded import LEAD_IN_S, POSITIONING_S, RecordedMachine
from models.recordings.dataset import Recording

REQUEST = RequestMacrosConfig(counter=530, kind=531, axis=532, value_mm=533, acknowledge=534)
CHANNELS = ("Y1", "Z1", "Z2")


def machine(*, request: bool = False, z_mm: np.ndarray | None = None) -> RecordedMachine:
    values = {name: 510 + index for index, name in enumerate(CHANNELS)}
    macros = MacroMapConfig(
        writable=["120", "500-540"],
        sequence_a=500,
        values=values,
        valid_until=120,
        enable=501,
        sequence_b=502,
        check=503,
        echo_applied={name: 550 + index for index, name in enumerate(CHANNELS)},
        echo_time=580,
        echo_status=581,
        echo_guard_version=582,
        request=REQUEST if request else None,
    )
    times_s = np.arange(0.0, 600.0, 10.0)
    recording = Recording(
        name="made up",
        time_s=times_s,
        speed_rpm=None,
        temperature_names=("T1",) if z_mm is None else ("T1", "Z_mm"),
        temperatures_degc=np.column_stack([np.full(len(times_s), 21.5), *([] if z_mm is None else [z_mm])]),
        axis_positions=() if z_mm is None else ("Z_mm",),
        displacement_names=CHANNELS,
        displacements_um=np.tile([0.0, 0.0, -6.0], (len(times_s), 1)) * (times_s[:, None] >= 60.0),
    )
    axes = dict.fromkeys(CHANNELS, AxisConfig(absolute_bound_um=50.0, slew_um_per_min=5.0, step_um=5.0))
    guard = GuardConfig.model_validate(
        {
            "increment_mm": 0.0001,
            "on_timeout": "continue",
            "axes": {name: {"letter": "XYZ"[i], "number": i + 1} for i, name in enumerate(CHANNELS)},
        }
    )
    sensors, positions = [SensorConfig(id=1, component="recording")], {} if z_mm is None else {"Z_mm": "Z"}
    return RecordedMachine(recording, sensors, macros, axes, guard, block_s=60.0, positions=positions)


def ask(played: RecordedMachine, z2_um: float) -> None:
    macros = played.nc.macros
    for number, value in ((500, 1.0), (512, z2_um / 1000.0), (120, played.nc.clock_s + 90.0), (501, 7.0), (502, 1.0)):
        macros.set(number, value)
    z2, tenths = round(z2_um * 1000.0), round((played.nc.clock_s + 90.0) * 10.0)
    macros.set(503, 1.0 + 7.0 + tenths + (1 + CHANNELS.index("Z2")) * z2)


def test_nothing_is_applied_before_the_tool_is_at_a_safe_point() -> None:
    played = machine()
    ask(played, 6.0)
    played.advance(LEAD_IN_S + POSITIONING_S - 0.1)
    assert played.nc.macros.get(552) == 0.0
    ask(played, 6.0)
    played.advance(LEAD_IN_S + POSITIONING_S)
    assert played.nc.macros.get(552) == pytest.approx(0.005)
    played.advance(LEAD_IN_S + POSITIONING_S + 1.0)
    assert played.nc.macros.get(552) == pytest.approx(0.006)
    played.advance(LEAD_IN_S + 70.0)
    assert played.truth()["Z2"].uncompensated_um == pytest.approx(-6.0)
    assert played.truth()["Z2"].compensated_um == pytest.approx(0.0)
    assert played.truth()["Y1"].compensated_um == pytest.approx(0.0)


def test_work_is_positioned_until_the_daemon_has_taken_it_however_late_it_looks() -> None:
    """Played 600 times as fast, 20 s are 33 ms of the wall clock: a busy daemon once missed them for good."""
    played = machine(request=True)
    for time_s in np.arange(0.0, LEAD_IN_S + 200.0, 5.0):
        played.advance(float(time_s))
    assert played.nc.sequence_number == 100
    asked = played.nc.macros.get(530)
    assert asked is not None and asked > 1.0, "it asks again after a while without an answer"
    played.nc.macros.set(534, -asked)
    played.advance(LEAD_IN_S + 225.0)
    again = played.nc.macros.get(530)
    assert played.nc.sequence_number == 100 and again is not None and again > asked, "and after a refusal"
    played.nc.macros.set(534, again)
    played.advance(LEAD_IN_S + 245.0)
    assert played.nc.sequence_number == 900


def test_the_control_shows_recorded_positions_on_the_way_from_row_to_row_and_none_where_one_is_missing() -> None:
    z_mm = np.where(np.arange(60) < 20, 100.0, 200.0)
    z_mm[30:33] = np.nan
    played = machine(z_mm=z_mm)
    seen = {}
    for row in (0.0, 19.0, 19.5, 20.0, 31.0, 33.0):
        played.advance(LEAD_IN_S + 10.0 * row)
        seen[row] = played.nc.positions_mm["Z"]
    assert seen == pytest.approx(
        {0.0: 100.0, 19.0: 100.0, 19.5: 150.0, 20.0: 200.0, 31.0: np.nan, 33.0: 200.0}, nan_ok=True
    )
    assert played.nc.positions_mm["X"] == 0.0 and played.register_codes([1]) == [344]
