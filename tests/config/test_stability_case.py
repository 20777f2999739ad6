"""Stability cases as the documentation shows them, and that every key is documented."""

import math
from pathlib import Path

import pytest

from config.loader import parse_yaml_model
from config.machine.stability_case import DirectionCase, ModeCase, StabilityCase, UncertaintyCase, load_stability_case
from config.schema.base import ConfigurationError

DOCS = Path(__file__).parents[2] / "docs"


def first_block(page: str, heading: str) -> str:
    text = (DOCS / page).read_text("utf-8").split(heading, 1)[1]
    lines = text.splitlines(True)
    start = next(i for i, line in enumerate(lines) if line.startswith("    "))
    end = next(i for i, line in enumerate(lines[start:], start) if line.strip() and not line.startswith("    "))
    return "".join(line.removeprefix("    ") for line in lines[start:end])


@pytest.mark.parametrize(
    ("page", "heading"),
    [("how-to/find-a-stable-speed.md", "## 1. Describe the cut"), ("reference/stability-files.md", "## A case (YAML)")],
)
def test_the_cases_shown_are_valid(page: str, heading: str) -> None:
    case = parse_yaml_model(first_block(page, heading), StabilityCase, page)
    assert case.cut().teeth == case.teeth


def test_every_key_is_in_the_reference() -> None:
    text = (DOCS / "reference" / "stability-files.md").read_text("utf-8")
    for model in (StabilityCase, ModeCase, DirectionCase, UncertaintyCase):
        for name in model.model_fields:
            assert f"`{name}`" in text, name


def test_paths_start_at_the_files_folder(tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    path.write_text(
        "teeth: 4\ndiameter_mm: 10\nradial_depth_mm: 1\nmilling: down\nmaterial: a5052\nx: {frf: sub/x.csv}\ny: rigid\n"
    )
    case = load_stability_case(path)
    assert isinstance(case.x, DirectionCase)
    assert case.x.frf == tmp_path / "sub" / "x.csv"
    assert case.feed_deg == 0.0


PLAIN = "teeth: 4\ndiameter_mm: 10\nradial_depth_mm: 1\nmilling: down\nmaterial: a5052\nx: {modes: [{frequency_hz: 700,\
 damping_ratio: 0.03, mass_kg: 0.3}]}\ny: rigid\n"


def test_helix_pitches_and_process_damping_reach_the_cut() -> None:
    text = PLAIN + "helix_deg: 30\npitch_deg: [80, 100.05, 80, 100]\nprocess_damping_n_per_m: 2.0e4\n"
    cut = parse_yaml_model(text, StabilityCase, "case.yaml").cut()
    assert math.degrees(cut.helix_rad) == pytest.approx(30.0)
    assert sum(cut.pitch_rad) == pytest.approx(2.0 * math.pi)
    assert math.degrees(cut.pitch_rad[1]) == pytest.approx(100.05, rel=2e-4)
    assert cut.process_damping_n_per_m == 2e4
    assert cut.diameter_m == pytest.approx(0.01)
    assert parse_yaml_model(PLAIN, StabilityCase, "case.yaml").cut().beyond_straight == ()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("pitch_deg: [180, 180]", "2 pitches for 4 teeth"),
        ("pitch_deg: [90, 90, 90, 91]", "add up to 361 deg"),
        ("pitch_deg: [190, -10, 90, 90]", "every pitch is an angle above 0 deg"),
        ("helix_deg: 80", "helix_deg"),
        ("helix_deg: .nan", "helix_deg"),
        ("process_damping_n_per_m: -1", "process_damping_n_per_m"),
    ],
)
def test_edges_that_are_none_are_refused_by_key(line: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        parse_yaml_model(PLAIN + line + "\n", StabilityCase, "case.yaml")
