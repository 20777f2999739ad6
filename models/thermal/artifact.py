"""The file of a thermal model: versioned JSON with a checksum and test vectors, never a pickle."""

from dataclasses import fields
from typing import Any

import numpy as np

from models.thermal.json_fields import (
    null_for_nan,
    read_integer,
    read_list,
    read_matrix,
    read_number,
    read_object,
    read_text,
    read_vector,
    text_of_file,
    whole_content,
)
from models.thermal.model import ModelError, TestVector, ThermalModel, TrainingData

__all__ = ["FORMAT_VERSION", "ModelError", "ThermalModel", "model_from_json", "model_to_json"]

FORMAT_VERSION = 1
"""Version of the file's layout; another one is refused."""
OPTIONAL = frozenset({"axis_positions"})
"""Keys that only files hold to which they apply."""


def model_to_json(model: ThermalModel) -> str:
    """Return the model as the text of its file, one key per line; numbers are exact."""
    content = {"format_version": FORMAT_VERSION, **_plain(model)}
    return text_of_file({key: value for key, value in content.items() if value or key not in OPTIONAL})


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return null_for_nan(value.tolist())
    if isinstance(value, ThermalModel | TestVector | TrainingData):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def model_from_json(text: str, source: str) -> ThermalModel:
    """Return the model that a file holds.

    Parameters
    ----------
    text
        Content of the file.
    source
        Its name, for messages.

    Raises
    ------
    ModelError
        Naming source and key: not JSON, an unknown format version, missing or unknown keys, wrong
        types or shapes, numbers that are not finite, a checksum or a test vector that differs.

    """
    try:
        return _model(whole_content(text, FORMAT_VERSION, {field.name for field in fields(ThermalModel)}, OPTIONAL))
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error


def _model(content: dict[str, Any]) -> ThermalModel:
    return ThermalModel(
        model_id=read_text("model_id", content["model_id"]),
        kind=read_text("kind", content["kind"]),
        channels=tuple(read_text("channels", item) for item in read_list("channels", content["channels"])),
        sensor_ids=tuple(read_integer("sensor_ids", item) for item in read_list("sensor_ids", content["sensor_ids"])),
        sensor_names=tuple(
            read_text("sensor_names", item) for item in read_list("sensor_names", content["sensor_names"])
        ),
        coefficients_um_per_k=read_matrix("coefficients_um_per_k", content["coefficients_um_per_k"]),
        drift_um_per_min=read_vector("drift_um_per_min", content["drift_um_per_min"]),
        interval_min=read_number("interval_min", content["interval_min"]),
        ridge_k2=read_number("ridge_k2", content["ridge_k2"]),
        lowest_increment_k=read_vector("lowest_increment_k", content["lowest_increment_k"]),
        highest_increment_k=read_vector("highest_increment_k", content["highest_increment_k"]),
        band_um=read_vector("band_um", content["band_um"], null_allowed=True),
        training=tuple(read_training(i, item) for i, item in enumerate(read_list("training", content["training"]))),
        created=read_text("created", content["created"]),
        axis_positions=read_axis_positions(content),
        test_vectors=tuple(_test(i, item) for i, item in enumerate(read_list("test_vectors", content["test_vectors"]))),
    )


def read_axis_positions(content: dict[str, Any]) -> tuple[str, ...]:
    """Return the inputs that are axis positions, which a file without any does not mention; raises ModelError."""
    return tuple(
        read_text("axis_positions", item) for item in read_list("axis_positions", content.get("axis_positions", []))
    )


def read_training(index: int, content: Any) -> TrainingData:
    """Return what one recording contributed; raises ModelError."""
    path = f"training[{index}]"
    item = read_object(path, content, {field.name for field in fields(TrainingData)})
    return TrainingData(
        name=read_text(f"{path}.name", item["name"]),
        sha256=read_text(f"{path}.sha256", item["sha256"]),
        from_hours=read_number(f"{path}.from_hours", item["from_hours"]),
        to_hours=read_number(f"{path}.to_hours", item["to_hours"]),
        rows=read_integer(f"{path}.rows", item["rows"]),
    )


def _test(index: int, content: Any) -> TestVector:
    path = f"test_vectors[{index}]"
    item = read_object(path, content, {field.name for field in fields(TestVector)})
    return TestVector(
        degc=read_vector(f"{path}.degc", item["degc"]),
        reference_degc=read_vector(f"{path}.reference_degc", item["reference_degc"]),
        elapsed_min=read_number(f"{path}.elapsed_min", item["elapsed_min"]),
        thermal_error_um=read_vector(f"{path}.thermal_error_um", item["thermal_error_um"]),
    )
