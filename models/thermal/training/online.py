"""What the machine would get of a model on rows it has not seen: run as the daemon runs it, weighed by confidence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.records import FloatArray
from models.thermal.bias import BiasFilter, full_reset
from models.thermal.estimation import UNSURE_UM, Machine, OnlineReference
from models.thermal.family import ThermalModel
from models.thermal.features import BoolArray, IntArray
from models.thermal.positions import beyond_positions, trust_in_positions
from models.thermal.training.inputs import Inputs

NO_WEIGHT, FULL_WEIGHT = 0.7, 0.9
"""Confidence from which an estimate counts, and from which it counts whole: the defaults of the output."""
HOLD_MIN = 10.0
"""So long the output stays where it is when the estimate must not be followed [min]; then it goes back to zero."""
SPARE_PERIODS = 2.0
"""The history begins this many samples earlier than the states need."""
USUAL_MEAN_S = 60.0
"""A model without lags is given means over this, as they are without a word in the configuration [s]."""
LATE_PERIODS = 1.5
"""Between two rows that lie farther apart nothing is known of where the axes stood."""


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
    unsure: BoolArray
    """Whether what is imputed for excluded sensors may be off by more than the output follows, shape (n,)."""
    speed_unread: BoolArray
    """Whether lags of a speed that was not known between rows may have missed more than the output follows, (n,)."""
    position_known: BoolArray | None = None
    """Whether every axis position that the model needs is known, shape (n,); None where it needs none."""
    late_min: float = 0.0
    """So much later than what its inputs say is it applied, which are means [min]: half of the time they are over."""


def follow(model: ThermalModel, inputs: Inputs, rows: IntArray) -> Followed:
    """Return what a model gives on some rows of one run, sample by sample, with what history the run has.

    Axis positions are taken as they are recorded: means over a row, as the daemon makes them over `mean_s`. Where one
    is missing nothing is followed, nor in the row after it, whose mean is not whole, nor at all where it is missing at
    the reference. A machine also drops what lies outside its travel; of that a recording says nothing.

    `model`: of whatever family; its sensors are among those of the inputs. `inputs`: the recordings, in the model's
    time between rows. `rows`, shape (n,): increasing; a reference is set at the first. What the run holds before them
    is the history.
    """
    online = model.runtime(Machine(components={}))
    places = [inputs.sensor_names.index(name) for name in model.sensor_names]
    degc = np.where(inputs.missing, np.nan, inputs.degc)[:, places]
    speed_rpm = np.full(inputs.rows, np.nan) if inputs.speed_rpm is None else inputs.speed_rpm
    speed_rpm = np.where(inputs.speed_missing, np.nan, speed_rpm)
    time_min, first = inputs.time_min, int(rows[0])
    begins = time_min[first] - online.memory_min - SPARE_PERIODS * inputs.period_min
    past = np.flatnonzero((inputs.run[:first] == inputs.run[first]) & (time_min[:first] >= begins))
    if online.memory_min > 0.0:
        online.rebuild((float(time_min[row]), degc[row], float(speed_rpm[row])) for row in past)
    ids = np.asarray(model.sensor_ids)
    absent = np.zeros(len(ids), dtype=np.bool_)
    shape = (len(rows), len(model.channels))
    estimate_um, band_um = np.full(shape, np.nan), np.tile(model.band_um, (len(rows), 1))
    confidence, in_domain, unsure, unread = np.zeros(len(rows)), *np.zeros((3, len(rows)), dtype=np.bool_)
    axes = len(ids) - len(model.axis_positions)
    trust, position_known = _positions(model, degc[rows, axes:], time_min[rows], inputs.period_min)
    for place, row in enumerate(rows):
        now_min = float(time_min[row])
        online.on_sample(now_min, degc[row], float(speed_rpm[row]))
        if place == 0:
            online.set_reference(OnlineReference(time_min=now_min, now_min=now_min, degc=degc[row]))
        found, _ = online.estimate(now_min, degc[row], absent)
        if found is None:
            continue
        imputed = np.isin(ids, found.imputed)
        absent[:axes], position_known[place] = imputed[:axes], position_known[place] and not imputed[axes:].any()
        estimate_um[place] = found.thermal_error_um
        unsure[place] = found.imputed_um > UNSURE_UM
        unread[place] = found.speed_unread_um > UNSURE_UM
        confidence[place] = 0.0 if unsure[place] or unread[place] else found.confidence * trust[place]
        band_um[place], in_domain[place] = model.band_um * found.band_factor, found.in_domain
    return Followed(
        estimate_um=estimate_um,
        band_um=band_um,
        confidence=np.where(position_known, confidence, 0.0),
        in_domain=in_domain,
        unsure=unsure,
        speed_unread=unread,
        position_known=position_known if model.axis_positions else None,
        late_min=(model.period_s or USUAL_MEAN_S) / 120.0,
    )


def _positions(
    model: ThermalModel, mm: FloatArray, time_min: FloatArray, period_min: float
) -> tuple[FloatArray, BoolArray]:
    """Return how far the model may be followed for where the axes stood in each row, 0..1, and if that is known."""
    if not model.axis_positions:
        return np.ones(len(mm)), np.ones(len(mm), dtype=np.bool_)
    there: BoolArray = np.asarray(np.isfinite(mm).all(axis=1))
    before = np.append(True, there[:-1] & (np.diff(time_min) <= LATE_PERIODS * period_min))
    known = there & before & there[0]
    trust = np.zeros(len(mm))
    trust[known] = trust_in_positions(beyond_positions(model, mm[known], mm[0]))
    return trust, known


def compensated_um(
    followed: Followed,
    time_min: FloatArray,
    measured_um: FloatArray,
    probe_min: float | None = None,
    bias_filter: BiasFilter | None = None,
) -> FloatArray:
    """Return what the output would hold against the thermal error since the reference [um], shape (n, n_channels).

    The estimate counts by its confidence, and is late: its inputs are means that end now. Where it must not be followed
    the output stays where it is for ten minutes and then goes back to zero, from where a person switches it on again
    when the estimate may be followed. A probe corrects the output as `models.thermal.bias` says; what the estimate says
    since then comes on top.

    `followed`: the model on these rows. `time_min`, shape (n,): their times [min]. `measured_um`, shape (n,
    n_channels): thermal error since the reference [um], which the probe sees; NaN where missing. `probe_min`: time
    between two probes [min]; None for none. `bias_filter`: how a probe corrects; None resets the offset fully.
    """
    weight = np.clip((followed.confidence - NO_WEIGHT) / (FULL_WEIGHT - NO_WEIGHT), 0.0, 1.0)
    follows = (followed.confidence >= NO_WEIGHT) & followed.in_domain
    share = np.minimum(followed.late_min / np.diff(time_min), 1.0)[:, None]
    estimate_um = followed.estimate_um.copy()
    estimate_um[1:] -= np.nan_to_num(share * np.diff(followed.estimate_um, axis=0))  # where there was none before, none
    held = np.zeros(measured_um.shape[1])
    bias_filter = bias_filter or full_reset(measured_um.shape[1])
    state = bias_filter.begin(float(time_min[0]))
    found = np.empty_like(measured_um)
    since_min, due_min = float(time_min[0]), np.inf if probe_min is None else float(time_min[0]) + probe_min
    for row, now_min in enumerate(time_min):
        if follows[row]:
            held, since_min = weight[row] * estimate_um[row], float(now_min)
        elif now_min - since_min > HOLD_MIN:
            held = np.zeros_like(held)
        state = bias_filter.advanced(state, float(now_min), held)
        if now_min >= due_min - 1e-9:
            state = bias_filter.correct(state, float(now_min), measured_um[row] - held, held)
            due_min += (probe_min or 0.0) * max(1.0, np.floor((now_min - due_min) / (probe_min or 1.0) + 1.0))
        found[row] = held + state.bias_um
    return found


def position_share(parts: Sequence[Followed]) -> float | None:
    """Return the share of rows in which the axis positions that the model needs are known; None: it needs none."""
    known = [part.position_known for part in parts if part.position_known is not None]
    return float(np.concatenate(known).mean()) if known else None


def held_shares(parts: Sequence[Followed]) -> dict[str, float]:
    """Return the shares of rows in which the output would hold for what is imputed, and for speed that was not read."""
    shares = {
        "imputed_unsure": np.concatenate([part.unsure for part in parts]).mean() if parts else 0.0,
        "speed_unread": np.concatenate([part.speed_unread for part in parts]).mean() if parts else 0.0,
    }
    return {name: float(share) for name, share in shares.items() if share > 0.0}


def following_share(parts: Sequence[Followed]) -> float:
    """Return the share of rows in which the output would follow the estimate; NaN without rows."""
    follows = [(part.confidence >= NO_WEIGHT) & part.in_domain for part in parts]
    return float(np.concatenate(follows).mean()) if follows else float("nan")
