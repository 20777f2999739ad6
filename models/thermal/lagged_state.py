"""The sensors that a model with lags has excluded, told and set again when its state is rebuilt."""

from collections.abc import Mapping
from dataclasses import replace

from models.thermal.lagged import LagState
from models.thermal.lagged_model import LaggedModel
from models.thermal.watch import SensorFault


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
