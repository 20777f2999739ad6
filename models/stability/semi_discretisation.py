"""Stability of milling by semi-discretisation of higher order.

``q' = A q + depth K_tc B sum of g_T(t) (C q(t) - C q(t - T))`` with the periodic directional matrix g_T of the teeth
that find what was left a time T ago: one T where the pitches are alike. A period is one tooth passing, or as many as
it takes until the pitches come again; a mean tooth passing is divided into m steps. The structure moves exactly
(exp(A h)); within a step the present and the delayed displacements are cubics through four of the points at the steps'
ends, and their products with exp(A (h - s)) and g(s) are integrated by Gauss's rule on pieces that begin and end where
an end of an edge enters or leaves. With a helix g is the mean over the edge up to the depth of cut, and so belongs to a
depth. Process damping acts on the slope of the present displacement's cubic. That cubic goes through the step's own
end, so each step solves one small linear equation. The map over one period acts on the states and as many
displacements as the longest T reaches back; the cut is stable when its spectral radius is below 1.

After Insperger and Stepan (2004), with weights of higher order in the manner of Ding et al. (2010).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.milling import SAME_PITCH_RAD, Cut, edge_matrices
from models.stability.response import ComplexArray, ModalResponse, Mode
from models.stability.state_space import StateSpace, state_space

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
"""Points of the delayed displacement's cubic, around the place where the tooth before was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Teeth:
    """Teeth that find what was left the same time ago."""

    offsets_rad: tuple[float, ...]
    """By which angles they follow the first tooth of the tool [rad]."""
    behind: int
    """That time in steps, rounded up."""
    shift: float
    """What was added by that, in steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemiDiscretisation:
    """A structure and a cut, with the number of steps."""

    structure: StateSpace
    cut: Cut
    steps: int
    """Per mean tooth passing."""
    teeth: tuple[_Teeth, ...]

    @property
    def period(self) -> int:
        """Steps after which everything comes again."""
        return self.steps * self.cut.repeats_after

    @property
    def memory(self) -> int:
        """How many displacements are kept."""
        return max(teeth.behind for teeth in self.teeth) + 1

    @property
    def width_rad(self) -> float:
        """Angle of a step [rad]."""
        return 2.0 * math.pi / (self.cut.teeth * self.steps)


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

    `structure`: state space in feed axes. `cut`: engagement and cutting coefficients. `steps`: steps per tooth passing,
    m.
    """
    if steps < FEWEST_STEPS:
        raise StabilityError(f"{steps} steps per tooth passing are too few; take at least {FEWEST_STEPS}")
    return SemiDiscretisation(structure=structure, cut=cut, steps=steps, teeth=_grouped(cut, steps))


def _grouped(cut: Cut, steps: int) -> tuple[_Teeth, ...]:
    """Return the teeth by the pitch to the tooth before."""
    pitches, width = cut.pitches_rad, 2.0 * math.pi / (cut.teeth * steps)
    groups: list[tuple[float, list[float]]] = []
    offset = 0.0
    for tooth in range(cut.teeth):
        before = pitches[tooth - 1]
        known = next((members for pitch, members in groups if abs(pitch - before) < SAME_PITCH_RAD), None)
        if known is None:
            groups.append((before, known := []))
        known.append(offset)
        offset += pitches[tooth]
    found = []
    for pitch, members in groups:
        behind = math.ceil(pitch / width - 1e-9)
        shift = max(behind - pitch / width, 0.0)
        found.append(_Teeth(offsets_rad=tuple(members), behind=behind, shift=shift))
    return tuple(found)


def transition_matrices(method: SemiDiscretisation, speed_rpm: float, depth_mm: FloatArray) -> FloatArray:
    """Return the maps over one period at one speed.

    Result: shape (n, size, size), size = n_states + memory n_directions, acting on the states and the
    displacements one, two, ... steps ago. Raises StabilityError when speed or a depth is not above 0.

    `method`: from `semi_discretisation`. `speed_rpm`: spindle speed [1/min]. `depth_mm`: axial depths of cut [mm],
    shape (n,).
    """
    state, track = _motion(method, speed_rpm, depth_mm)
    moving, states = method.structure.outputs.shape
    rows = [state]
    for ago in range(1, method.memory + 1):
        number = method.period - ago + 2
        count, size = state.shape[1:]
        rows.append(track[number] if number >= 0 else _unit_displacement(1 - number, states, moving, count, size))
    return np.ascontiguousarray(np.concatenate(rows).transpose(1, 0, 2))


def _motion(method: SemiDiscretisation, speed_rpm: float, depth_mm: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the state after a period, and the displacements from two steps before it on, per initial value.

    Shapes (n_states, n, size) and (n_directions, n, size); numbers beyond all bounds where a depth is.
    """
    depths = np.asarray(depth_mm, dtype=np.float64)
    if not (speed_rpm > 0.0 and bool(np.all(depths > 0.0))):
        raise StabilityError("speed and depth of cut must be above 0")
    step_s = 60.0 / (speed_rpm * method.cut.teeth * method.steps)
    move = method.structure.transition(np.array(step_s))
    present, delayed = _weights(method, speed_rpm, depths)
    gain = (depths * 1e-3 * method.cut.tangential_n_per_m2)[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        return _moved(method, gain, move, present, delayed)


def _moved(
    method: SemiDiscretisation, gain: FloatArray, move: FloatArray, present: FloatArray, delayed: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    structure = method.structure
    moving, states = structure.outputs.shape
    size, count = states + method.memory * moving, len(gain)
    before, ahead = present[..., : 3 * moving], present[..., 3 * moving :]
    solve = structure.outputs @ ahead
    solve = solve[None] if solve.ndim == 3 else solve.transpose(1, 0, 2, 3)
    implicit = _inverse(np.eye(moving) - gain[:, :, None, None] * solve)

    state = np.zeros((states, count, size))
    state[np.arange(states), :, np.arange(states)] = 1.0
    past = [_unit_displacement(number, states, moving, count, size) for number in (2, 1)]
    track = [*past, _applied(structure.outputs, state)]
    for step in range(method.period):
        state = _applied(move, state)
        push = _applied(before[step], np.concatenate(track[step : step + 3]))
        for teeth, weights in zip(method.teeth, delayed, strict=True):
            for place in range(4):
                part = weights[step][..., place * moving : (place + 1) * moving]
                ago = teeth.behind - step - (place - 1)
                if ago > 0:
                    first = states + (ago - 1) * moving
                    push[:, :, first : first + moving] -= (
                        part[:, None, :] if part.ndim == 2 else part.transpose(1, 0, 2)
                    )
                else:
                    push -= _applied(part, track[2 - ago])
        state += gain[None] * push
        displacement = _solved(implicit[:, step], _applied(structure.outputs, state))
        state += gain[None] * _applied(ahead[step], displacement)
        track.append(displacement)
    return state, track


def _weights(
    method: SemiDiscretisation, speed_rpm: float, depths_mm: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the integrals of exp(A (h - s)) B g(s) l(s) of the present and of each delayed displacement [m/N-ish].

    Shape (steps, n_states, 4 n_directions), with a helix (steps, n, n_states, 4 n_directions).
    """
    structure, cut = method.structure, method.cut
    step_s = 60.0 / (speed_rpm * cut.teeth * method.steps)
    lag_rad = cut.lag_rad(depths_mm) if cut.helix_rad else np.zeros(1)
    present: FloatArray = np.zeros(1)
    delayed = []
    for teeth in method.teeth:
        fractions, shares = _quadrature(method, teeth, lag_rad)
        pushed = structure.transition(step_s * (1.0 - fractions)) @ structure.inputs
        pushed = (shares * step_s)[..., None, None] * pushed
        cutting, rubbing = _directional(method, teeth, lag_rad, fractions)
        present = present + _integrals(_cubics(PRESENT, fractions), pushed, cutting)
        if cut.process_damping_n_per_m:
            cutting_speed_m_s = math.pi * cut.diameter_m * speed_rpm / 60.0
            factor = cut.process_damping_n_per_m / (cutting_speed_m_s * cut.tangential_n_per_m2 * step_s)
            present = present - factor * _integrals(_slopes(PRESENT, fractions), pushed, rubbing)
        delayed.append(_integrals(_cubics(DELAYED, fractions + teeth.shift), pushed, cutting))
    if not cut.helix_rad:
        return present[:, 0], [weights[:, 0] for weights in delayed]
    return present, delayed


def _quadrature(method: SemiDiscretisation, teeth: _Teeth, lag_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Gauss's places within a step, 0 to 1, and their weights, shapes (n, n_q): between all ends of edges."""
    cut, width = method.cut, method.width_rad
    ends = np.array([offset + end for offset in teeth.offsets_rad for end in (cut.start_rad, cut.exit_rad)])
    switches = np.unique(np.round(ends / width % 1.0, 9))
    if cut.helix_rad:
        lagging = (switches + lag_rad[:, None] / width) % 1.0
        all_ends = [np.zeros_like(lag_rad)[:, None], np.tile(switches, (len(lag_rad), 1)), lagging]
        edges = np.sort(np.concatenate((*all_ends, np.ones_like(lag_rad)[:, None]), axis=1), axis=1)
    else:
        edges = np.unique(np.concatenate(([0.0], switches, [1.0])))[None]
    places, masses = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    widths = np.diff(edges, axis=1)
    fractions = edges[:, :-1, None] + widths[..., None] * (places + 1.0) / 2.0
    weights = widths[..., None] * masses / 2.0
    return fractions.reshape(len(edges), -1), weights.reshape(len(edges), -1)


def _directional(
    method: SemiDiscretisation, teeth: _Teeth, lag_rad: FloatArray, fractions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the matrices of cutting and rubbing of these teeth, shapes (n, steps, n_q, 2, n_directions)."""
    first = (np.arange(method.period)[:, None] + fractions[:, None, :]) * method.width_rad
    cutting: FloatArray = np.zeros(1)
    rubbing: FloatArray = np.zeros(1)
    for offset in teeth.offsets_rad:
        matrices = edge_matrices(method.cut, first - offset, lag_rad[:, None, None])
        cutting, rubbing = cutting + matrices[0], rubbing + matrices[1]
    moving = list(method.structure.directions)
    return cutting[..., moving], rubbing[..., moving]


def _integrals(shapes: FloatArray, pushed: FloatArray, directional: FloatArray) -> FloatArray:
    """Return the integrals over each step of shapes (n, 4, q) times pushes (n, q, s, f) times matrices (n, m, q, f, d).

    Result: shape (m, n, s, 4 d).
    """
    count, steps, places, into, moving = directional.shape
    states = pushed.shape[2]
    left = (shapes[..., None, None] * pushed[:, None]).transpose(0, 1, 3, 2, 4).reshape(count, 4 * states, -1)
    right = directional.transpose(0, 2, 3, 1, 4).reshape(count, places * into, steps * moving)
    found = (left @ right).reshape(count, 4, states, steps, moving).transpose(3, 0, 2, 1, 4)
    return np.ascontiguousarray(found).reshape(steps, count, states, 4 * moving)


def _cubics(points: tuple[float, ...], at: FloatArray) -> FloatArray:
    """Return the Lagrange cubics of four points at places (n, q), shape (n, 4, q)."""
    values = np.ones((len(at), 4, at.shape[1]))
    for own, here in enumerate(points):
        for other, there in enumerate(points):
            if other != own:
                values[:, own] *= (at - there) / (here - there)
    return values


def _slopes(points: tuple[float, ...], at: FloatArray) -> FloatArray:
    """Return the slopes of the Lagrange cubics of four points at places (n, q), shape (n, 4, q)."""
    values = np.zeros((len(at), 4, at.shape[1]))
    for own, here in enumerate(points):
        others = [there for other, there in enumerate(points) if other != own]
        below = math.prod(here - there for there in others)
        for left_out in range(3):
            first, second = (there for number, there in enumerate(others) if number != left_out)
            values[:, own] += (at - first) * (at - second) / below
    return values


def _unit_displacement(ago: int, states: int, moving: int, count: int, size: int) -> FloatArray:
    displacement = np.zeros((moving, count, size))
    for direction in range(moving):
        displacement[direction, :, states + (ago - 1) * moving + direction] = 1.0
    return displacement


def _applied(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return a matrix, shape (r, c) or one per depth (n_depths, r, c), times vectors, shape (c, n_depths, size)."""
    if matrix.ndim == 3:
        each: FloatArray = (matrix @ vectors.transpose(1, 0, 2)).transpose(1, 0, 2)
        return each
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
    """Return the spectral radius of the map over one period at one speed, per mean tooth passing.

    Below 1 the cut is stable; inf where the vibration grows beyond all numbers. `depth_mm` [mm] has
    the shape (n,), as has the result. Raises StabilityError when speed or a depth is not above 0.
    """
    maps = transition_matrices(method, speed_rpm, depth_mm)
    radius = np.full(len(maps), np.inf)
    countable = np.abs(maps).max(axis=(1, 2)) < LARGEST_ENTRY
    radius[countable] = np.abs(np.linalg.eigvals(maps[countable])).max(axis=1)
    per_passing: FloatArray = radius ** (1.0 / method.cut.repeats_after)
    return per_passing


def swept_radii(
    response: ModalResponse, cut: Cut, feeds_deg: Sequence[float], speeds_rpm: FloatArray, depth_mm: float
) -> FloatArray:
    """Return the spectral radius per mean tooth passing for directions of the feed [deg] and speeds [1/min].

    Result: shape (n_feeds, n_speeds). `depth_mm` [mm]: one depth of cut. Raises StabilityError as `spectral_radius`,
    and where a mode vibrates too often from tooth to tooth.
    """
    depths = np.array([depth_mm])
    found = np.empty((len(feeds_deg), len(speeds_rpm)))
    for feed, feed_deg in enumerate(feeds_deg):
        structure = state_space(response, feed_deg)
        for place, speed_rpm in enumerate(speeds_rpm.tolist()):
            method = semi_discretisation(structure, cut, default_steps(structure, cut, speed_rpm))
            found[feed, place] = spectral_radius(method, speed_rpm, depths)[0]
    return found


def chatter_frequency_hz(method: SemiDiscretisation, speed_rpm: float, depth_mm: float) -> tuple[float, complex]:
    """Return the dominant frequency of the least stable vibration [Hz], and its multiplier over one period.

    A multiplier fixes the frequency up to multiples of the period's own; the dominant one is read from the vibration
    itself over a period. Raises StabilityError as `transition_matrices`.
    """
    depths = np.array([depth_mm])
    multipliers, vectors = np.linalg.eig(transition_matrices(method, speed_rpm, depths)[0])
    largest = int(np.argmax(np.abs(multipliers)))
    multiplier = complex(multipliers[largest])
    _, track = _motion(method, speed_rpm, depths)
    passed = np.arange(method.period) / method.period
    vibration = np.array([displacement[:, 0] @ vectors[:, largest] for displacement in track[2:-1]])
    periodic: ComplexArray = vibration / np.exp(passed * np.log(multiplier))[:, None]
    content = np.sum(np.abs(np.fft.fft(periodic, axis=0)) ** 2, axis=1)
    harmonic = float(np.fft.fftfreq(method.period, 1.0 / method.period)[int(np.argmax(content))])
    turns = float(np.angle(multiplier)) / (2.0 * math.pi) + harmonic
    return abs(turns) * speed_rpm * method.cut.teeth / (60.0 * method.cut.repeats_after), multiplier
