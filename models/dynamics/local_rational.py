"""Measured responses smoothed by a rational function over a few neighbouring lines, with one denominator for all.

The local rational method (McKelvey and Guerin, 2012; Pintelon and Schoukens): around each line every response is a
quadratic over a common quadratic, which holds at resonances and between them alike, where a polynomial alone does
not. The coefficients follow from one linear least-squares problem per line.
"""

from dataclasses import dataclass

import numpy as np

from models.dynamics.beam import ComplexArray
from models.records import FloatArray

NUMERATOR, DENOMINATOR = 2, 2
"""Degrees of the polynomials."""
HALF_WIDTHS = (6, 10, 16, 24)
"""Lines on each side that may be taken."""
ALIKE = 1e-13
"""Where responses hardly change, fewer coefficients do: combinations below this share of the largest are left out."""
GROWTH = 1.1
"""A wider window whose residual is larger by this factor bends the response."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoothed:
    """Responses without most of their noise."""

    responses: ComplexArray
    """Shape (m, n), in the units of what was measured."""
    noise: float
    """Noise of what was measured, beside its median size in each window (root mean square)."""
    deviation: FloatArray
    """Standard deviation of each value by its least squares, as the responses, shape (m, n); alike within a window."""
    half_width: int
    """Lines on each side; 0: there were too few lines, nothing was smoothed."""


def smoothed(responses: ComplexArray) -> Smoothed:
    """Return responses smoothed over the widest window that does not bend them.

    `responses`: responses of one structure at evenly spaced lines, shape (m, n), finite and not zero.
    """
    best = None
    for half_width in HALF_WIDTHS:
        if 2 * half_width + 1 > responses.shape[1]:
            break
        wider = _local(responses, half_width)
        if best is not None and wider.noise > GROWTH * best.noise:
            break
        best = wider
    if best is None:
        unknown = np.full(responses.shape, np.nan)
        return Smoothed(responses=responses, noise=np.nan, deviation=unknown, half_width=0)
    return best


def _coefficients(count: int) -> int:
    return count * (NUMERATOR + 1) + DENOMINATOR


def _local(responses: ComplexArray, half_width: int) -> Smoothed:
    """Return the responses smoothed over a window; their noise is what the least squares leave."""
    count, lines = responses.shape
    size = 2 * half_width + 1
    window = np.clip(np.arange(lines), half_width, lines - 1 - half_width)[:, None] + np.arange(
        -half_width, size - half_width
    )
    x = (window - np.arange(lines)[:, None]) / half_width
    taken = responses[:, window]
    taken = taken / np.median(np.abs(taken), axis=2, keepdims=True)
    design = np.zeros((lines, count * size, _coefficients(count)), dtype=np.complex128)
    for number in range(count):
        rows = slice(number * size, (number + 1) * size)
        for power in range(NUMERATOR + 1):
            design[:, rows, number * (NUMERATOR + 1) + power] = x**power
        for power in range(1, DENOMINATOR + 1):
            design[:, rows, count * (NUMERATOR + 1) + power - 1] = -taken[number] * x**power
    values = np.concatenate(list(taken), axis=1)
    adjoint = np.conj(np.swapaxes(design, 1, 2))
    inverse = np.linalg.pinv(adjoint @ design, rcond=ALIKE, hermitian=True)
    solved = inverse @ (adjoint @ values[..., None])
    left = values - (design @ solved)[..., 0]
    noise = float(np.sqrt(np.mean(np.abs(left) ** 2) * values.shape[1] / (values.shape[1] - _coefficients(count))))
    constants = np.arange(count) * (NUMERATOR + 1)
    scale = np.median(np.abs(responses[:, window]), axis=2)
    spread = np.sqrt(np.abs(np.diagonal(inverse, axis1=1, axis2=2)[:, constants])).T
    return Smoothed(
        responses=np.asarray(solved[:, constants, 0].T * scale, dtype=np.complex128),
        noise=noise,
        deviation=np.asarray(noise * spread * scale, dtype=np.float64),
        half_width=half_width,
    )
