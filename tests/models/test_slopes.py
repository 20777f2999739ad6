"""A slope along an axis: what a recording tells of it, how it is trained, what it leaves of a scale that expands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from expanding_axis import MAP, PIVOT_MM, SENSORS, TRAINED, left_um, recorded

from config.recordings.recording_map import ColumnError, RecordingMap, resolve_columns
from daemon.model_release.loading import read_model
from models.recordings.dataset import DatasetError
from models.recordings.slopes import offset_and_slope
from models.thermal.family import model_from_json
from models.thermal.training.train_family import train_family


def test_with_its_slope_a_scale_that_expands_leaves_at_most_a_fifth_of_what_the_offset_alone_leaves(
    tmp_path: Path,
) -> None:
    recordings = recorded(tmp_path)
    assert recordings[0].displacement_names == ("Z1", "Z1_per_m") and recordings[0].axis_positions == ()
    alone, whole = left_um(recordings, "pls")
    print(f"offset alone leaves {alone:.2f} um, with its slope {whole:.2f} um: {whole / alone:.1%}")
    assert alone > 2.0, "there is something to compensate"
    assert whole <= 0.2 * alone


# --- what a recording tells --------------------------------------------------------------


def test_offset_and_slope_are_told_at_every_row_of_a_pass_and_nowhere_else() -> None:
    time_s = np.arange(40.0) * 60.0
    position_mm = np.tile([0.0, 400.0], 20)
    um = 7.0 + 30.0 * (position_mm - 100.0) * 1e-3 + 900.0
    um[20:] = np.nan
    offset_um, slope = offset_and_slope(time_s, position_mm, um, pivot_mm=100.0, pass_s=600.0)
    np.testing.assert_allclose(offset_um[:21], 907.0)
    np.testing.assert_allclose(slope[:21], 30.0)
    assert np.isnan(offset_um[30:]).all() and np.isnan(slope[30:]).all()


@pytest.mark.parametrize(
    ("slopes", "words"),
    [
        ({"Z9": {"position": "Z_mm", "pivot_mm": 0.0}}, "no displacement channel; there are Z1"),
        ({"Z1": {"position": "Q_mm", "pivot_mm": 0.0}}, "there is no column 'Q_mm'"),
        ({"Z1": {"position": "t1", "pivot_mm": 0.0}}, "is a temperature or displacement already"),
    ],
)
def test_a_map_that_names_what_is_not_there_is_refused(slopes: dict[str, object], words: str) -> None:
    bad = RecordingMap.model_validate(MAP.model_dump(exclude_none=True) | {"slopes": slopes})
    with pytest.raises(ColumnError, match=words):
        resolve_columns(bad, ["t", *SENSORS, "Z_mm", "Z1"])


# --- what a model says of it -------------------------------------------------------------


def test_a_model_says_which_channels_are_slopes(tmp_path: Path) -> None:
    recordings = recorded(tmp_path, TRAINED[:2])
    model = train_family(recordings, "ridge", sample_s=60.0, created="2026-11-23T00:00:00").model
    path = tmp_path / "model.json"
    path.write_text(model.to_json(), encoding="utf-8")
    assert model_from_json(model.to_json(), "model.json").pivots_mm == {"Z1_per_m": PIVOT_MM}
    assert read_model(path, range(1, 7), ["Z1", "Z1_per_m"])[0] is not None
    plain = [recording.with_channels(("Z1",)) for recording in recordings]
    without = train_family(plain, "ridge", sample_s=60.0, created="2026-11-23T00:00:00").model
    assert "pivots_mm" not in without.to_json(), "a file that needs no newer version says nothing of it"
    with pytest.raises(DatasetError, match="different pivots"):
        train_family(
            [recordings[0], replace(recordings[1], pivots_mm={"Z1_per_m": 0.0})], "ridge", sample_s=60.0, created=""
        )
