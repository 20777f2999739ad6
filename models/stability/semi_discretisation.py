"""Stability of milling by semi-discretisation of higher order.

``q' = A q + depth K_tc B g(t) (C q(t) - C q(t - T_a))`` with the periodic directional matrix g. One
tooth passing T_a is divided into m steps. The structure moves exactly (exp(A h)); within a step the
present and the delayed displacement are cubics through four of the points at the steps' ends, and
their products with exp(A (h - s)) and g(s) are integrated by Gauss's rule on pieces that begin and
end where a tooth enters or leaves. The cubic of the present displacement goes through the step's
own end, so each step solves one small linear equation. The map over one tooth passing acts on the states and
the last m + 1 displacements; the cut is stable when its spectral radius is below 1.

After Insperger and Stepan (2004), with weights of higher order in the manner of Ding et al. (2010).
"""

import math
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.milling import Cut, directional_matrix
from models.stability.response import ComplexArray, Mode
from models.stability.state_space import StateSpace

FEWEST_STEPS = 8
DEFAULT_STEPS = 40
STEPS_PER_CYCLE = 7
"""At least this many steps in one period of the highest mode."""
MOST_STEPS = 400
FEWEST_PER_CYCLE = 3.5
"""Fewer steps in a period do not follow the vibration: what comes out is no spectral radius."""
FINE_PER_CYCLE, FINE_STEPS, MOST_FINE_STEPS = 10, 200, 2000
"""Of a single point: converged to 1e-3 in spectral radius."""
FAINT = 0.05
LARGEST_ENTRY = 1e100
"""A map with a larger entry has no eigenvalues that a computer can tell."""
GAUSS_POINTS = 4
PRESENT = (-2.0, -1.0, 0.0, 1.0)
"""Points of the present displacement's cubic, in steps from the step's beginning."""
DELAYED = (-1.0, 0.0, 1.0, 2.0)
"""Points of the delayed displacement's cubic, one tooth passing earlier."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemiDiscretisation:
    """A structure and a cut, with everything about the steps that does not depend on the speed."""

    structure: StateSpace
    cut: Cut
    steps: int
    fractions: FloatArray
    """Places of the quadrature within a step, 0 to 1, shape (n_q,)."""
    weights: FloatArray
    """Their weights, shape (n_q,), sum 1."""
    directional: FloatArray
    """g at step and place, only the directions that move, shape (steps, n_q, 2, n_directions)."""


def default_steps(structure: StateSpace, cut: Cut, speed_rpm: float) -> int:
    """Return a number of steps that resolves every mode that counts at a speed [1/min].

    The structure moves exactly whatever the step; only displacements are interpolated. So a mode
    whose peak is below `FAINT` of the highest peak needs no steps of its own. Raises StabilityError
    where even `MOST_STEPS` do not resolve them.
    """
    return _steps(structure, cut, speed_rpm, DEFAULT_STEPS, STEPS_PER_CYCLE, MOST_STEPS)


def fine_steps(structure: StateSpace, cut: Cut, speed_rpm: float) -> int:
    """Return a number of steps for a single spectral radius at a speed [1/min]; raises as `default_steps`."""
    return _steps(structure, cut, speed_rpm, FINE_STEPS, FINE_PER_CYCLE, MOST_FINE_STEPS)


def periods_per_passing(structure: StateSpace, cut: Cut, speed_rpm: float) -> float:
    """Return how many periods of the highest mode that counts fit into a tooth passing at a speed [1/min]."""
    return _highest_hz(structure) * 60.0 / (cut.teeth * speed_rpm)


def _highest_hz(structure: StateSpace) -> float:
    peaks = [_peak_m_per_n(mode) for mode in structure.modes]
    return max(
        mode.frequency_hz for mode, peak in zip(structure.modes, peaks, strict=True) if peak >= FAINT * max(peaks)
    )


def _steps(structure: StateSpace, cut: Cut, speed_rpm: float, fewest: int, per_cycle: float, most: int) -> int:
    cycles = periods_per_passing(structure, cut, speed_rpm)
    if cycles * FEWEST_PER_CYCLE > most:
        slowest_rpm = speed_rpm * cycles * FEWEST_PER_CYCLE / most
        raise StabilityError(
            f"at {speed_rpm:g} 1/min the mode at {_highest_hz(structure):.0f} Hz vibrates {cycles:.4g} times from "
            f"tooth to tooth, more than the {most} steps of the semi-discretisation follow; take speeds from "
            f"{slowest_rpm:.3g} 1/min up, or --method zoa"
        )
    return min(max(fewest, math.ceil(per_cycle * cycles)), most)


def _peak_m_per_n(mode: Mode) -> float:
    gain = math.hypot(mode.displacement_gain_per_kg, mode.velocity_gain_s_per_kg * mode.angular_rad_s)
    return gain / (2.0 * mode.damping_ratio * mode.angular_rad_s**2)


def semi_discretisation(structure: StateSpace, cut: Cut, steps: int = DEFAULT_STEPS) -> SemiDiscretisation:
    """Prepare the steps of one tooth passing.

    Result: to be used at any speed and depth. Raises StabilityError with too few steps.

    Parameters
    ----------
    structure
        State space in feed axes.
    cut
        Engagement and cutting coefficients.
    steps
        Steps per tooth passing, m.

    """
    if steps < FEWEST_STEPS:
        raise StabilityError(f"{steps} steps per tooth passing are too few; take at least {FEWEST_STEPS}")
    pitch = 2.0 * math.pi / cut.teeth
    switches = [(angle % pitch) / pitch * steps % 1.0 for angle in (cut.start_rad, cut.exit_rad)]
    edges = np.unique(np.round([0.0, *switches, 1.0], 12))
    places, masses = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    widths = np.diff(edges)
    fractions = (edges[:-1, None] + widths[:, None] * (places + 1.0) / 2.0).reshape(-1)
    weights = (widths[:, None] * masses / 2.0).reshape(-1)
    angles = (np.arange(steps)[:, None] + fractions) * (pitch / steps)
    directional = directional_matrix(cut, angles.reshape(-1)).reshape(steps, len(fractions), 2, 2)
    return SemiDiscretisation(
        structure=structure,
        cut=cut,
        steps=steps,
        fractions=fractions,
        weights=weights,
        directional=directional[..., list(structure.directions)],
    )


def transition_matrices(method: SemiDiscretisation, speed_rpm: float, depth_mm: FloatArray) -> FloatArray:
    """Return the maps over one tooth passing at one speed.

    Result: shape (n, size, size), size = n_states + (steps + 1) n_directions, acting on the states and the
    displacements one, two, ... steps + 1 steps ago. Raises StabilityError when speed or a depth is not above 0.

    Parameters
    ----------
    method
        From `semi_discretisation`.
    speed_rpm
        Spindle speed [1/min].
    depth_mm
        Axial depths of cut [mm], shape (n,).

    """
    depths = np.asarray(depth_mm, dtype=np.float64)
    if not (speed_rpm > 0.0 and bool(np.all(depths > 0.0))):
        raise StabilityError("speed and depth of cut must be above 0")
    structure = method.structure
    step_s = 60.0 / (speed_rpm * method.cut.teeth * method.steps)
    move = structure.transition(np.array(step_s))
    present, delayed = _weights(method, step_s)
    gain = (depths * 1e-3 * method.cut.tangential_n_per_m2)[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        return _maps(method, gain, move, present, delayed)


def _maps(
    method: SemiDiscretisation, gain: FloatArray, move: FloatArray, present: FloatArray, delayed: FloatArray
) -> FloatArray:
    """Return the maps; numbers beyond all bounds where a depth is."""
    structure, steps = method.structure, method.steps
    moving, states = structure.outputs.shape
    size, count = states + (steps + 1) * moving, len(gain)
    implicit = _inverse(np.eye(moving) - gain[:, :, None, None] * (structure.outputs @ present[:, 3]))

    state = np.zeros((states, count, size))
    state[np.arange(states), :, np.arange(states)] = 1.0
    past = [_unit_displacement(number, states, moving, count, size) for number in (2, 1)]
    track = [*past, _applied(structure.outputs, state)]
    for step in range(steps):
        state = _applied(move, state)
        recent = np.concatenate(track[step : step + 3])
        push = _applied(np.concatenate(list(present[step, :3]), axis=1), recent)
        for place in range(4):
            ago = steps - step - (place - 1)
            if ago > 0:
                first = states + (ago - 1) * moving
                push[:, :, first : first + moving] -= delayed[step, place][:, None, :]
            else:
                push -= _applied(delayed[step, place], track[2 - ago])
        state += gain[None] * push
        displacement = _solved(implicit[:, step], _applied(structure.outputs, state))
        state += gain[None] * _applied(present[step, 3], displacement)
        track.append(displacement)
    rows = [state, *(track[steps + 2 - ago] for ago in range(1, steps + 2))]
    return np.ascontiguousarray(np.concatenate(rows).transpose(1, 0, 2))


def _weights(method: SemiDiscretisation, step_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the integrals of exp(A (h - s)) B g(s) l(s), shape (steps, 4, n_states, n_directions) [m/N-ish]."""
    structure = method.structure
    rest = structure.transition(step_s * (1.0 - method.fractions)) @ structure.inputs
    weighted = (method.weights * step_s)[:, None, None] * rest
    cubics = np.stack([_cubics(PRESENT, method.fractions), _cubics(DELAYED, method.fractions)])
    combined = np.einsum("clq,qsf,mqfd->cmlsd", cubics, weighted, method.directional, optimize=True)
    return combined[0], combined[1]


def _cubics(points: tuple[float, ...], at: FloatArray) -> FloatArray:
    """Return the Lagrange cubics of four points, shape (4, len(at))."""
    values = np.ones((4, len(at)))
    for own, here in enumerate(points):
        for other, there in enumerate(points):
            if other != own:
                values[own] *= (at - there) / (here - there)
    return values


def _unit_displacement(ago: int, states: int, moving: int, count: int, size: int) -> FloatArray:
    displacement = np.zeros((moving, count, size))
    for direction in range(moving):
        displacement[direction, :, states + (ago - 1) * moving + direction] = 1.0
    return displacement


def _applied(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return a matrix, shape (r, c), times vectors, shape (c, n_depths, size)."""
    applied: FloatArray = (matrix @ vectors.reshape(len(vectors), -1)).reshape(len(matrix), *vectors.shape[1:])
    return applied


def _inverse(matrices: FloatArray) -> FloatArray:
    if matrices.shape[-1] == 1:
        return 1.0 / matrices
    countable = np.asarray(np.isfinite(matrices).all(axis=(-2, -1), keepdims=True))
    found = np.linalg.inv(np.where(countable, matrices, np.eye(matrices.shape[-1])))
    return np.where(countable, found, np.nan).astype(np.float64)


def _solved(inverse: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return inverses, shape (n_depths, d, d), times vectors, shape (d, n_depths, size)."""
    if len(vectors) == 1:
        scaled: FloatArray = inverse[:, 0, 0][None, :, None] * vectors
        return scaled
    solved: FloatArray = np.einsum("nij,jnk->ink", inverse, vectors)
    return solved


def spectral_radius(method: SemiDiscretisation, speed_rpm: float, depth_mm: FloatArray) -> FloatArray:
    """Return the spectral radius of the map over one tooth passing at one speed.

    Below 1 the cut is stable; inf where the vibration grows beyond all numbers. `depth_mm` [mm] has
    the shape (n,), as has the result. Raises StabilityError when speed or a depth is not above 0.
    """
    maps = transition_matrices(method, speed_rpm, depth_mm)
    radius = np.full(len(maps), np.inf)
    countable = np.abs(maps).max(axis=(1, 2)) < LARGEST_ENTRY
    radius[countable] = np.abs(np.linalg.eigvals(maps[countable])).max(axis=1)
    return radius


def chatter_frequency_hz(method: SemiDiscretisation, speed_rpm: float, depth_mm: float) -> tuple[float, complex]:
    """Return the dominant frequency of the least stable vibration [Hz], and its multiplier.

    A multiplier fixes the frequency up to multiples of the tooth-passing frequency; the dominant
    one is read from the vibration itself over the last tooth passing. Raises StabilityError as
    `transition_matrices`.
    """
    matrix = transition_matrices(method, speed_rpm, np.array([depth_mm]))[0]
    multipliers, vectors = np.linalg.eig(matrix)
    largest = int(np.argmax(np.abs(multipliers)))
    multiplier = complex(multipliers[largest])
    moving, states = method.structure.outputs.shape
    backwards = vectors[states:, largest].reshape(-1, moving)[: method.steps]
    passed = -np.arange(1, method.steps + 1) / method.steps
    periodic: ComplexArray = backwards / np.exp(passed * np.log(multiplier))[:, None]
    content = np.sum(np.abs(np.fft.fft(periodic[::-1], axis=0)) ** 2, axis=1)
    harmonic = float(np.fft.fftfreq(method.steps, 1.0 / method.steps)[int(np.argmax(content))])
    turns = float(np.angle(multiplier)) / (2.0 * math.pi) + harmonic
    return abs(turns) * speed_rpm * method.cut.teeth / 60.0, multiplier
