"""`thermal train` says which sensor may mislead the model before the others tell that it is wrong."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from daemon.cli import main
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.family import model_from_json
from models.thermal.linear import LinearModel
from models.thermal.training.watch_fit import unnoticed_um

SENSORS, ROWS = 5, 300


def run(folder: Path, seed: int) -> Path:
    """A machine of which four sensors warm together; the fifth, at the nose, does what no other shows."""
    rng = np.random.default_rng(seed)
    minutes = np.arange(float(ROWS))
    body = 6.0 * (1.0 - np.exp(-minutes / 90.0)) * rng.uniform(0.7, 1.3)
    nose = np.repeat(rng.normal(0.0, 3.0, ROWS // 30), 30)
    degc = 20.0 + np.column_stack([body * share for share in (1.0, 0.9, 0.8, 0.7)] + [0.3 * body + nose])
    degc += rng.normal(0.0, 0.02, degc.shape)
    error_um = 2.0 * (degc[:, 4:] - degc[0, 4]) + rng.normal(0.0, 0.2, (ROWS, 1))
    path = folder / f"run{seed}.csv"
    names = ",".join(f"T{index + 1}" for index in range(SENSORS))
    table = np.column_stack([60.0 * minutes, degc, error_um])
    np.savetxt(path, table, delimiter=",", header=f"t,{names},c1", comments="", fmt="%.6g")
    return path


def test_the_sensor_that_no_other_tells_is_named_with_what_it_may_make(tmp_path: Path) -> None:
    recordings = [str(run(tmp_path, seed)) for seed in range(4)]
    output = tmp_path / "m.json"
    arguments = ["thermal", "train", *recordings, "--model", "lags", "-o", str(output), "--json", "-"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    first = json.loads(result.stdout)["noticed_late"][0]
    model = model_from_json(output.read_text("utf-8"), "m.json")
    assert isinstance(model, LinearModel) and model.watch is not None
    assert (first["sensor"], first["channel"]) == ("T5", "c1")
    assert first["from_k"] == model.watch.threshold_k[4] > 2.0
    assert f"sensor T5 may drift by {first['from_k']:.1f} K before the others tell, which makes" in result.stderr
    online = replace(model, watch=None).runtime(Machine(components={}))
    before = np.full(SENSORS, 22.0)
    after = before + first["from_k"] * np.eye(SENSORS)[4]
    online.on_sample(0.0, before, 0.0)
    online.set_reference(OnlineReference(time_min=0.0, now_min=0.0, degc=before))
    for minute in range(1, 3000):
        online.on_sample(float(minute), after, 0.0)
    now, _ = online.estimate(3000.0, after, np.zeros(SENSORS, dtype=np.bool_))
    assert now is not None
    np.testing.assert_allclose(abs(now.thermal_error_um[0]), first["error_um"], rtol=1e-2)
    np.testing.assert_allclose(unnoticed_um(model)[4], now.thermal_error_um, rtol=1e-2)
