"""The file of a thermal model: versioned JSON with a checksum and test vectors, never a pickle."""

import hashlib
import json
import math
from dataclasses import fields
from typing import Any

import numpy as np

from models.records import FloatArray
from models.thermal.model import ModelError, TestVector, ThermalModel, TrainingData

__all__ = ["FORMAT_VERSION", "ModelError", "ThermalModel", "model_from_json", "model_to_json"]

FORMAT_VERSION = 1
"""Version of the file's layout; another one is refused."""
LARGEST_NUMBER = 1e12
"""No quantity of a thermal model comes near this."""


def model_to_json(model: ThermalModel) -> str:
    """Return the model as the text of its file, one key per line; numbers are exact."""
    content = {"format_version": FORMAT_VERSION, **_plain(model)}
    lines = [f'"{key}": {_compact(value)}' for key, value in content.items()]
    lines.append(f'"sha256": "{_sha256(content)}"')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _null_for_nan(value.tolist())
    if isinstance(value, ThermalModel | TestVector | TrainingData):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def _null_for_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [_null_for_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=True)


def _sha256(content: dict[str, Any]) -> str:
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


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
        content = _parse(text)
        version = content.get("format_version")
        if version != FORMAT_VERSION or isinstance(version, bool):
            raise ModelError(
                "format_version", f"{version!r} is unknown; this version of Toolpoint reads {FORMAT_VERSION}"
            )
        _require_keys("", content, {"format_version", "sha256", *(field.name for field in fields(ThermalModel))})
        written = content.pop("sha256")
        if written != _sha256(content):
            raise ModelError("sha256", "does not fit the content; the file was changed after training, train it again")
        del content["format_version"]
        return _model(content)
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error


def _parse(text: str) -> dict[str, Any]:
    def no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise ModelError(twice[0], "is written twice")
        return dict(pairs)

    def refuse_constant(name: str) -> float:
        raise ModelError("", f"{name} is not a number that a model may hold")

    try:
        content = json.loads(text, object_pairs_hook=no_duplicates, parse_constant=refuse_constant)
    except json.JSONDecodeError as error:
        sentence = f"line {error.lineno}, column {error.colno}: this is not JSON ({error.msg}); is the file whole?"
        raise ModelError("", sentence) from error
    except ModelError:
        raise
    except ValueError as error:
        raise ModelError("", f"holds a number that cannot be read ({error})") from error
    except RecursionError as error:
        raise ModelError("", "is nested too deeply to be a model") from error
    if not isinstance(content, dict):
        raise ModelError("", "is no JSON object; this is not a model file")
    return content


def _require_keys(path: str, content: dict[str, Any], wanted: set[str]) -> None:
    prefix = f"{path}." if path else ""
    if missing := sorted(wanted - set(content)):
        raise ModelError(prefix + missing[0], "is missing")
    if unknown := sorted(set(content) - wanted):
        raise ModelError(prefix + unknown[0], "is not a key of this format")


def _model(content: dict[str, Any]) -> ThermalModel:
    return ThermalModel(
        model_id=_text("model_id", content["model_id"]),
        kind=_text("kind", content["kind"]),
        channels=tuple(_text("channels", item) for item in _list("channels", content["channels"])),
        sensor_ids=tuple(_integer("sensor_ids", item) for item in _list("sensor_ids", content["sensor_ids"])),
        sensor_names=tuple(_text("sensor_names", item) for item in _list("sensor_names", content["sensor_names"])),
        coefficients_um_per_k=_matrix("coefficients_um_per_k", content["coefficients_um_per_k"]),
        drift_um_per_min=_vector("drift_um_per_min", content["drift_um_per_min"]),
        interval_min=_number("interval_min", content["interval_min"]),
        ridge_k2=_number("ridge_k2", content["ridge_k2"]),
        lowest_increment_k=_vector("lowest_increment_k", content["lowest_increment_k"]),
        highest_increment_k=_vector("highest_increment_k", content["highest_increment_k"]),
        band_um=_vector("band_um", content["band_um"], null_allowed=True),
        training=tuple(_training(i, item) for i, item in enumerate(_list("training", content["training"]))),
        created=_text("created", content["created"]),
        test_vectors=tuple(_test(i, item) for i, item in enumerate(_list("test_vectors", content["test_vectors"]))),
    )


def _training(index: int, content: Any) -> TrainingData:
    path = f"training[{index}]"
    item = _object(path, content, {field.name for field in fields(TrainingData)})
    return TrainingData(
        name=_text(f"{path}.name", item["name"]),
        sha256=_text(f"{path}.sha256", item["sha256"]),
        from_hours=_number(f"{path}.from_hours", item["from_hours"]),
        to_hours=_number(f"{path}.to_hours", item["to_hours"]),
        rows=_integer(f"{path}.rows", item["rows"]),
    )


def _test(index: int, content: Any) -> TestVector:
    path = f"test_vectors[{index}]"
    item = _object(path, content, {field.name for field in fields(TestVector)})
    return TestVector(
        degc=_vector(f"{path}.degc", item["degc"]),
        reference_degc=_vector(f"{path}.reference_degc", item["reference_degc"]),
        elapsed_min=_number(f"{path}.elapsed_min", item["elapsed_min"]),
        thermal_error_um=_vector(f"{path}.thermal_error_um", item["thermal_error_um"]),
    )


def _object(path: str, value: Any, keys: set[str]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ModelError(path, f"must be an object, not {value!r:.40}")
    _require_keys(path, value, keys)
    return value


def _list(key: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ModelError(key, f"must be a list, not {value!r:.40}")
    return value


def _text(key: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ModelError(key, f"must be text, not {value!r:.40}")
    return value


def _integer(key: str, value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise ModelError(key, f"must be a whole number, not {value!r:.40}")
    return value


def _number(key: str, value: Any) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER:
        return float(value)
    raise ModelError(key, f"must be a finite number, not {value!r:.40}")


def _vector(key: str, value: Any, *, null_allowed: bool = False) -> FloatArray:
    items = _list(key, value)
    return np.array(
        [
            np.nan if item is None and null_allowed else _number(f"{key}[{index}]", item)
            for index, item in enumerate(items)
        ],
        dtype=np.float64,
    )


def _matrix(key: str, value: Any) -> FloatArray:
    rows = [_vector(f"{key}[{index}]", row) for index, row in enumerate(_list(key, value))]
    if not rows or len({len(row) for row in rows}) != 1:
        raise ModelError(key, "must be a list of rows of the same length, one per channel")
    return np.vstack(rows)
