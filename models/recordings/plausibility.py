"""Finds impossible single values of a recording: what a broken wire or a full-scale input writes into its column."""

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

LOWEST_DEGC = -50.0
"""No machine tool is colder."""
HIGHEST_DEGC = 150.0
"""None is hotter; a median above this is no temperature in degC (kelvin start at 253 here)."""
SPIKE_K = 15.0
"""No part goes so far within one row and comes back, within a tenth of it, in another one ..."""
SPIKE_ROWS = 5
"""... so many rows later, or earlier."""
FARTHEST_UM = 5000.0
"""No displacement sensor of a nest reaches so far from where it is most of the time."""
USUAL_SPREAD_UM = 500.0
"""A channel whose values typically lie farther than this from their median is not in micrometres at all; and what lies
apart from the others by more, with nothing between, such as -999, is none of them: what warms passes through."""
ZERO_UM = 5.0
"""Nor is exactly zero, now and then, where every other value is farther from it than this, ..."""
ZERO_STEPS = 10.0
"""... and than so many of the largest steps between those, in the order of their size."""
FEWEST_PROBED = 3
"""So many single values between zeros are those of a probe."""
RISE_START_K = 0.5
"""Where every temperature begins so near to zero, rises since the start were recorded: no workshop is so cold."""
RISES_FROM_DEGC = 20.0
"""Rises since the start are played from here [degC]: a node that sends 0 degC is taken for one that was reset."""
HIGHEST_RPM = 500_000.0
"""No spindle turns faster [1/min]."""

BoolArray = npt.NDArray[np.bool_]


def impossible_temperatures(degc: FloatArray) -> BoolArray:
    """Return where temperatures cannot be.

    Result of shape (n, n_sensors): all False for a sensor of which that holds for half of the values or more: then the
    unit of the column is wrong, or the sensor was never connected.

    `degc`, shape (n, n_sensors): temperatures [degC], NaN where missing.
    """
    wrong = (degc < LOWEST_DEGC) | (degc > HIGHEST_DEGC)
    for rows in range(1, min(SPIKE_ROWS, len(degc) - 2) + 1):
        before, after = degc[: -rows - 1], degc[rows + 1 :]
        within = np.stack([degc[place : place + len(before)] for place in range(1, rows + 1)])
        away = (np.abs(within - before) > SPIKE_K).all(axis=0) & (np.abs(after - before) < 0.1 * SPIKE_K)
        for place in range(1, rows + 1):
            wrong[place : place + len(before)] |= away
    return _of_few(wrong, degc)


def are_rises(degc: FloatArray) -> bool:
    """Return whether temperatures are rises since the start: each begins at zero.

    `degc`, shape (n, n_sensors): temperatures [degC], NaN where missing.
    """
    known = [column[np.isfinite(column)] for column in degc.T]
    return bool(known) and all(len(values) and abs(values[0]) <= RISE_START_K for values in known)


def impossible_displacements(displacements_um: FloatArray) -> BoolArray:
    """Return where displacements lie farther from the others than any sensor reaches, or apart from them.

    Result of shape (n, n_channels): all False for a channel that moves so far as a rule: then its unit is wrong.

    `displacements_um`, shape (n, n_channels): displacements [um], NaN where missing.
    """
    far_um = np.abs(displacements_um - column_medians(displacements_um))
    wrong = _of_few((far_um > FARTHEST_UM) | _apart(displacements_um), far_um) | _between_probes(displacements_um)
    return np.asarray(wrong & (column_medians(far_um) <= USUAL_SPREAD_UM))


def _apart(table: FloatArray) -> BoolArray:
    """Return where values lie apart from those around the median, see `USUAL_SPREAD_UM`, `ZERO_UM`, `ZERO_STEPS`."""
    found = np.zeros(table.shape, dtype=np.bool_)
    for place, column in enumerate(table.T):
        known = np.sort(column[np.isfinite(column)])
        group = np.cumsum(np.diff(known, prepend=known[:1]) > USUAL_SPREAD_UM)
        found[:, place] = np.isin(column, known[group != group[len(group) // 2]]) if len(known) else False
        zeros, others = column == 0.0, known[known != 0.0]
        if zeros.sum() > 1 and len(others) > 1 and not zeros[0]:  # it may have been set to zero where it begins
            least_um = max(ZERO_UM, ZERO_STEPS * float(np.diff(others).max()))
            found[:, place] |= zeros & bool(np.abs(others).min() > least_um)
    return found


def _between_probes(table: FloatArray) -> BoolArray:
    """Return where a column is 0 because nothing was measured: in most rows, and what is not 0 stands alone."""
    zero = table == 0.0
    other = np.pad(np.isfinite(table) & ~zero, ((1, 1), (0, 0)))
    alone = other[1:-1] & ~other[:-2] & ~other[2:]
    probed = (
        (2 * zero.sum(axis=0) > len(table)) & (alone.sum(axis=0) >= FEWEST_PROBED) & (alone == other[1:-1]).all(axis=0)
    )
    return np.asarray(zero & probed)


def impossible_speeds(speed_rpm: FloatArray) -> BoolArray:
    """Return where a spindle speed [1/min] cannot be, shape (n,); all False when that holds for half of them."""
    column = np.abs(speed_rpm)[:, None]
    return _of_few(column > HIGHEST_RPM, column)[:, 0]


def column_medians(table: FloatArray) -> FloatArray:
    """Return the median of the finite values of each column, shape (n_columns,); 0 for a column without any."""
    known = [column[np.isfinite(column)] for column in table.T]
    return np.array([float(np.median(values)) if len(values) else 0.0 for values in known])


def _of_few(wrong: BoolArray, table: FloatArray) -> BoolArray:
    return np.asarray(wrong & (2 * wrong.sum(axis=0) < np.isfinite(table).sum(axis=0)))
