"""What probes would have done on a recording: how fast the model's offset wanders, and what is left with probes."""

import itertools

import numpy as np

from models.records import FloatArray
from models.thermal.bias import BiasFilter, BiasState, full_reset


def wander_um2_per_min(time_min: FloatArray, residual_um: FloatArray, over_min: float) -> FloatArray:
    """Return the variance that a residual gains per minute, from its changes over some time.

    Result of shape (n_channels,): [um^2/min]; zeros when the record is shorter than that.

    `time_min`, shape (n,): increasing times [min]. `residual_um`, shape (n, n_channels): measured minus estimated on
    rows that were not trained on [um], NaN where missing. `over_min`: time over which changes are taken [min]: that
    between two probes.
    """
    later = np.searchsorted(time_min, time_min + over_min)
    begins = np.flatnonzero(later < len(time_min))
    if not len(begins):
        return np.zeros(residual_um.shape[1])
    change = residual_um[later[begins]] - residual_um[begins]
    known = np.isfinite(change)
    total = np.where(known, np.square(change), 0.0).sum(axis=0)
    return np.asarray(total / np.maximum(known.sum(axis=0), 1) / over_min)


def probed_residual_um(
    time_min: FloatArray,
    residual_um: FloatArray,
    probe_min: float | FloatArray,
    bias_filter: BiasFilter | None = None,
    noise_um: FloatArray | None = None,
) -> FloatArray:
    """Return residuals when a probe corrects the offset.

    Result of shape (n, n_channels): a probe holds from the row in which it is taken.

    `time_min`, shape (n,): times [min]; the reference is the first of them. `residual_um`, shape (n, n_channels):
    measured minus estimated without probing [um], NaN where missing. `probe_min`: time between two probes [min]; or
    increasing times of probes since the first row [min], shape (n_probes,). `bias_filter`: how a probe corrects; None
    resets the offset fully. `noise_um`, shape (n, n_channels): error of a probe at each row [um]; None for none.
    """
    bias_filter = bias_filter or full_reset(residual_um.shape[1])
    state = bias_filter.begin(float(time_min[0]))
    corrected = np.empty_like(residual_um)
    elapsed_min = time_min - time_min[0]
    if isinstance(probe_min, float | int):
        probe_min = probe_min * np.arange(1.0, np.floor(elapsed_min[-1] / probe_min + 1e-9) + 1.0)
    probed = np.unique(np.searchsorted(elapsed_min, np.asarray(probe_min) - 1e-9))
    probed = probed[probed < len(time_min)]
    for row, end in itertools.pairwise([-1, *probed.tolist(), len(time_min)]):
        if row >= 0:
            seen_um = residual_um[row] if noise_um is None else residual_um[row] + noise_um[row]
            state = bias_filter.correct(state, float(time_min[row]), seen_um)
        until = slice(max(row, 0), end)
        corrected[until] = residual_um[until] - _offset_um(bias_filter, state, time_min[until])
    return corrected


def _offset_um(bias_filter: BiasFilter, state: BiasState, time_min: FloatArray) -> FloatArray:
    """Return the offset after a probe at later times, until the next one [um], shape (n or 1, n_channels)."""
    if bias_filter.correlation_min is None:
        return state.bias_um[None, :]
    elapsed_min = np.maximum(time_min - state.time_min, 0.0)
    return np.asarray(np.exp(-elapsed_min[:, None] / bias_filter.correlation_min) * state.bias_um)
