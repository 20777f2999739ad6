"""The dissertation's modal sum of one free segment (4-7 to 4-16), as a check of the product, which uses its limit.

Natural modes are written with roots of the characteristic equation, which the exact stiffness does not use:
below the shear cut-off one pair of exponentials that decay from either end (4-7 with the hyperbolic functions
replaced by what does not overflow), above it a second pair of circular functions, where 4-7 does not hold.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from models.dynamics.beam import ComplexArray, Segment
from models.dynamics.chain import Chain
from models.dynamics.modes import natural_frequencies
from models.records import FloatArray

QUADRATURE_POINTS = 600
"""Gauss-Legendre points for the modal mass; enough for a few hundred modes."""


def modal_sum_receptance(
    segment: Segment, frequency_hz: FloatArray, from_m: float, to_m: float, modes: int
) -> ComplexArray:
    """Return the receptance between two points of a free segment as a sum over modes (4-16).

    The error falls with the number of modes like 1/n.

    Parameters
    ----------
    segment
        The segment, without axial load.
    frequency_hz
        Frequencies [Hz], shape (n,).
    from_m, to_m
        Points from the front [m].
    modes
        Number of elastic modes beside the two rigid ones (n_m = modes + 1 in 4-13).

    Returns
    -------
    ndarray
        Shape (n, 2, 2): H, L; N, P of 4-18, [m/N, m/(Nm); rad/N, rad/(Nm)].

    """
    omega_squared = (2.0 * np.pi * frequency_hz) ** 2
    elastic = natural_frequencies(Chain(parts=(segment,)), modes, search_end_hz=np.inf)
    shapes = [*_rigid(segment, from_m, to_m)]
    shapes += [(2.0 * np.pi * f, *_elastic(segment, float(f), np.array([from_m, to_m]))) for f in elastic]
    total = np.zeros((len(frequency_hz), 2, 2), dtype=np.complex128)
    for omega, one, two in shapes:
        damping = 1j * omega**2 * segment.structural_damping
        total += np.outer(two, one) / (omega**2 - omega_squared + damping)[:, None, None]
    return total


def _rigid(segment: Segment, from_m: float, to_m: float) -> list[tuple[float, FloatArray, FloatArray]]:
    """Return the rigid modes (4-12, the rotation with or without rho I L) at the two points."""
    mass = segment.mass_kg_per_m * segment.length_m
    turning = segment.mass_kg_per_m * segment.length_m**3 / 12.0
    if segment.rigid_rotary_inertia == "correct":
        turning += segment.rotary_inertia_kgm * segment.length_m
    slide = np.array([1.0, 0.0]) / np.sqrt(mass)
    half = segment.length_m / 2.0
    turn = [np.array([place - half, 1.0]) / np.sqrt(turning) for place in (from_m, to_m)]
    return [(0.0, slide, slide), (0.0, turn[0], turn[1])]


def _elastic(segment: Segment, natural_hz: float, places_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mass-normalised mode (4-10, 4-11) as (phi, psi) at two places [m]."""
    wave = _Waves(segment, natural_hz)
    length = segment.length_m
    end = np.array([0.0, length])
    # Free ends: no force A_s G (phi' - psi) and no moment E I psi'.
    boundary = np.vstack(
        [
            (wave.at(end, 1) - wave.rotation(end, 0)) * segment.length_m,
            wave.rotation(end, 1) * segment.length_m**2,
        ]
    )
    coefficients = np.linalg.svd(boundary / np.abs(boundary).max(axis=1, keepdims=True))[2][-1]
    points, weights = _quadrature()
    inside, weights = (points + 1.0) * length / 2.0, weights * length / 2.0
    phi, psi = wave.at(inside, 0) @ coefficients, wave.rotation(inside, 0) @ coefficients
    mass = weights @ (segment.mass_kg_per_m * phi**2 + segment.rotary_inertia_kgm * psi**2)
    found = np.column_stack([wave.at(places_m, 0) @ coefficients, wave.rotation(places_m, 0) @ coefficients])
    found /= np.sqrt(mass)
    return found[0], found[1]


@cache
def _quadrature() -> tuple[FloatArray, FloatArray]:
    points, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
    return np.asarray(points), np.asarray(weights)


class _Waves:
    """Four functions that solve 4-1 to 4-5 at one frequency, and their derivatives."""

    def __init__(self, segment: Segment, frequency_hz: float) -> None:
        omega_squared = (2.0 * np.pi * frequency_hz) ** 2
        self.length = segment.length_m
        self.slip = segment.mass_kg_per_m * omega_squared / segment.shear_stiffness_n
        turn = segment.rotary_inertia_kgm * omega_squared / segment.bending_stiffness_nm2
        half = 0.5 * (self.slip + turn)
        bend = segment.mass_kg_per_m * omega_squared / segment.bending_stiffness_nm2
        root = np.sqrt(0.25 * (self.slip - turn) ** 2 + bend)
        self.first = float(np.sqrt(half + root))
        self.second = float(np.sqrt(abs(root - half)))
        self.above_cut_off = bool(half > root)

    def at(self, place_m: FloatArray, order: int) -> npt.NDArray[np.float64]:
        """Return a derivative of the four functions at places, shape (m, 4)."""
        columns = _circular(self.first, place_m, order)
        if self.above_cut_off:
            columns += _circular(self.second, place_m, order)
        else:
            factor = self.second**order
            columns += [
                (-1.0) ** order * factor * np.exp(-self.second * place_m),
                factor * np.exp(-self.second * (self.length - place_m)),
            ]
        return np.column_stack(columns)

    def rotation(self, place_m: FloatArray, order: int) -> npt.NDArray[np.float64]:
        """Return a derivative of psi, from psi' = phi'' + slip phi, shape (m, 4)."""
        squares = np.array([-(self.first**2)] * 2 + [-(self.second**2) if self.above_cut_off else self.second**2] * 2)
        return self.at(place_m, order + 1) * (1.0 + self.slip / squares)


def _circular(number: float, place_m: FloatArray, order: int) -> list[FloatArray]:
    shift = order * np.pi / 2.0
    factor = number**order
    return [factor * np.cos(number * place_m + shift), factor * np.sin(number * place_m + shift)]
