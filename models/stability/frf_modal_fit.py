"""Modes fitted to a measured receptance by vector fitting (rational functions with common poles).

The poles are moved until a rational function of them fits the samples in least squares (Gustavsen
and Semlyen, 1999); poles that grow are mirrored. The order is raised until the fit follows the
samples, or stops getting better. Poles outside the band stand for everything that lies there. A pole
that takes no more off the residual than it would off noise goes again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.response import ComplexArray, Mode, check_finite, modal_receptance

MOST_PAIRS = 12
ROUNDS = 30
GOOD_FIT = 1e-3
"""A relative residual below which the order is not raised further."""
WORTHWHILE = 0.9
"""A higher order must bring the residual below this share."""
PATIENCE = 3
"""So many higher orders in a row that bring nothing end the search."""
POOR_FIT = 0.25
"""A relative residual above which the fit is refused."""
CLEAR_FIT = 0.05
LEAST_DAMPING = 1e-5
EXACT_FIT = 1e-6
"""A relative residual that no further round need lower; checked after these rounds, because poles that nothing needs
wander on."""
CHECKS = (3, 6, 12)
DEPENDENT = 1e-12
"""A column that adds less than this share to the others is no information of its own."""
WARM_ROUNDS = 4
"""Rounds from the modes of a fit before, when the response has changed a little."""
WORSE = 1.2
"""A fit from the one before counts while its residual stays below this share of that one's."""
SUPPORT = 3.0
"""A mode must take this many times more off the squared residual than one that follows noise takes."""
CLEAR_LINES, CLEAR_SUPPORT = 4.0, 2.0
"""A resonance narrower than so many lines must take half of the squared residual: noise on two lines looks like one."""
WIDTH_IN_LINES = 0.5
"""A resonance narrower than this many lines of the FRF is noise on one of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModalFit:
    """Modes whose sum follows a receptance."""

    modes: tuple[Mode, ...]
    relative_residual: float
    """Root mean square of the difference over that of the samples."""
    warnings: tuple[str, ...] = ()
    searched_residual: float | None = None
    """Of the search whose modes these are, moved since; None: they come from a search."""


def fit_modes(
    frequency_hz: FloatArray, receptance: ComplexArray, pairs: int | None = None, start: ModalFit | None = None
) -> ModalFit:
    """Fit modes to a receptance.

    Result: modes in ascending frequency and how well they fit. Raises StabilityError with too few samples, with one
    that is not finite, or when no sum of up to twelve modes follows them.

    `frequency_hz`: ascending [Hz], shape (n,). `receptance`: displacement per force [m/N], shape (n,), complex.
    `pairs`: number of pole pairs to begin with; None finds it. `start`: fit of a response that was nearly the same: its
    modes are moved to this one. Where that fits worse than before, everything begins anew.
    """
    if len(frequency_hz) < 16:
        raise StabilityError(
            f"an FRF of {len(frequency_hz)} frequencies is too short for a modal fit; give at least 16"
        )
    check_finite(frequency_hz, receptance)
    if start is not None and (moved := _moved_fit(frequency_hz, receptance, start)) is not None:
        return moved
    most = min(MOST_PAIRS, len(frequency_hz) // 4)
    best: ModalFit | None = None
    in_vain = 0
    for count in [pairs] if pairs is not None else range(1, most + 1):
        modes = _vector_fit(frequency_hz, receptance, _even_poles(frequency_hz, count))
        residual = _residual(modes, frequency_hz, receptance)
        if best is None or residual < WORTHWHILE * best.relative_residual:
            best, in_vain = ModalFit(modes=modes, relative_residual=residual), 0
        else:
            in_vain += 1
        if best.relative_residual < GOOD_FIT or in_vain == PATIENCE:
            break
    assert best is not None
    best = _supported(best, frequency_hz, receptance)
    if best.relative_residual > POOR_FIT:
        raise StabilityError(
            f"no sum of up to {most} modes follows this FRF (residual {best.relative_residual:.0%}); "
            "check its unit and coherence, or give modes instead of frf"
        )
    if best.relative_residual > CLEAR_FIT:
        text = f"the modes follow the FRF with a residual of {best.relative_residual:.1%} only"
        return ModalFit(modes=best.modes, relative_residual=best.relative_residual, warnings=(text,))
    return best


def _even_poles(frequency_hz: FloatArray, pairs: int) -> ComplexArray:
    """Return lightly damped poles spread over the band, in shares of its highest frequency."""
    low = max(frequency_hz[0], 0.02 * frequency_hz[-1])
    start = np.linspace(low, frequency_hz[-1], pairs + 2)[1:-1] / frequency_hz[-1]
    return np.asarray(start * (-0.01 + 1j), dtype=np.complex128)


def _poles(modes: Sequence[Mode], frequency_hz: FloatArray) -> ComplexArray:
    """Return the poles of modes, in shares of the highest frequency."""
    return np.array(
        [
            mode.frequency_hz
            / frequency_hz[-1]
            * complex(-mode.damping_ratio, np.sqrt(max(1.0 - mode.damping_ratio**2, 1e-6)))
            for mode in modes
        ]
    )


def _moved_fit(frequency_hz: FloatArray, receptance: ComplexArray, start: ModalFit) -> ModalFit | None:
    """Return the fit from the poles of another one, None where it is worse than that."""
    modes = _vector_fit(frequency_hz, receptance, _poles(start.modes, frequency_hz), WARM_ROUNDS)
    residual = _residual(modes, frequency_hz, receptance)
    searched = start.relative_residual if start.searched_residual is None else start.searched_residual
    if len(modes) < len(start.modes) or not residual <= max(GOOD_FIT, WORSE * searched):
        return None
    return ModalFit(modes=modes, relative_residual=residual, warnings=start.warnings, searched_residual=searched)


def _supported(fit: ModalFit, frequency_hz: FloatArray, receptance: ComplexArray) -> ModalFit:
    """Return the fit without the modes that nothing in the samples asks for.

    One more mode always lowers the residual; on noise alone by some four of its degrees of freedom, and by the best of
    as many places as there are frequencies. Where few of them hold most of the residual, these count.
    """
    scale = 2.0 * np.pi * float(frequency_hz[-1])
    laplace: ComplexArray = (2j * np.pi * frequency_hz / scale).astype(np.complex128)
    weight = _weight(receptance)
    modes = list(fit.modes)
    while len(modes) > 1:
        least = EXACT_FIT**2 * float(np.sum(np.abs(weight * receptance) ** 2))
        squares = _squares(modes, frequency_hz, receptance, weight)
        now = float(squares.sum())
        count = 2.0 * now**2 / max(float(np.sum(squares**2)), 1e-300)
        limit = 1.0 + SUPPORT * (np.log(len(squares)) + 2.0) / max(min(count, len(squares)), 1.0)
        poles = _poles(modes, frequency_hz)
        shorter = [
            _residues(laplace, receptance, np.delete(poles, place), weight, scale) for place in range(len(modes))
        ]
        narrow = ~_wide(poles, frequency_hz, CLEAR_LINES)
        limits = np.maximum(np.where(narrow, max(limit, CLEAR_SUPPORT), limit) * now, least)
        left = np.array([float(_squares(each, frequency_hz, receptance, weight).sum()) for each in shorter])
        best = int(np.argmin(left / limits))
        if left[best] > limits[best]:
            break
        modes = list(shorter[best])
    if len(modes) == len(fit.modes):
        return fit
    return ModalFit(modes=tuple(modes), relative_residual=_residual(modes, frequency_hz, receptance))


def _weight(receptance: ComplexArray) -> FloatArray:
    weight: FloatArray = 1.0 / np.sqrt(np.abs(receptance) + 1e-3 * np.abs(receptance).max())
    return weight


def _squares(
    modes: Sequence[Mode], frequency_hz: FloatArray, receptance: ComplexArray, weight: FloatArray
) -> FloatArray:
    """Return the weighted squared residual at each frequency."""
    squares: FloatArray = np.abs(weight * (modal_receptance(modes, frequency_hz) - receptance)) ** 2
    return squares


def _vector_fit(
    frequency_hz: FloatArray, receptance: ComplexArray, poles: ComplexArray, rounds: int = ROUNDS
) -> tuple[Mode, ...]:
    scale = 2.0 * np.pi * float(frequency_hz[-1])
    laplace: ComplexArray = (2j * np.pi * frequency_hz / scale).astype(np.complex128)
    weight = _weight(receptance)
    target = (receptance / np.abs(receptance).max()).astype(np.complex128)
    for number in range(1, rounds + 1):
        moved = _moved(laplace, target, poles, weight)
        done = len(moved) == len(poles) and bool(np.abs(moved - poles).max() < 1e-10)
        poles = moved
        if done:
            break
        if number in CHECKS:
            modes = _residues(laplace, receptance, _wide_enough(poles, frequency_hz), weight, scale)
            if _residual(modes, frequency_hz, receptance) < EXACT_FIT:
                return modes
    return _residues(laplace, receptance, _wide_enough(poles, frequency_hz), weight, scale)


def _residual(modes: Sequence[Mode], frequency_hz: FloatArray, receptance: ComplexArray) -> float:
    difference = modal_receptance(modes, frequency_hz) - receptance
    return float(np.linalg.norm(difference) / np.linalg.norm(receptance))


def _wide_enough(poles: ComplexArray, frequency_hz: FloatArray) -> ComplexArray:
    """Return the poles that more than one line of the FRF sees, all where none is."""
    wide = _wide(poles, frequency_hz, WIDTH_IN_LINES)
    return poles[wide] if bool(np.any(wide)) else poles


def _wide(poles: ComplexArray, frequency_hz: FloatArray, lines: float) -> np.ndarray:
    """Return which resonances are wider than so many lines of the FRF."""
    line = np.interp(np.abs(poles.imag), frequency_hz / frequency_hz[-1], np.gradient(frequency_hz) / frequency_hz[-1])
    return np.asarray(2.0 * np.abs(poles.real) > lines * line)


def _basis(laplace: ComplexArray, quadratics: Sequence[tuple[float, float]]) -> ComplexArray:
    """Return 1 and s over each ``s^2 + c1 s + c0``, shape (n, 2 pairs)."""
    columns = []
    for c1, c0 in quadratics:
        denominator = laplace**2 + c1 * laplace + c0
        columns += [1.0 / denominator, laplace / denominator]
    return np.stack(columns, axis=1)


def _quadratics(poles: ComplexArray) -> list[tuple[float, float]]:
    return [(-2.0 * float(pole.real), float(abs(pole)) ** 2) for pole in poles]


def _real_rows(matrix: ComplexArray | FloatArray) -> FloatArray:
    return np.concatenate((matrix.real, matrix.imag))


def _least_squares(system: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution by orthogonal triangularisation, and by singular values where columns depend on others."""
    size = np.linalg.norm(system, axis=0)
    scaled = system / size
    triangle = np.asarray(np.linalg.qr(np.column_stack((scaled, right)), mode="r"))
    upper, projected = triangle[: len(size), : len(size)], triangle[: len(size), -1]
    diagonal = np.abs(np.diag(upper))
    if len(upper) < len(size) or diagonal.min() <= DEPENDENT * diagonal.max():
        solution: FloatArray = np.linalg.lstsq(scaled, right, rcond=None)[0] / size
        return solution
    return np.asarray(np.linalg.solve(upper, projected) / size, dtype=np.float64)


def _moved(laplace: ComplexArray, target: ComplexArray, poles: ComplexArray, weight: FloatArray) -> ComplexArray:
    """Return the zeros of the fitted sigma: the next poles, upper half plane, mirrored to decay."""
    quadratics = _quadratics(poles)
    basis = _basis(laplace, quadratics)
    system = _real_rows(weight[:, None] * np.hstack((basis, -target[:, None] * basis)))
    right = _real_rows(weight * target)
    solution = _least_squares(system, right)
    sigma = solution[basis.shape[1] :]
    denominators = [np.array([1.0, c1, c0]) for c1, c0 in quadratics]
    polynomial = _product(denominators)
    for number in range(len(quadratics)):
        others = _product(denominators[:number] + denominators[number + 1 :])
        share = np.convolve(sigma[2 * number : 2 * number + 2][::-1], others)
        polynomial[-len(share) :] += share
    return _upper(np.roots(polynomial).astype(np.complex128))


def _product(polynomials: Sequence[FloatArray]) -> FloatArray:
    product: FloatArray = np.array([1.0])
    for polynomial in polynomials:
        product = np.convolve(product, polynomial)
    return product


def _upper(roots: ComplexArray) -> ComplexArray:
    """Return one decaying pole per pair; two real roots become a pair of the same size, well damped."""
    upper = [complex(root) for root in roots if root.imag > 1e-12]
    real = sorted(abs(float(root.real)) for root in roots if abs(root.imag) <= 1e-12)
    for first, second in zip(real[::2], real[1::2], strict=False):
        size = max(np.sqrt(first * second), 1e-6)
        upper.append(complex(-0.7 * size, 0.7 * size))
    decaying = [complex(-max(abs(pole.real), LEAST_DAMPING * abs(pole)), pole.imag) for pole in upper]
    return np.array(sorted(decaying, key=abs), dtype=np.complex128)


def _residues(
    laplace: ComplexArray, receptance: ComplexArray, poles: ComplexArray, weight: FloatArray, scale: float
) -> tuple[Mode, ...]:
    basis = _basis(laplace, _quadratics(poles))
    system = _real_rows(weight[:, None] * basis)
    gains = _least_squares(system, _real_rows(weight * receptance))
    return tuple(
        Mode(
            frequency_hz=float(abs(pole)) * scale / (2.0 * np.pi),
            damping_ratio=float(-pole.real / abs(pole)),
            displacement_gain_per_kg=float(gains[2 * number]) * scale**2,
            velocity_gain_s_per_kg=float(gains[2 * number + 1]) * scale,
        )
        for number, pole in enumerate(poles)
    )
