"""Stability cases as the documentation shows them, and that every key is documented."""

from pathlib import Path

import pytest

from config.loader import parse_yaml_model
from config.machine.stability_case import DirectionCase, ModeCase, StabilityCase, UncertaintyCase, load_stability_case
from models.stability.cutting_coefficients import MATERIALS

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


def test_every_material_has_a_source() -> None:
    for material in MATERIALS.values():
        assert len(material.source) > 20
        assert 0.0 < material.radial_ratio < 1.0
