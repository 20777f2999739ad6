"""A history with axis positions is exported and trained with its slope: from the daemon's store to a model."""

import json
import time
from pathlib import Path
from typing import Any

import history_records as make
import numpy as np
import yaml
from click.testing import CliRunner
from control_rig import SENSOR_IDS, record_for
from expanding_axis import ExpandingAxis
from sloped_machine import PIVOT_MM, TRAVEL_MM, configured, content, proved

from config.recordings.recording_map import load_recording_map
from config.records.commissioning_file import commissioning_text
from daemon.cli import main
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.model_release.gate import unfit
from daemon.model_release.loading import read_model
from drivers.clock import SystemClock
from drivers.files.recording_csv import read_recording

MINUTES = 480
NOWHERE = range(200, 205)
"""Minutes in which the control does not say where the axis stands."""
ECHO, ECHO_SLOPE = 512, 513


def applied(minute: int) -> tuple[float, float]:
    """Return offset [um] and slope [um/m] that the NC applies meanwhile, whatever the machine does."""
    return -0.02 * minute, 30.0 * np.sin(minute / 40.0)


def filled(directory: Path, day: ExpandingAxis, end_s: float) -> Path:
    """Write configuration, commissioning record and a history of the day; return the configuration."""
    given: dict[str, Any] = content(directory)
    given["cnc"]["axis_positions"] = {"Z_mm": {"axis": "Z", "travel_mm": TRAVEL_MM, "rapid_mm_per_min": 30000.0}}
    given["displacements"] = {
        "file": {"path": "/srv/logger/*.csv", "header": "time"},
        "channels": [{"name": "Z1", "column": "Z1"}],
    }
    given["compensation"]["commissioning_file"] = str(directory / "commissioning.json")
    configuration = configured(given)
    record = record_for(configuration, axes=proved())
    (directory / "commissioning.json").write_text(commissioning_text(record), encoding="utf-8")
    layout = MachineLayout.from_configuration(configuration)
    writer = HistoryWriter(configuration.history.path, clock=SystemClock(), machine=layout)
    writer.start()
    for minute in range(MINUTES):
        at_s, mm = end_s + 60.0 * (minute - MINUTES), float(day.position_mm[minute])
        told_mm = np.nan if minute == 0 or minute in NOWHERE else mm
        for line, sensor_ids in layout.lines.items():
            columns = [SENSOR_IDS.index(sensor_id) for sensor_id in sensor_ids]
            writer.temperatures(None, make.cycle(line, minute, at_s + 5.0, day.degc[minute, columns]))
        z_um, um_per_m = applied(minute)
        echo = {ECHO: z_um / 1000.0, ECHO_SLOPE: um_per_m / 1000.0}
        writer.cnc_sample(make.cnc_sample(at_s + 10.0, macros=echo, positions_mm={"Z_mm": told_mm}))
        seen_um = day.measured_um[minute] + z_um + um_per_m * (mm - PIVOT_MM) * 1e-3
        writer.displacement(make.displacement(at_s + 20.0, np.array([seen_um]), source=f"/srv/a.csv:{minute + 2}"))
    writer.close()
    path = directory / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(given))), encoding="utf-8")
    return path


def test_an_exported_history_of_an_axis_that_expands_is_trained_with_its_slope(tmp_path: Path) -> None:
    day = ExpandingAxis(31, MINUTES / 1440.0)
    config = filled(tmp_path, day, (time.time() - 600.0) // 60.0 * 60.0)
    run, model_file = tmp_path / "run.csv", tmp_path / "model.json"

    def command(*arguments: object) -> str:
        done = CliRunner().invoke(main, [str(part) for part in arguments])
        assert done.exit_code in (0, 1) and not isinstance(done.exception, AssertionError), done.output
        return done.output

    said = command("export", "-c", config, "--what", "recording", "--from", "-48h", "-o", run)
    columns = tmp_path / "run.map.yaml"
    assert f"thermal train {run} --map {columns} --model" in said
    found = load_recording_map(columns)
    assert found.axis_positions is None and (found.slopes or {})["Z1"].position == "Z_mm"
    plain = read_recording(run, found.model_copy(update={"slopes": None}))
    kept = np.delete(np.arange(MINUTES), NOWHERE)  # in minute 0 no slope is applied, so that its place does not matter
    np.testing.assert_allclose(plain.displacements_um[:, 0], day.measured_um[kept], atol=0.01)
    command("thermal", "train", run, "--map", columns, "--model", "ridge", "-o", model_file)
    model, why = read_model(model_file, SENSOR_IDS, ["Z1", "Z1_per_m"])
    assert model is not None, why
    configuration = configured(yaml.safe_load(config.read_text(encoding="utf-8")))
    assert model.pivots_mm == {"Z1_per_m": PIVOT_MM} and unfit(model, configuration) == ""
    recording = read_recording(run, found)
    assert recording.displacement_names == ("Z1", "Z1_per_m")
    along_m = (np.array([20.0, 135.0, 250.0, 365.0, 480.0]) - PIVOT_MM) * 1e-3
    true = np.polyfit(along_m, day.error_um[:MINUTES].T, 1)[0]
    off = (recording.displacements_um[:, 1] - true[kept])[8:-8]  # at the ends there is half a pass
    assert np.sqrt(np.mean(off**2)) < 3.0 < 0.2 * np.ptp(true), "um/m"
