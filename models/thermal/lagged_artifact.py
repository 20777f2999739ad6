"""The file of a model with lags: versioned JSON with a checksum and test vectors, never a pickle."""

from dataclasses import fields
from typing import Any

import numpy as np

from models.records import FloatArray
from models.thermal.artifact import FORMAT_VERSION, OPTIONAL, model_from_json, read_axis_positions, read_training
from models.thermal.json_fields import (
    null_for_nan,
    packed,
    parse,
    read_integer,
    read_list,
    read_matrix,
    read_number,
    read_object,
    read_packed,
    read_text,
    read_vector,
    text_of_file,
    whole_content,
)
from models.thermal.lagged_model import FeatureTestVector, LaggedModel
from models.thermal.layout import Design, Layout, RidgeSolution
from models.thermal.model import ModelError, ThermalModel, TrainingData
from models.thermal.watch import SensorWatch

LAGGED_FORMAT_VERSION = 2
"""Version of this file's layout; `models.thermal.artifact` reads version 1, the models without states."""
RECORDS = (LaggedModel, FeatureTestVector, TrainingData, Layout, Design, SensorWatch, RidgeSolution)


def lagged_model_to_json(model: LaggedModel) -> str:
    """Return the model as the text of its file, one key per line; numbers are exact."""
    content = {"format_version": LAGGED_FORMAT_VERSION, **_plain(model)}
    return text_of_file({key: value for key, value in content.items() if value or key not in OPTIONAL})


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return null_for_nan(value.tolist())
    if isinstance(value, RidgeSolution):
        plain = {key: _plain(getattr(value, key)) for key in ("gain", "weights", "remaining")}
        return {"design": _plain(value.design), **plain, "directions": packed(value.directions)}
    if isinstance(value, RECORDS):
        plain = {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
        return {**plain, "precision": packed(value.precision)} if isinstance(value, SensorWatch) else plain
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def any_model_from_json(text: str, source: str) -> ThermalModel | LaggedModel:
    """Return the model that a file holds, with states or without, by its format version; raises ModelError."""
    try:
        version = parse(text).get("format_version")
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error
    if version in (FORMAT_VERSION, LAGGED_FORMAT_VERSION) and not isinstance(version, bool):
        return model_from_json(text, source) if version == FORMAT_VERSION else lagged_model_from_json(text, source)
    raise ModelError(
        "format_version",
        f"{version!r} is unknown; this version of Toolpoint reads {FORMAT_VERSION} and {LAGGED_FORMAT_VERSION}",
        source,
    )


def lagged_model_from_json(text: str, source: str) -> LaggedModel:
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
        return _model(
            whole_content(text, LAGGED_FORMAT_VERSION, {field.name for field in fields(LaggedModel)}, OPTIONAL)
        )
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error


def _model(content: dict[str, Any]) -> LaggedModel:
    layout = _layout("layout", content["layout"])
    names = {key: read_list(key, content[key]) for key in ("channels", "sensor_ids", "sensor_names")}
    return LaggedModel(
        model_id=read_text("model_id", content["model_id"]),
        kind=read_text("kind", content["kind"]),
        channels=tuple(read_text("channels", item) for item in names["channels"]),
        sensor_ids=tuple(read_integer("sensor_ids", item) for item in names["sensor_ids"]),
        sensor_names=tuple(read_text("sensor_names", item) for item in names["sensor_names"]),
        layout=layout,
        speed_scale_rpm=read_number("speed_scale_rpm", content["speed_scale_rpm"]),
        period_min=read_number("period_min", content["period_min"]),
        ridges=tuple(_ridge(i, item, layout) for i, item in enumerate(read_list("ridges", content["ridges"]))),
        centre=read_vector("centre", content["centre"]),
        leverage_limit=read_number("leverage_limit", content["leverage_limit"]),
        lowest_degc=read_vector("lowest_degc", content["lowest_degc"]),
        highest_degc=read_vector("highest_degc", content["highest_degc"]),
        highest_speed_rpm=read_number("highest_speed_rpm", content["highest_speed_rpm"]),
        band_um=read_vector("band_um", content["band_um"], null_allowed=True),
        watch=None if content["watch"] is None else _watch(content["watch"]),
        hyper_parameters=_hyper_parameters(content["hyper_parameters"]),
        refused=None if content["refused"] is None else read_text("refused", content["refused"]),
        training=tuple(read_training(i, item) for i, item in enumerate(read_list("training", content["training"]))),
        created=read_text("created", content["created"]),
        axis_positions=read_axis_positions(content),
        test_vectors=tuple(_test(i, v) for i, v in enumerate(read_list("test_vectors", content["test_vectors"]))),
    )


def _layout(path: str, content: Any) -> Layout:
    item = read_object(path, content, {field.name for field in fields(Layout)})
    return Layout(
        sensors=read_integer(f"{path}.sensors", item["sensors"]),
        lags_min=tuple(read_vector(f"{path}.lags_min", item["lags_min"]).tolist()),
        speed_lags_min=tuple(read_vector(f"{path}.speed_lags_min", item["speed_lags_min"]).tolist()),
    )


def _ridge(index: int, content: Any, layout: Layout) -> RidgeSolution:
    path = f"ridges[{index}]"
    item = read_object(path, content, {"design", "gain", "weights", "directions", "remaining"})
    design = read_object(f"{path}.design", item["design"], {"departures", "correlation_min"})
    if not isinstance(design["departures"], bool):
        raise ModelError(f"{path}.design.departures", "must be true or false")
    correlation = design["correlation_min"]
    return RidgeSolution(
        layout=layout,
        design=Design(
            departures=design["departures"],
            correlation_min=None if correlation is None else read_number(f"{path}.design.correlation_min", correlation),
        ),
        gain=read_vector(f"{path}.gain", item["gain"]),
        weights=read_matrix(f"{path}.weights", item["weights"]),
        directions=read_packed(f"{path}.directions", item["directions"]),
        remaining=read_vector(f"{path}.remaining", item["remaining"]),
    )


def _watch(content: Any) -> SensorWatch:
    item = read_object("watch", content, {field.name for field in fields(SensorWatch)})

    def vector(key: str) -> FloatArray:
        """Return a vector of the watch."""
        return read_vector(f"watch.{key}", item[key])

    return SensorWatch(
        layout=_layout("watch.layout", item["layout"]),
        centre=vector("centre"),
        gain=vector("gain"),
        precision=read_packed("watch.precision", item["precision"]),
        threshold_k=vector("threshold_k"),
        slew_k_per_min=vector("slew_k_per_min"),
        flat_min=vector("flat_min"),
        speed_scale_rpm=read_number("watch.speed_scale_rpm", item["speed_scale_rpm"]),
    )


def _hyper_parameters(content: Any) -> dict[str, float | int | str | bool | list[float]]:
    if not isinstance(content, dict):
        raise ModelError("hyper_parameters", f"must be an object, not {content!r:.40}")
    for key, value in content.items():
        plain = isinstance(value, float | int | str | bool)
        if not plain and not (isinstance(value, list) and all(isinstance(item, float | int) for item in value)):
            raise ModelError(f"hyper_parameters.{key}", "must be a number, a text or a list of numbers")
    return dict(content)


def _test(index: int, content: Any) -> FeatureTestVector:
    path = f"test_vectors[{index}]"
    item = read_object(path, content, {field.name for field in fields(FeatureTestVector)})
    return FeatureTestVector(**{key: read_vector(f"{path}.{key}", value) for key, value in item.items()})
