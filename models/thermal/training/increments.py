"""The dissertation's model: displacement increments as a linear function of temperature increments.

Equations 3-1 to 3-5 of the dissertation (the sum in 3-2 is squared here, as least squares needs).
Differences are taken over any interval, every row being the end of one, and never across a gap
or from one run into another.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Increments:
    """Differences over one interval."""

    interval_min: float
    """Time between the two ends of a difference [min]."""
    temperature_k: FloatArray
    """Temperature increments [K], shape (n, n_sensors)."""
    displacement_um: FloatArray
    """Displacement increments [um], shape (n, n_channels)."""
    left_out: int
    """Differences that were not used because a value at one end was missing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Factor:
    """Triangular factor of ``[1, dT, dp]``: all that least squares needs of many rows.

    Factors of several runs add up (`combine`), so that leaving one run out costs nothing.
    """

    upper: FloatArray
    """R of the QR decomposition, at most (1 + n_sensors + n_channels) rows."""
    sensors: int
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearFit:
    """Coefficients of equation 3-1."""

    coefficients_um_per_k: FloatArray
    """b_1 .. b_ns per channel [um/K], shape (n_channels, n_sensors)."""
    intercept_um: FloatArray
    """b_0 per channel [um per interval], shape (n_channels,); zeros when it is off."""
    rows: int
    rank: int
    """Numerical rank of the temperature increments."""


def increments(stretches: Iterable[tuple[FloatArray, FloatArray]], interval_min: float, period_s: float) -> Increments:
    """Return all differences over an interval within each stretch.

    Result: in the order of the stretches and of time; perhaps none. Raises DatasetError when the interval is no
    multiple of the sampling.

    `stretches`: temperatures [degC], shape (n, n_sensors), and displacements [um], shape (n, n_channels), of rows that
    follow each other without a gap. `interval_min`: a whole multiple of the time between rows [min]. `period_s`: time
    between rows [s].
    """
    step = rows_per_interval(interval_min, period_s)
    temperature, displacement, left_out = [], [], 0
    for degc, um in stretches:
        d_temperature, d_displacement = degc[step:] - degc[:-step], um[step:] - um[:-step]
        known = np.isfinite(d_temperature).all(axis=1) & np.isfinite(d_displacement).all(axis=1)
        left_out += int((~known).sum())
        temperature.append(d_temperature[known])
        displacement.append(d_displacement[known])
    return Increments(
        interval_min=interval_min,
        temperature_k=np.concatenate(temperature),
        displacement_um=np.concatenate(displacement),
        left_out=left_out,
    )


def rows_per_interval(interval_min: float, period_s: float) -> int:
    """Return how many rows an interval [min] spans; raises DatasetError when it is no whole number of them."""
    step = interval_min * 60.0 / period_s
    if not step > 0.5 or abs(step - round(step)) > 1e-3:
        raise DatasetError(
            f"an interval of {interval_min:g} min is no multiple of the {period_s:g} s between rows; "
            f"choose {period_s / 60.0:g} min or a multiple of it"
        )
    return round(step)


def factorise(data: Increments) -> Factor:
    """Return the triangular factor of the increments, by Householder QR."""
    table = np.hstack([np.ones((len(data.temperature_k), 1)), data.temperature_k, data.displacement_um])
    upper = np.asarray(np.linalg.qr(table, mode="r"), dtype=np.float64)
    return Factor(upper=upper, sensors=data.temperature_k.shape[1], rows=len(table))


def combine(factors: Sequence[Factor]) -> Factor:
    """Return the factor of all rows of several factors together."""
    stacked = np.vstack([factor.upper for factor in factors])
    upper = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)
    return Factor(upper=upper, sensors=factors[0].sensors, rows=sum(factor.rows for factor in factors))


def fit_each(factor: Factor, *, intercept: bool, penalties: Sequence[float]) -> list[LinearFit]:
    """Return the coefficients that minimise ``|dp - b_0 - dT b|^2 + ridge |b|^2`` (3-2, 3-3) for each penalty.

    Solved by singular values, once; the normal equations of 3-3 are never formed. Without a penalty and
    with more sensors than the data can tell apart, the shortest of the solutions is taken. The
    intercept is not penalised.

    Raises DatasetError when ordinary least squares has fewer rows than variables, and ValueError when a penalty is
    negative or not finite.

    `factor`: of the increments, see `factorise`. `intercept`: whether b_0 is fitted; it integrates into a linear drift.
    `penalties`: each not negative [K^2]; 0 is ordinary least squares.
    """
    for ridge in penalties:
        if not (np.isfinite(ridge) and ridge >= 0.0):
            raise ValueError(f"ridge must be finite and not negative, got {ridge}")
    variables = factor.sensors + int(intercept)
    if 0.0 in penalties and factor.rows < variables:
        raise DatasetError(
            f"{factor.rows} increments cannot determine {variables} coefficients by ordinary least squares; "
            "use more recordings, fewer temperatures, or a ridge penalty"
        )
    block = factor.upper[1:] if intercept else factor.upper
    sensors, channels = slice(1, 1 + factor.sensors), slice(1 + factor.sensors, None)
    left, singular, right = np.linalg.svd(block[:, sensors], full_matrices=False)
    cutoff = max(factor.rows, factor.sensors) * np.finfo(np.float64).eps * singular.max(initial=0.0)
    kept = singular > cutoff
    projected = left.T @ block[:, channels]
    fits = []
    for ridge in penalties:
        gains = np.where(kept, singular / np.where(kept, singular**2 + ridge, 1.0), 0.0)
        solution = right.T @ (gains[:, None] * projected)
        offsets = np.zeros(solution.shape[1])
        if intercept:
            offsets = (factor.upper[0, channels] - factor.upper[0, sensors] @ solution) / factor.upper[0, 0]
        fits.append(
            LinearFit(
                coefficients_um_per_k=np.ascontiguousarray(solution.T),
                intercept_um=offsets,
                rows=factor.rows,
                rank=int(kept.sum()),
            )
        )
    return fits


def mean_square_k2(factor: Factor) -> float:
    """Return the mean over the sensors of the summed squared increments [K^2], the scale of a ridge penalty."""
    sensors = factor.upper[:, 1 : 1 + factor.sensors]
    return float(np.square(sensors).sum() / factor.sensors)
