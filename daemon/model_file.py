"""Reads a thermal model's file and says why it does not fit."""

from collections.abc import Iterable
from pathlib import Path

from daemon.estimation.contract import AnyThermalModel
from models.thermal.artifact import model_to_json
from models.thermal.lagged_artifact import any_model_from_json, lagged_model_to_json
from models.thermal.lagged_model import LaggedModel
from models.thermal.model import ModelError


def read_model(path: Path, sensor_ids: Iterable[int], channels: Iterable[str]) -> tuple[AnyThermalModel | None, str]:
    """Return the model, or why it cannot serve a machine with these sensors that needs these channels."""
    try:
        content = path.read_bytes()
    except OSError as error:
        return None, f"{path}: the thermal model cannot be read ({error.strerror})"
    return model_from_text(content, str(path), sensor_ids, channels)


def model_from_text(
    content: bytes, source: str, sensor_ids: Iterable[int], channels: Iterable[str]
) -> tuple[AnyThermalModel | None, str]:
    """Return the model that a file's bytes hold, or why it cannot serve such a machine."""
    try:
        model = any_model_from_json(content.decode("utf-8"), source=source)
    except UnicodeDecodeError as error:
        return None, f"{source}: this is no thermal model: byte {error.start} is not UTF-8 text"
    except ModelError as error:
        return None, str(error)
    if model.axis_positions:
        names = ", ".join(model.axis_positions[:8])
        return None, (
            f"{source}: the model needs axis positions ({names}), which are not read while the machine runs; "
            "take axis_positions out of the map and train it again"
        )
    if foreign := sorted(set(model.sensor_ids) - set(sensor_ids)):
        return None, f"{source}: the model needs sensors that this machine does not have: {foreign[:10]}"
    if lacking := sorted(set(channels) - set(model.channels)):
        return None, f"{source}: the model has no channel {', '.join(lacking)}; it has {', '.join(model.channels)}"
    return model, ""


def model_text(model: AnyThermalModel) -> str:
    """Return the content of a model's file."""
    return lagged_model_to_json(model) if isinstance(model, LaggedModel) else model_to_json(model)
