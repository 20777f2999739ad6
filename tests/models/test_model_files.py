"""Model files: what is written is read back, and nothing else is believed."""

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from signed_models import signed

from models.headless_file import content_sha256
from models.model_file import ModelError
from models.thermal.family import model_from_json
from models.thermal.linear import LinearModel
from models.thermal.model import TrainingData
from models.thermal.training.making import increment_model

OLD = Path(__file__).parents[1] / "fixtures/version_0_1_0/models"
COEFFICIENTS = np.array([[1.5, -0.25, 0.1], [0.0, 2.0, 1.0 / 3.0]])
DRIFT = np.array([0.0, 0.01])
NOW = np.array([21.0, 22.0, 23.5])


def model() -> LinearModel:
    return increment_model(
        model_id="increments-1min-00000000",
        kind="increments",
        channels=("Y1", "Z1"),
        sensor_ids=(7, 9, 301),
        sensor_names=("T7", "T9", "T301"),
        coefficients_um_per_k=COEFFICIENTS,
        drift_um_per_min=DRIFT,
        hyper_parameters={"interval_min": 1.0, "ridge_k2": 0.0},
        lowest_increment_k=np.array([-1.0, 0.0, -0.5]),
        highest_increment_k=np.array([4.0, 5.0, 6.0]),
        band_um=np.array([1.25, np.nan]),
        training=(TrainingData(name="day.csv", sha256="ab" * 32, from_hours=0.0, to_hours=32.0, rows=7680),),
        created="2026-01-02T03:04:05+00:00",
        test_pairs=[(NOW, np.full(3, 20.0)), (NOW, NOW)],
    )


def changed(change: Callable[[dict[str, Any]], None]) -> str:
    """Return the file after a change, with a checksum that fits it again."""
    content = json.loads(model().to_json())["model"]
    change(content)
    return signed(json.dumps(content))


def put(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.__setitem__(key, value)


def test_a_model_survives_its_file_exactly() -> None:
    text = model().to_json()
    read = model_from_json(text, "m.json")
    assert isinstance(read, LinearModel)
    for field in fields(LinearModel):
        ours, theirs = getattr(model(), field.name), getattr(read, field.name)
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(ours, theirs, err_msg=field.name)
        elif field.name not in ("test_vectors", "solutions", "domain"):
            assert ours == theirs, field.name
    np.testing.assert_array_equal(read.coefficients(), COEFFICIENTS.T)
    assert read.to_json() == text
    assert all(line.startswith(('"', "}")) for line in text.splitlines()[1:-1])


def test_any_change_without_a_new_checksum_is_refused() -> None:
    text = model().to_json()
    for old, new in (('"ridge_k2":0.0', '"ridge_k2":2.0'), ("-0.25", "-0.35")):
        assert old in text
        with pytest.raises(ModelError, match=r"m\.json: sha256: does not fit the content"):
            model_from_json(text.replace(old, new, 1), "m.json")


def test_a_changed_coefficient_fails_its_test_vector_even_with_a_checksum() -> None:
    text = changed(lambda content: content["solutions"][0]["weights"][1].__setitem__(1, 2.5))
    with pytest.raises(ModelError, match=r"m\.json: test_vectors\[0\]: channel Z1: the model gives"):
        model_from_json(text, "m.json")


@pytest.mark.parametrize("version", [0, 7, "1", True, None, 1.5])
def test_an_unknown_format_version_is_refused(version: object) -> None:
    text = model().to_json().replace('"format_version": 3', f'"format_version": {json.dumps(version)}')
    with pytest.raises(ModelError, match=r"m\.json: format_version: .* is unknown"):
        model_from_json(text, "m.json")


def test_a_type_of_machine_is_no_model_and_says_how_to_make_one() -> None:
    with pytest.raises(ModelError, match=r"m\.json: family: is a type of machine: .* train --prior"):
        model_from_json(signed("{}", family="machine-type"), "m.json")


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("channels", [], "channels: is empty"),
        ("channels", ["Y1", "Y1"], "channels: Y1 appears twice"),
        ("channels", "Y1", "channels: must be a list"),
        ("sensor_ids", [7, 9, 9], "sensor_ids: 9 appears twice"),
        ("sensor_ids", [7, 9, 0], "sensor_ids: 0 is not a sensor ID"),
        ("sensor_ids", [7, 9], "sensor_names: 3 for 2 sensors"),
        ("sensor_ids", [7, 9, True], r"sensor_ids\[2\]: must be a whole number"),
        ("drift_um_per_min", [0.0], "drift_um_per_min: has shape"),
        ("drift_um_per_min", [0.0, "0"], "drift_um_per_min: must be finite numbers"),
        ("drift_um_per_min", [0.0, True], "drift_um_per_min: must be finite numbers"),
        ("drift_um_per_min", [0.0, None], "drift_um_per_min: holds a number that is not finite"),
        ("drift_um_per_min", [[0.0], [1.0, 2.0]], "drift_um_per_min: must be a list of numbers, or of rows"),
        ("drift_um_per_min", 5, "drift_um_per_min: must be a list"),
        ("domain", {"of_increments": True, "lowest": [0, 9, 0], "highest": [1, 1, 1]}, "domain.lowest: sensor 9: lies"),
        ("domain", {"of_increments": True, "lowest": [0, 9, 0]}, "domain.highest: is missing"),
        ("band_um", [-1.0, 1.0], "band_um: a band is not negative"),
        ("period_min", 0, "period_min: 0.0 must be positive and finite"),
        ("period_min", 10**400, "period_min: must be a finite number"),
        ("period_min", "1", "period_min: must be a finite number"),
        ("model_id", " ", "model_id: is empty"),
        ("created", 5, "created: must be text"),
        ("training", [{"name": "x"}], r"training\[0\].sha256: is missing"),
        ("training", [5], r"training\[0\]: must be an object"),
        ("test_vectors", [], "test_vectors: is empty"),
        ("surprise", 1, "surprise: is not a key of this format"),
    ],
)
def test_wrong_content_is_refused_by_name(key: str, value: object, sentence: str) -> None:
    with pytest.raises(ModelError, match=rf"m\.json: {sentence}"):
        model_from_json(changed(put(key, value)), "m.json")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", r"line 1, column 1: this is not JSON"),
        (model().to_json()[:-40], r"line \d+, column \d+: this is not JSON"),
        ("[1]", "is no JSON object"),
        ('{"a": 1, "a": 2}', "a: is written twice"),
        ('{"format_version": NaN}', "NaN is not a number"),
        ('{"format_version": -Infinity}', "-Infinity is not a number"),
        ('{"format_version": 1, "b": [-1e999]}', "-1e999 is not a number"),
        ("[" * 100_000, ".*nested too deeply"),
        ('{"format_version": ' + "9" * 5000 + "}", ".*cannot be read"),
    ],
)
def test_what_is_no_model_file_is_refused(text: str, sentence: str) -> None:
    with pytest.raises(ModelError, match=rf"m\.json: {sentence}"):
        model_from_json(text, "m.json")


@given(position=st.integers(0, len(model().to_json()) - 1), byte=st.integers(32, 126))
def test_no_single_character_changes_what_a_model_says(position: int, byte: int) -> None:
    text = model().to_json()
    spoilt = text[:position] + chr(byte) + text[position + 1 :]
    try:
        read = model_from_json(spoilt, "m.json")
    except ModelError:
        return
    assert read.to_json() == text


@pytest.mark.parametrize("name", ["increments_plain", "family_default"])
def test_files_of_the_formats_before_are_checked_as_strictly(name: str) -> None:
    """What their models estimate is compared in `tests/system/test_upgrade_from_0_1_0.py`."""
    content = json.loads((OLD / f"{name}.json").read_text(encoding="utf-8"))

    def refused(sentence: str, **changes: object) -> None:
        spoilt = {key: value for key, value in (content | changes).items() if value is not ...}
        if "sha256" not in changes:
            spoilt["sha256"] = content_sha256({key: value for key, value in spoilt.items() if key != "sha256"})
        with pytest.raises(ModelError, match=rf"m\.json: {sentence}"):
            model_from_json(json.dumps(spoilt), "m.json")

    refused("sha256: does not fit the content", kind="other", sha256=content["sha256"])
    refused("band_um: is missing", band_um=...)
    refused("surprise: is not a key of this format", surprise=1)
    refused("channels: Y1 appears twice", channels=["Y1", "Y1"])
    refused(
        "drift_um_per_min: must be a list" if name == "increments_plain" else "centre: must be",
        **({"drift_um_per_min": 5} if name == "increments_plain" else {"centre": 5}),
    )
    refused("does not hold what format", test_vectors=5)
    if name == "increments_plain":  # the policy would release nothing any more beside such a proposal
        refused("does not hold what format", coefficients_um_per_k=[[1.0], [1.0, 2.0]])
    refused("test_vectors: is empty", test_vectors=[])
