"""`toolpoint thermal figures`: report, pictures and numbers from a small campaign of the published form."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from daemon.cli import main
from drivers.files.recording_csv import write_recording
from models.records import FloatArray

SENSORS = 8
MINUTES = 40
DATASETS = (
    (1, 12000.0, "", "train"),
    (2, 12000.0, "cold start", "train"),
    (3, 6000.0, "", "train"),
    (4, 12000.0, "after idle reduction", "train"),
    (5, 9000.0, "cold start", "test"),
    (6, 12000.0, "idle reduction while the spindle is stopped", "test"),
)


def columns(number: int, speed_rpm: float) -> dict[str, tuple[FloatArray, int]]:
    rng = np.random.default_rng(number)
    minutes = np.arange(MINUTES + 1.0)
    speed = np.where((minutes > 0) & (minutes <= 25), speed_rpm, 0.0)
    heat = np.cumsum(speed / 12000.0 - 0.3 * (minutes > 25)) / 10.0
    degc = 22.0 + np.outer(heat, np.linspace(0.2, 2.0, SENSORS)) + rng.normal(0.0, 0.03, (MINUTES + 1, SENSORS))
    degc += np.cumsum(rng.normal(0.0, 0.02, (MINUTES + 1, SENSORS)), axis=0)
    um = {"Y1": -0.5 * degc[:, 3], "Y2": -degc[:, 3], "Z1": -4.0 * degc[:, 5], "Z2": -4.0 * degc[:, 5] - degc[:, 0]}
    um["Z3"] = -2.0 * degc[:, 6]
    return {
        "t": (60.0 * minutes, 0),
        "rpm": (speed, 1),
        **{name: (values - values[0], 4) for name, values in um.items()},
        **{f"T{i + 1}": (degc[:, i], 4) for i in range(SENSORS)},
    }


def make_campaign(folder: Path) -> Path:
    folder.mkdir()
    entries = []
    for number, speed_rpm, cooling, usage in DATASETS:
        write_recording(folder / f"d{number}.csv", {"machine": "of the test"}, columns(number, speed_rpm))
        entries.append(
            {
                "dataset": number,
                "file": f"d{number}.csv",
                "spindle_speeds_rpm": [speed_rpm],
                "switching": False,
                "previous": "",
                "cooling": cooling,
                "usage": usage,
                "series": 1,
                "start_h": float(number),
            }
        )
    hours = np.array([0.0, 0.5, 30.0])
    write_recording(folder / "overview.csv", {}, {"time_h": (hours, 3), "rpm": (hours, 0), "Room": (20.0 + hours, 2)})
    index = {
        "version": 1,
        "name": "small",
        "machine": "test stand",
        "overview": "overview.csv",
        "labels": {"Room": ["T1"], "IR": ["T8"], "A": ["T4", "T5"]},
        "datasets": entries,
    }
    (folder / "campaign.json").write_text(json.dumps(index), encoding="utf-8")
    return folder


def run(campaign: Path, output: Path, *more: object) -> Result:
    arguments = ["thermal", "figures", campaign, "-o", output, "--repeats", 2, "--json", "-", *more]
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    base = tmp_path_factory.mktemp("figures")
    result = run(make_campaign(base / "campaign"), base / "report")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert isinstance(found, dict)
    return base / "report", found


def test_every_figure_is_there_as_picture_and_in_one_page(made: tuple[Path, dict[str, Any]]) -> None:
    folder, found = made
    assert list(found["figures"]) == [f"3-{place}" for place in range(2, 23)]
    page = (folder / "report.html").read_text("utf-8")
    for number, name in found["figures"].items():
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
        assert f"id='figure-{number}'" in page
    assert page.count("<script src=") == 0, "nothing is loaded from elsewhere"
    assert page.count("Plotly.newPlot") >= 21
    assert "test stand" in page
    assert "none is a published one" in page


def test_bad_input_is_one_sentence(tmp_path: Path) -> None:
    result = run(tmp_path / "nowhere", tmp_path / "report")
    assert (result.exit_code, "cannot be read" in result.output) == (2, True)
    campaign = make_campaign(tmp_path / "campaign")
    index = json.loads((campaign / "campaign.json").read_text("utf-8"))
    for change, sentence in (
        ({"datasets": index["datasets"][:3]}, "needs data sets with usage train and with usage test"),
        ({"labels": {}}, "no temperature has the label Room or IR"),
        ({"version": 2}, "version"),
        ({"overview": "d1.csv"}, "is no overview"),
    ):
        (campaign / "campaign.json").write_text(json.dumps(index | change), encoding="utf-8")
        result = run(campaign, tmp_path / "report")
        assert result.exit_code == 2, result.output
        assert sentence in result.output
