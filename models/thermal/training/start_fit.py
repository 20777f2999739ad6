"""Fits how wrong an estimate may be while the past that its lags stand for is unknown, on training rows."""

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, speed_inputs
from models.thermal.start import StartDeviation
from models.thermal.training.inputs import Inputs

FEWEST_BEGINNINGS = 3
"""With fewer runs it is not known how differently the machine begins."""


def fit_start(inputs: Inputs, rows: BoolArray, coefficients: FloatArray) -> StartDeviation:
    """Return what training says of lags that begin at equilibrium.

    `inputs`, `rows`: training rows. `coefficients`, shape (layout.columns, n_channels): of a model that is linear in
    the features, or nearly so [um per unit of the feature].
    """
    layout, features, sensors = inputs.layout, inputs.features[rows], inputs.layout.sensors
    degc, added = features[:, :sensors], []
    for first in range(sensors, layout.temperature_columns, sensors):
        added.append((features[:, first : first + sensors] - degc) @ coefficients[first : first + sensors])
    if layout.speed_lags_min:
        assert inputs.speed_rpm is not None
        speed = speed_inputs(inputs.speed_rpm[rows], inputs.speed_scale_rpm)
        for first in range(layout.temperature_columns, layout.columns, 2):
            added.append((features[:, first : first + 2] - speed) @ coefficients[first : first + 2])
    table = np.stack(added)  # lag, row, channel
    moments = np.einsum("lnc,mnc->clm", table, table) / max(table.shape[1], 1)
    pattern = degc - degc.mean(axis=1, keepdims=True)
    run = inputs.run[rows]
    begins = np.flatnonzero(np.concatenate([[True], np.diff(run) != 0]))
    rest = pattern[begins].mean(axis=0)
    return StartDeviation(
        covariance_um2=moments.reshape(-1, len(added)),
        signal_um=_signal_um(inputs, rows),
        rest_degc=rest,
        spread_k=float(np.sqrt(np.mean(np.square(pattern - rest)))),
        begun_k=float(np.std(pattern[begins] - rest, axis=1).max()) if len(begins) >= FEWEST_BEGINNINGS else 0.0,
    )


def _signal_um(inputs: Inputs, rows: BoolArray) -> FloatArray:
    """Return the root mean square thermal error between two instants of a run [um], shape (n_channels,)."""
    total, count = np.zeros(len(inputs.channels)), 0
    for run in np.unique(inputs.run[rows]):
        measured = inputs.cleansed_um[rows & (inputs.run == run)]
        total += 2.0 * np.square(measured - measured.mean(axis=0)).sum(axis=0)
        count += len(measured)
    return np.asarray(np.sqrt(total / max(count, 1)))
