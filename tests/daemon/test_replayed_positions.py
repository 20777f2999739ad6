"""What a replay makes of axis positions and slopes: axes of the control, what is left out, what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from small_model import model

from daemon.simulation.processes import write_simulation_configuration
from daemon.simulation.replaying import modelled, played_positions, replay_machine
from models.recordings.dataset import Recording
from models.thermal.training.making import sensor_ids_from_names

Z_MM = np.where(np.arange(20) < 10, 100.0, 480.0)


def recording(positions: tuple[str, ...] = ("X_mm", "Z_mm"), **changes: Any) -> Recording:
    """Twenty minutes of as many temperatures as the model needs, with positions; the last two rows lack them."""
    degc = np.full((20, max(SENSOR_IDS)), 20.0)
    mm = np.column_stack([Z_MM] * len(positions)) if positions else np.zeros((20, 0))
    mm[18:] = np.nan
    made = Recording(
        name="day.csv",
        time_s=60.0 * np.arange(20),
        speed_rpm=None,
        temperature_names=(*(f"t{i + 1}" for i in range(degc.shape[1])), *positions),
        temperatures_degc=np.column_stack([degc, mm]),
        displacement_names=("Z1", "Z1_per_m"),
        displacements_um=np.zeros((20, 2)),
        axis_positions=positions,
    )
    return replace(made, **changes)


def written(directory: Path, name: str = "Z_mm", **changes: Any) -> Path:
    path = directory / "model.json"
    path.write_text(model(axis_positions=(name,) if name else (), **changes).to_json(), encoding="utf-8")
    return path


def test_only_the_positions_that_the_model_needs_are_axes_of_the_control_that_reach_as_far_as_they_did(
    tmp_path: Path,
) -> None:
    path = written(tmp_path)
    part = modelled(path, recording())
    assert part.axis_positions == ("Z_mm",) and part.sensors == len(SENSOR_IDS)
    assert played_positions(part) == {"Z_mm": {"axis": "X", "known": pytest.approx(0.9)}}
    machine = replay_machine(part, path, tmp_path / "commissioning.json")
    _, configuration = write_simulation_configuration(machine, tmp_path, speed=100.0)
    (axis,) = configuration.cnc.axis_positions.values()
    assert (axis.axis, axis.travel_mm) == ("X", (99.0, 481.0)) and axis.rapid_mm_per_min >= 60.0 * 382.0
    assert sensor_ids_from_names(part.temperature_names[: part.sensors]) == configuration.temperatures.sensor_ids


@pytest.mark.parametrize(
    ("name", "positions", "words"),
    [
        ("Z_mm", ("X_mm",), "needs the axis position Z_mm, and the recording has X_mm: name its column under"),
        ("Z_mm", (), "needs the axis position Z_mm, and the recording has none"),
        ("Weg Z [mm]", ("Weg Z [mm]",), "give the column a name of letters, digits and _, and train the model again"),
    ],
)
def test_a_position_that_cannot_be_played_is_named_with_what_to_do(
    tmp_path: Path, name: str, positions: tuple[str, ...], words: str
) -> None:
    with pytest.raises(ValueError, match=r"axis position|cnc\.axis_positions") as refused:
        modelled(written(tmp_path, name), recording(positions))
    assert words in str(refused.value)
