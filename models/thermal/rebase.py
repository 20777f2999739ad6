"""Sets a returning sensor so that it goes on from where it was imputed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.records import FloatArray
from models.thermal.estimation import Estimation
from models.thermal.estimator import LinearEstimator, excluded_sensors
from models.thermal.known_history import ModelState
from models.thermal.watch import MISSING

FADED_K = 0.005
"""A shift of which no more is left is over [K]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateReference:
    """What the thermal error counts from: the states at the reference, and what keeps a return without a step."""

    state: ModelState
    """At the reference; sensors that returned since were set anew in it."""
    rest_um: FloatArray
    """What was left over at the latest return [um], shape (n_channels,): several ridges impute differently."""
    shift_degc: FloatArray
    """What the lags of now were moved by at returns [degC], shape (n_lags, n_sensors); a history does not tell it."""
    rest_since_min: float
    """Time of the latest return [min]; from there on `rest_um` fades with the longest lag, a shift with its own."""
    imputed_um: float = 0.0
    """By how much what they were imputed with until the latest return may have been off, of the worst channel [um]."""


def state_reference(
    estimator: LinearEstimator, state: ModelState, before: StateReference | None = None
) -> StateReference:
    """Return the reference that some states are.

    `estimator`: of the model in use. `state`: at the instant of the reference. `before`: what it counted from until
    then; what is left of its shifts the history tells no more than then.
    """
    left = np.zeros_like(state.lagged) if before is None else _faded_shift(estimator, before, state.time_min)
    shift_degc, nothing_um = np.where(np.abs(left) > FADED_K, left, 0.0), np.zeros(len(estimator.model.channels))
    return StateReference(state=state, rest_um=nothing_um, shift_degc=shift_degc, rest_since_min=state.time_min)


def estimate_since(estimator: LinearEstimator, state: ModelState, reference: StateReference) -> Estimation | None:
    """Return the thermal error since a reference in which sensors may have been set anew.

    Result: as `LinearEstimator.estimate`.

    `estimator`: of the model in use. `reference`: what it counts from.
    """
    found = estimator.estimate(state, reference.state)
    if found is None:
        return None
    if reference.imputed_um > 0.0:
        found = replace(found, imputed_um=float(np.hypot(found.imputed_um, reference.imputed_um)))
    if not reference.rest_um.any():
        return found
    rest_um = _rest_um(estimator, reference, state.time_min)
    return replace(found, thermal_error_um=found.thermal_error_um + rest_um)


def _rest_um(estimator: LinearEstimator, reference: StateReference, time_min: float) -> FloatArray:
    """Return what is left of the rest [um], shape (n_channels,)."""
    longest_min = max(estimator.model.layout.lags_min, default=np.inf)
    faded: FloatArray = reference.rest_um * np.exp(-max(time_min - reference.rest_since_min, 0.0) / longest_min)
    return faded


def returning(
    estimator: LinearEstimator, state: ModelState, reference: StateReference, absent: Sequence[int]
) -> tuple[int, ...]:
    """Return which sensors may count again and must be set anew for it.

    Result: indices of sensors with a value that were away, or were not known at the reference. One that the watch
    excludes for what it said is not among them.

    `estimator`: of the model in use. `reference`: what it counts from. `absent`: indices of the sensors that have been
    imputed until now.
    """
    then = reference.state
    back = then.missing | (state.since_min > then.known_min)
    back[list(absent)] = True
    faults = () if state.watch is None else state.watch.faults
    back[[fault.sensor for fault in faults if fault.sign == MISSING]] = True
    back &= ~state.missing
    back[[fault.sensor for fault in faults if fault.sign != MISSING]] = False
    return tuple(int(index) for index in np.flatnonzero(back))


def rebased(
    estimator: LinearEstimator, state: ModelState, reference: StateReference, returned: Sequence[int]
) -> tuple[ModelState, StateReference] | None:
    """Return the states and the reference with which returned sensors count on from what they were imputed with.

    Their temperatures and lags at the reference are set so that both have gone on since as all others let it be
    expected; their lags of now begin where the others let them be expected. The thermal error does not move; what
    these sensors say from then on counts.

    None when no other sensor is left to impute from.

    `estimator`: of the model in use. `reference`: what it counts from. `returned`: indices from `returning`.
    """
    hidden = state.missing.copy()
    hidden[list(returned)] = True
    before = estimate_since(estimator, replace(state, missing=hidden), reference)
    if before is None:
        return None
    begun = estimator.begun(estimator.reinitialised(state, returned), returned)
    then = _set_anew(estimator, replace(begun, missing=hidden), reference.state, returned)
    after = estimator.estimate(begun, then)
    assert after is not None, "more sensors count now than before"
    return begun, StateReference(
        state=then,
        rest_um=before.thermal_error_um - after.thermal_error_um,
        shift_degc=_faded_shift(estimator, reference, state.time_min) + (begun.lagged - state.lagged),
        rest_since_min=state.time_min,
        imputed_um=before.imputed_um,
    )


def resumed(
    estimator: LinearEstimator,
    state: ModelState,
    reference: StateReference,
    columns: Mapping[int, Sequence[float]],
    *,
    told: bool = True,
) -> tuple[ModelState, StateReference]:
    """Return the states and the reference after a restart, with what sensors that had returned before count from.

    Result: as if nobody had been away.

    `estimator`: of the model in use. `state`: of now, rebuilt from the history. `reference`: rebuilt from the history,
    with rest and shifts as they were kept. `columns`: by index of the sensor: its temperature [degC] at the reference,
    and its lags in turn [degC]. `told`: the lags of now are as the history tells, and not as they were moved since.
    """
    watched = estimator.reinitialised(state, sorted(columns))
    lagged = state.lagged + _faded_shift(estimator, reference, state.time_min) * told
    then = _with_columns(reference.state, columns, state.time_min)
    return replace(watched, lagged=lagged), replace(reference, state=then)


def _faded_shift(estimator: LinearEstimator, reference: StateReference, time_min: float) -> FloatArray:
    constants_min = np.array(estimator.model.layout.lags_min)[:, None]
    elapsed_min = max(time_min - reference.rest_since_min, 0.0)
    faded: FloatArray = reference.shift_degc * np.exp(-elapsed_min / constants_min)
    return faded


def _set_anew(estimator: LinearEstimator, hidden: ModelState, then: ModelState, returned: Sequence[int]) -> ModelState:
    """Return the states at the reference with the columns of returned sensors set anew."""
    count = estimator.model.layout.sensors
    now = estimator.features(hidden)
    without = excluded_sensors(hidden, then)
    change = estimator.left_out.imputed(now - estimator.features(then), without)
    columns = (now - change)[: estimator.model.layout.temperature_columns].reshape(-1, count)
    return _with_columns(then, {sensor: columns[:, sensor].tolist() for sensor in returned}, hidden.time_min)


def _with_columns(then: ModelState, columns: Mapping[int, Sequence[float]], time_min: float) -> ModelState:
    """Return the states at a reference with temperature and lags of some sensors set anew, which count so from now."""
    degc, lagged, missing, known_min = then.degc.copy(), then.lagged.copy(), then.missing.copy(), then.known_min.copy()
    for sensor, (temperature, *lags) in columns.items():
        degc[sensor], lagged[:, sensor] = temperature, lags
        missing[sensor], known_min[sensor] = False, time_min
    return replace(then, degc=degc, lagged=lagged, missing=missing, known_min=known_min)
