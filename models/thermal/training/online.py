"""What the machine would get of a model on rows it has not seen: run as the daemon runs it, weighed by confidence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.control.probing import BiasFilter, full_reset
from models.records import FloatArray
from models.thermal.estimation import UNSURE_UM, Machine, OnlineReference
from models.thermal.family import ThermalModel
from models.thermal.features import BoolArray, IntArray
from models.thermal.training.inputs import Inputs

NO_WEIGHT, FULL_WEIGHT = 0.7, 0.9
"""Confidence from which an estimate counts, and from which it counts whole: the defaults of the output."""
HOLD_MIN = 10.0
"""So long the output stays where it is when the estimate must not be followed [min]; then it goes back to zero."""
SPARE_PERIODS = 2.0
"""The history begins this many samples earlier than the states need."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Followed:
    """A model on some rows as the daemon has it, from a reference at the first of them."""

    estimate_um: FloatArray
    """Thermal error since the reference [um], shape (n, n_channels); NaN while there is none."""
    band_um: FloatArray
    """Half width of its band at every row [um], shape (n, n_channels)."""
    confidence: FloatArray
    """Shape (n,); 0 while there is no estimate."""
    in_domain: BoolArray
    """Whether it may be followed at all, shape (n,)."""


def follow(model: ThermalModel, inputs: Inputs, rows: IntArray) -> Followed:
    """Return what a model gives on some rows of one run, sample by sample, with what history the run has.

    Parameters
    ----------
    model
        Of whatever family; its sensors are among those of the inputs.
    inputs
        The recordings, in the model's time between rows.
    rows : shape (n,)
        Increasing; a reference is set at the first. What the run holds before them is the history.

    """
    online = model.runtime(Machine(components={}))
    places = [inputs.sensor_names.index(name) for name in model.sensor_names]
    degc = np.where(inputs.missing, np.nan, inputs.degc)[:, places]
    speed_rpm = np.full(inputs.rows, np.nan) if inputs.speed_rpm is None else inputs.speed_rpm
    speed_rpm = np.where(inputs.speed_missing, np.nan, speed_rpm)
    time_min, first = inputs.time_min, int(rows[0])
    if online.history_min > 0.0:
        begins = time_min[first] - online.history_min - SPARE_PERIODS * inputs.period_min
        past = (inputs.run[:first] == inputs.run[first]) & (time_min[:first] >= begins)
        online.rebuild((float(time_min[row]), degc[row], float(speed_rpm[row])) for row in np.flatnonzero(past))
    ids = np.asarray(model.sensor_ids)
    absent = np.zeros(len(ids), dtype=np.bool_)
    shape = (len(rows), len(model.channels))
    estimate_um, band_um = np.full(shape, np.nan), np.tile(model.band_um, (len(rows), 1))
    confidence, in_domain = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.bool_)
    for place, row in enumerate(rows):
        now_min = float(time_min[row])
        online.on_sample(now_min, degc[row], float(speed_rpm[row]))
        if place == 0:
            online.set_reference(OnlineReference(time_min=now_min, now_min=now_min, degc=degc[row]))
        found, _ = online.estimate(now_min, degc[row], absent)
        if found is None:
            continue
        absent = np.isin(ids, found.imputed)
        estimate_um[place] = found.thermal_error_um
        confidence[place] = found.confidence if found.imputed_um <= UNSURE_UM else 0.0
        band_um[place], in_domain[place] = model.band_um * found.band_factor, found.in_domain
    return Followed(estimate_um=estimate_um, band_um=band_um, confidence=confidence, in_domain=in_domain)


def compensated_um(
    followed: Followed,
    time_min: FloatArray,
    measured_um: FloatArray,
    probe_min: float | None = None,
    bias_filter: BiasFilter | None = None,
) -> FloatArray:
    """Return what the output would hold against the thermal error since the reference [um], shape (n, n_channels).

    The estimate counts by its confidence; where it must not be followed the output stays where it is for ten minutes
    and then goes back to zero, from where a person switches it on again when the estimate may be followed. A probe
    corrects the output as `models.control.probing` says; what the estimate says since then comes on top.

    Parameters
    ----------
    followed
        The model on these rows.
    time_min : shape (n,)
        Their times [min].
    measured_um : shape (n, n_channels)
        Thermal error since the reference [um], which the probe sees; NaN where missing.
    probe_min
        Time between two probes [min]; None for none.
    bias_filter
        How a probe corrects; None resets the offset fully.

    """
    weight = np.clip((followed.confidence - NO_WEIGHT) / (FULL_WEIGHT - NO_WEIGHT), 0.0, 1.0)
    follows = (followed.confidence >= NO_WEIGHT) & followed.in_domain
    held = np.zeros(measured_um.shape[1])
    bias_filter = bias_filter or full_reset(measured_um.shape[1])
    state = bias_filter.begin(float(time_min[0]))
    found = np.empty_like(measured_um)
    since_min, due_min = float(time_min[0]), np.inf if probe_min is None else float(time_min[0]) + probe_min
    for row, now_min in enumerate(time_min):
        if follows[row]:
            held, since_min = weight[row] * followed.estimate_um[row], float(now_min)
        elif now_min - since_min > HOLD_MIN:
            held = np.zeros_like(held)
        state = bias_filter.advanced(state, float(now_min), held)
        if now_min >= due_min - 1e-9:
            state = bias_filter.correct(state, float(now_min), measured_um[row] - held, held)
            due_min += (probe_min or 0.0) * max(1.0, np.floor((now_min - due_min) / (probe_min or 1.0) + 1.0))
        found[row] = held + state.bias_um
    return found


def following_share(parts: Sequence[Followed]) -> float:
    """Return the share of rows in which the output would follow the estimate; NaN without rows."""
    follows = [(part.confidence >= NO_WEIGHT) & part.in_domain for part in parts]
    return float(np.concatenate(follows).mean()) if follows else float("nan")
