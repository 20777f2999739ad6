"""The memory of a model with lags as JSON, so that a restart loses nothing."""

import json
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from models.records import FloatArray
from models.thermal.json_fields import parse, read_list, read_number, read_object, read_text
from models.thermal.lagged import LagState
from models.thermal.lagged_model import LaggedModel
from models.thermal.model import ModelError
from models.thermal.watch import SensorFault, WatchState

STATE_VERSION = 2
"""Version of the layout; another one is refused."""


def state_to_json(model: LaggedModel, state: LagState) -> str:
    """Return the state as one line of JSON, with the model that it belongs to."""
    content = {"version": STATE_VERSION, "model_id": model.model_id, "state": _plain(state)}
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, LagState | WatchState | SensorFault):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def state_from_json(model: LaggedModel, text: str, source: str) -> LagState:
    """Return the state that a text holds.

    Parameters
    ----------
    model
        The model that it must belong to.
    text
        As `state_to_json` gave it.
    source
        Where it came from, for messages.

    Raises
    ------
    ModelError
        Naming source and key, when the text is damaged or belongs to another model.

    """
    try:
        content = read_object("", parse(text), {"version", "model_id", "state"})
        if content["version"] != STATE_VERSION:
            raise ModelError("version", f"{content['version']!r} is unknown; rebuild the state from history")
        if (belongs := read_text("model_id", content["model_id"])) != model.model_id:
            raise ModelError("model_id", f"belongs to {belongs}, not to {model.model_id}; rebuild it from history")
        return _state(model, content["state"])
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error


def blamed_signs(model: LaggedModel, state: LagState) -> dict[int, str]:
    """Return the sensors that the watch excludes, by ID, each with the sign by which it was found."""
    if state.watch is None:
        return {}
    return {model.sensor_ids[blame.sensor]: blame.sign for blame in reversed(state.watch.blamed)}


def blamed_again(model: LaggedModel, state: LagState, signs: Mapping[int, str]) -> LagState:
    """Return the state in which these sensors are excluded as well.

    Parameters
    ----------
    model
        The model of the state.
    state
        As it was rebuilt from the history, which does not tell who was excluded.
    signs
        IDs of sensors with the sign by which each was found, from `blamed_signs`; IDs that the model does not
        have are passed over, and so are all of them for a model without a watch.

    """
    if state.watch is None:
        return state
    already = blamed_signs(model, state)
    more = tuple(
        SensorFault(sensor=model.sensor_ids.index(sensor_id), time_min=state.time_min, sign=sign)
        for sensor_id, sign in signs.items()
        if sensor_id in model.sensor_ids and sensor_id not in already
    )
    return replace(state, watch=replace(state.watch, blamed=(*state.watch.blamed, *more)))


def _state(model: LaggedModel, content: Any) -> LagState:
    item = read_object("state", content, {field.name for field in fields(LagState)})
    sensors, layout = model.layout.sensors, model.layout
    missing = read_list("state.missing", item["missing"])
    if len(missing) != sensors or not all(isinstance(value, bool) for value in missing):
        raise ModelError("state.missing", f"must be {sensors} times true or false")
    return LagState(
        time_min=read_number("state.time_min", item["time_min"]),
        degc=_array("state.degc", item["degc"], (sensors,)),
        missing=np.array(missing, dtype=np.bool_),
        known_min=_array("state.known_min", item["known_min"], (sensors,), never=True),
        since_min=_array("state.since_min", item["since_min"], (sensors,)),
        filled_min=_array("state.filled_min", item["filled_min"], (sensors,)),
        speed_rpm=read_number("state.speed_rpm", item["speed_rpm"]),
        speed_known_min=_time("state.speed_known_min", item["speed_known_min"]),
        speed_since_min=read_number("state.speed_since_min", item["speed_since_min"]),
        lagged=_array("state.lagged", item["lagged"], (len(layout.lags_min), sensors)),
        speed_lagged=_array("state.speed_lagged", item["speed_lagged"], (len(layout.speed_lags_min), 2)),
        watch=_watch(model, item["watch"]),
    )


def _watch(model: LaggedModel, content: Any) -> WatchState | None:
    if (content is None) != (model.watch is None):
        raise ModelError("state.watch", "does not fit the model, of which the one has a watch and the other not")
    if model.watch is None:
        return None
    item = read_object("state.watch", content, {field.name for field in fields(WatchState)})
    layout = model.watch.layout
    shapes: dict[str, tuple[int, ...]] = {
        "degc": (layout.sensors,),
        "known_min": (layout.sensors,),
        "flat_since_min": (layout.sensors,),
        "speed": (2,),
        "lagged": (len(layout.lags_min), layout.sensors),
        "speed_lagged": (len(layout.speed_lags_min), 2),
        "fast": (layout.columns,),
        "slow": (layout.columns,),
        "over_min": (layout.sensors,),
    }
    arrays = {key: _array(f"state.watch.{key}", item[key], shape) for key, shape in shapes.items()}
    blamed = [_blame(f"state.watch.blamed[{i}]", b, layout.sensors) for i, b in enumerate(_items(item["blamed"]))]
    return WatchState(time_min=read_number("state.watch.time_min", item["time_min"]), blamed=tuple(blamed), **arrays)


def _items(value: Any) -> list[Any]:
    return read_list("state.watch.blamed", value)


def _blame(path: str, content: Any, sensors: int) -> SensorFault:
    item = read_object(path, content, {field.name for field in fields(SensorFault)})
    sensor = item["sensor"]
    if not isinstance(sensor, int) or isinstance(sensor, bool) or not 0 <= sensor < sensors:
        raise ModelError(f"{path}.sensor", f"{sensor!r:.40} is not the index of a sensor")
    return SensorFault(
        sensor=sensor,
        time_min=read_number(f"{path}.time_min", item["time_min"]),
        sign=read_text(f"{path}.sign", item["sign"]),
    )


def _time(key: str, value: Any) -> float:
    return -math.inf if value is None else read_number(key, value)


def _array(key: str, value: Any, shape: tuple[int, ...], *, never: bool = False) -> FloatArray:
    def numbers(item: Any) -> Any:
        """Return numbers with None as NaN, nested as they are."""
        if isinstance(item, list):
            return [numbers(inner) for inner in item]
        return _time(key, item) if never else read_number(key, item)

    try:
        found = np.array(numbers(read_list(key, value)), dtype=np.float64).reshape(shape)
    except ValueError as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(key, f"does not have the shape {shape} that the model needs") from error
    return found
