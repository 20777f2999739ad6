"""The delay experiment over real wires, small: its contract, its sums, its pictures."""

import json
import subprocess
import sys

import pytest
from click.testing import CliRunner
from pace import bearable

from daemon.cli import main

pytestmark = pytest.mark.wires
STATISTICS = {"mean", "p50", "p99", "max", "samples"}


def toolpoint(*arguments, timeout_s=1200.0):
    return subprocess.run(
        [sys.executable, "-P", "-m", "daemon.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("latency")
    page = folder / "latency.html"
    speed = f"{bearable(100.0):.1f}"
    done = toolpoint("latency", "--switches", "2", "--speed", speed, "--json", "-", "--plot", str(page))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_contract(outcome):
    numbers, _ = outcome
    assert {"measurement_s", "feedback_s", "total_s", "parts_s", "published"} <= set(numbers)
    assert set(numbers["parts_s"]) == {"sampling_wait", "sensor_lag", "line_time", "product"}
    for block in (
        numbers["measurement_s"],
        numbers["feedback_s"],
        numbers["total_s"],
        *numbers["parts_s"].values(),
    ):
        assert set(block) == STATISTICS and block["samples"] == 2
        assert 0.0 < block["p50"] <= block["max"]


@pytest.mark.slow
def test_parts_are_what_the_wires_and_the_cycle_allow(outcome):
    numbers, _ = outcome
    parts = numbers["parts_s"]
    assert parts["sampling_wait"]["max"] <= numbers["cycle_period_s"]
    assert parts["line_time"]["max"] < numbers["cycle_period_s"]
    assert numbers["held_back_s"]["max"] == 0.0, "nothing holds the value back without cleansing"
    for move in numbers["moves"]:
        assert move["total_s"] == pytest.approx(move["measurement_s"] + move["feedback_s"])
    # What the machine saw ends when the macro is set, what the daemon traces when it has read it back.
    assert numbers["seen_by_machine_s"]["mean"] < numbers["parts_s"]["product"]["mean"] + 1.0


@pytest.mark.slow
def test_the_picture_shows_both_distributions_and_what_they_are_compared_with(outcome):
    _, page = outcome
    assert "<svg" in page and "24.7" in page and "another rig" in page
    assert "<script" not in page and "src=" not in page


@pytest.mark.parametrize(
    "arguments,sentence",
    [
        (["--switches", "0"], "switches"),
        (["--speed", "nan"], "finite"),
        (["--mode", "neither"], "mode"),
        (["--plot", "picture.gif"], ".html"),
        (["--plot", "/nowhere/at/all.png"], "no folder"),
        (["--json", "/nowhere/at/all.json"], "no folder"),
    ],
)
def test_bad_usage_is_refused_before_anything_starts(arguments, sentence):
    refused = CliRunner().invoke(main, ["latency", *arguments])
    assert refused.exit_code == 2
    assert sentence in refused.output and "Traceback" not in refused.output
