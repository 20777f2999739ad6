"""`toolpoint dynamics bearings`: the contract, the bounds as configuration, bad input."""

from dataclasses import replace
from pathlib import Path

import pytest
from dynamics_command import answer, call

from config.machine.published_bearings import published_model
from models.thermomechanics.artifact import model_to_json

AT_20 = ["--t-ir", "20", "--t-a", "20", "--t-f", "20", "--t-room", "20"]


def test_raw_value_and_flag_per_property() -> None:
    found = answer("bearings", "--axis", "y", *AT_20)
    assert set(found) == {"ct_12", "kr_12", "kt_34", "kt_5", "ct_5"}
    assert all(set(each) == {"raw", "value", "flagged"} for each in found.values())
    assert found["ct_5"]["flagged"] is True
    assert found["ct_5"]["value"] == 0.0
    assert found["kt_34"]["flagged"] is False


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("bounds:\n  kt: {lowest: 2.0, highest: 1.0, origin: assumed, note: n}\n", "highest: must lie above"),
        ("bounds:\n  kx: {lowest: 0.0, highest: 1.0, origin: assumed, note: n}\n", "no bearing property"),
        ("bounds: {}\n", "kt is missing"),
    ],
)
def test_bounds_that_are_none_are_refused_with_line_and_key(tmp_path: Path, text: str, complaint: str) -> None:
    own = tmp_path / "bounds.yaml"
    own.write_text(text)
    result = call("bearings", "--axis", "x", *AT_20, "--bounds", own)
    assert result.exit_code == 2
    assert complaint in result.stderr
    assert str(own) in result.stderr


@pytest.mark.parametrize("wrong", ["nan", "inf", "400", "warm"])
def test_temperatures_that_are_none_are_refused(wrong: str) -> None:
    result = call("bearings", "--axis", "x", "--t-ir", wrong, *AT_20[2:])
    assert result.exit_code == 2
    assert "--t-ir" in result.stderr


def test_a_model_of_a_campaign_takes_the_place_of_the_tables(tmp_path: Path) -> None:
    model = tmp_path / "model.json"
    model.write_text(model_to_json(published_model()))
    assert answer("bearings", "--axis", "x", *AT_20, "--model", model) == answer("bearings", "--axis", "x", *AT_20)
    model.write_text(model_to_json(published_model()).replace("2910.0", "2910.5", 1))
    result = call("bearings", "--axis", "x", *AT_20, "--model", model)
    assert result.exit_code == 2
    assert "model.json: sha256" in result.stderr
    assert "cannot be opened" in call("bearings", "--axis", "x", *AT_20, "--model", tmp_path / "none.json").stderr


def test_a_model_is_asked_by_its_own_signals(tmp_path: Path) -> None:
    model, renamed = tmp_path / "model.json", published_model().axes["y"]
    regression = replace(renamed, signals=("Nose (front)", "B", "C", "Hall"))
    model.write_text(model_to_json(replace(published_model(), axes={"y": regression})))
    asked = ("bearings", "--axis", "y", "--model", model, "--signal", "Nose (front)=24.5,0.8", "--signal", "B=23")
    named = answer(*asked, "--signal", "C=22.5", "--signal", "Hall=21")
    published = ("--t-ir", 24.5, "--t-a", 23, "--t-f", 22.5, "--t-room", 21, "--d-ir", 0.8)
    assert named == answer("bearings", "--axis", "y", *published)
    assert "no temperature of C, Hall is given: --signal C=DEGC" in call(*asked).stderr
    assert "there is no signal X" in call(*asked, "--signal", "C=1", "--signal", "Hall=1", "--signal", "X=1").stderr
    assert "is not of the form NAME=DEGC" in call(*asked, "--signal", "22").stderr
