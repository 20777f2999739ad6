"""The pages of evaluations and replays: complete in one file, measured and estimated on one scale, names escaped."""

import html as markup
import json
import re
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from daemon.cli import main
from daemon.workbench.figures import MOST_IN_WORDS, picture
from daemon.workbench.thermal.result_pages import MOST_POINTS, Stretch, _candidates, figures
from models.thermal.features import lag_table

NAME = "Weg <Z> [um]"


def recording(path: Path) -> Path:
    rng = np.random.default_rng(1)
    rpm = np.concatenate([np.r_[np.full(60, speed), np.zeros(60)] for speed in (3000.0, 5000.0, 2000.0, 4000.0)])
    quick, slow = lag_table(np.arange(480.0), ((rpm / 5000.0) ** 2)[:, None], (8.0, 40.0))[:, :, 0]
    degc = 21.0 + np.column_stack([12.0 * quick, 8.0 * slow, 6.0 * quick]) + rng.normal(0.0, 0.02, (480, 3))
    columns = {"t": 60.0 * np.arange(480.0), "rpm": rpm, **{f"t{i}": degc[:, i] for i in range(3)}, NAME: 30.0 * slow}
    rows = [",".join(f"{value:.4f}" for value in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]) + "\n", encoding="utf-8")
    return path


def test_an_evaluation_draws_itself_as_one_file_that_loads_nothing(tmp_path: Path) -> None:
    (columns := tmp_path / "map.yaml").write_text(
        f'time: t\nspeed: rpm\ntemperatures: ["t[0-9]"]\ndisplacements: ["{NAME}"]\n', encoding="utf-8"
    )
    html = tmp_path / "day.html"
    arguments = ["thermal", "evaluate", recording(tmp_path / "day.csv"), "--map", columns, "--model", "lags"]
    arguments += ["--leave-out-cycles", "--html", html, "--json", "-"]
    result = CliRunner().invoke(main, [str(part) for part in arguments])
    assert result.exit_code == 0, result.output
    found, page = json.loads(result.stdout), html.read_text("utf-8")
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=[\"']?http", page)
    assert "<Z>" not in re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL), "names are escaped"
    text = page.split("What was chosen, and why", 1)[1]
    chosen = found["channels"][NAME]["chosen"]
    assert chosen["family"] in text and "What was tried in training" in text
    assert f"{found['mean']['reduction_rmse']:.1%}" in text
    without_um = found["channels"][NAME]["rmse_without_um"]
    assert without_um == found["mean"]["rmse_without_um"] > found["mean"]["rmse_um"]
    reached = re.sub(r"<[^>]+>", " ", page.split("What was reached", 1)[1])
    assert "RMSE without [um]" in reached and f"{without_um:.4g}"[:4] in reached, "what it was before stands beside it"
    assert page.count("Plotly.newPlot") >= 1 and "cycle 4" in text
    assert "left on line, by confidence" in text
    assert f"{found['mean']['online']['reduction_rmse']:.1%}" in text
    said = [line.split(": ", 1)[1] for line in result.stderr.splitlines() if line.startswith(("next:", "warning:"))]
    read = markup.unescape(re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL))
    assert found["advice"] and set(found["advice"]) <= set(said)
    assert [sentence for sentence in said if sentence not in read] == [], "the page advises as the terminal does"
    assert "false alarms: " in read


def test_the_page_says_why_a_family_was_refused() -> None:
    channels = {"Z": {"candidates": {"lags": {"reduction_rmse": None, "refused": "no run is long enough"}}}}
    (section,) = _candidates(channels)
    assert section.items == ("lags was refused: no run is long enough",)


def probed(name: str, rows: int, every: int) -> Stretch:
    """Return a stretch that was measured now and then."""
    measured = np.where(np.arange(rows) % every == 7, np.arange(float(rows)), np.nan)[:, None]
    return Stretch(name=name, time_h=np.arange(rows) / 60.0, measured_um=measured, estimated_um=measured + 1.0)


def test_every_value_of_a_probe_is_drawn_and_a_line_through_them() -> None:
    (drawn,) = figures(("Z",), [probed("a.csv", MOST_POINTS, 60), probed("b.csv", MOST_POINTS, 60)])
    for curve in (*drawn.axes[0].curves, *drawn.axes[1].curves):
        assert np.isfinite(curve.y).sum() == 2 * MOST_POINTS / 60, "a line of gaps shows none, every second row half"
        assert np.isnan(curve.y).sum() == 2, "no gaps but those between the recordings"
        assert curve.marker == "o"
    whole = np.arange(3.0 * MOST_POINTS)
    (drawn,) = figures(
        ("Z",), [Stretch(name="a", time_h=whole, measured_um=whole[:, None], estimated_um=whole[:, None])]
    )
    assert [len(curve.y) for curve in drawn.axes[0].curves] == [MOST_POINTS + 1] * 2 and not drawn.axes[0].curves[
        0
    ].marker


def test_the_names_of_many_recordings_can_be_read_and_the_legend_takes_no_width() -> None:
    drawn = figures(("Z",), [probed(f"warmup_{number:02}.csv", 60, 10) for number in range(40)])[0]
    page = picture(drawn, alone=False).picture
    words = re.findall(r"warmup_\d\d\.csv", page)
    assert words[0] == "warmup_00.csv" and 4 <= len(words) <= MOST_IN_WORDS / len(words[0])
    assert '"orientation":"h"' in page
