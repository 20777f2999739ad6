"""Stability of milling by collocation in the engaged arc, for many feed directions and speeds at once.

What a tooth leaves at an angle is what the next one finds there, so the state of the cut is that of the structure's
modes and the surface at Gauss's nodes of the engaged arc. The structure moves exactly by its impulse responses. They
belong to the machine's axes: every feed direction shares them. The force between the nodes is the polynomial through
them, and its products with the impulse responses are integrated exactly, by weights that depend on their number alone.
The map over one tooth passing is squared again and again; its norm bounds the spectral radius from above, its trace
from below.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.milling import Cut
from models.stability.response import ModalResponse, Mode, feed_rotation

SPARE_NODES = 9
"""So many nodes more than a polynomial needs to follow the fastest mode over a piece of the arc."""
MOST_NODES = 160
"""More nodes take too long."""
MOST_SQUARINGS = 18
"""The bounds then lie within a ten-thousandth of the spectral radius."""
STIFFEST_CUT = 3.0
"""In a cut the structure may swing so many times faster than its fastest mode."""
LARGEST_ENTRY = 1e100
NARROWEST = 1e-9
"""Pieces of the arc below this share of a tooth passing are none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Piece:
    """A part of one tooth passing in which the same teeth cut, in shares of the passing."""

    begin: float
    width: float
    teeth: tuple[int, ...]
    """Which teeth cut, by how many pitches they are ahead."""


def radius_bounds(
    response: ModalResponse,
    cut: Cut,
    *,
    feeds_deg: Sequence[float],
    speeds_rpm: Sequence[float],
    depth_mm: float,
    limits: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return a lower and an upper bound of the spectral radius per tooth passing.

    Result: two arrays of the shape (n_feeds, n_speeds); inf where the vibration grows beyond all numbers. Raises
    StabilityError when nothing can move, a speed or depth is not above 0, or a mode vibrates too often from tooth to
    tooth.

    Parameters
    ----------
    response
        Modes of the structure, in machine axes.
    cut
        Engagement and cutting coefficients.
    feeds_deg
        Directions of the feed against X [deg].
    speeds_rpm
        Spindle speeds [1/min].
    depth_mm
        Axial depth of cut [mm].
    limits
        What the radius is compared with at each speed: where every bound lies on one side of it, they are not
        narrowed further. None: within a thousandth.

    """
    speeds = np.asarray(speeds_rpm, dtype=np.float64)
    if not (bool(np.all(speeds > 0.0)) and depth_mm > 0.0):
        raise StabilityError("speed and depth of cut must be above 0")
    maps = passing_maps(response, cut, feeds_deg=feeds_deg, speeds_rpm=speeds, depth_mm=depth_mm)
    return _bounds(maps, limits)


def spectral_radii(
    response: ModalResponse, cut: Cut, *, feed_deg: float, speed_rpm: float, depths_mm: FloatArray
) -> FloatArray:
    """Return the spectral radius per tooth passing at each depth of cut; below 1 the cut is stable.

    Result: shape (n,); inf where the vibration grows beyond all numbers. Raises StabilityError when nothing can move,
    the speed or a depth is not above 0, or a mode vibrates too often from tooth to tooth.

    `response`: modes of the structure, in machine axes. `cut`: engagement and cutting coefficients. `feed_deg`:
    direction of the feed against X [deg]. `speed_rpm`: spindle speed [1/min]. `depths_mm`: axial depths of cut [mm],
    shape (n,).
    """
    depths = np.asarray(depths_mm, dtype=np.float64)
    if not (speed_rpm > 0.0 and bool(np.all(depths > 0.0))):
        raise StabilityError("speed and depth of cut must be above 0")
    speeds = np.array([speed_rpm])
    with np.errstate(over="ignore", invalid="ignore"):
        maps = passing_maps(response, cut, feeds_deg=[feed_deg], speeds_rpm=speeds, depth_mm=depths)[:, 0, 0]
    radii = np.full(len(maps), np.inf)
    largest = np.abs(maps).max(axis=(1, 2))
    countable = np.isfinite(largest) & (largest < LARGEST_ENTRY)
    radii[countable] = np.abs(np.linalg.eigvals(maps[countable])).max(axis=1)
    return radii


def follows(response: ModalResponse, cut: Cut, speed_rpm: float, depth_mm: float) -> bool:
    """Return whether the nodes follow the vibration from tooth to tooth, at a speed [1/min] and a depth of cut [mm].

    They are as many as the fastest mode needs: neither may that be more than `MOST_NODES`, nor may the cut be so stiff
    that the structure swings much faster in it. Only straight edges at even pitches without process damping
    are followed.
    """
    if cut.beyond_straight:
        return False
    modes = [mode for _, _, entry in response.entries() for mode in entry]
    stiffness_n_per_m = depth_mm * 1e-3 * cut.tangential_n_per_m2
    softest_per_kg = max((abs(mode.displacement_gain_per_kg) for mode in modes), default=0.0)
    fastest = max((mode.angular_rad_s for mode in modes), default=0.0)
    if stiffness_n_per_m * softest_per_kg > (STIFFEST_CUT * fastest) ** 2:
        return False
    try:
        for piece in _pieces(cut) if modes else ():
            _node_count(modes, cut, piece, np.array([speed_rpm]))
    except StabilityError:
        return False
    return True


def passing_maps(
    response: ModalResponse,
    cut: Cut,
    *,
    feeds_deg: Sequence[float],
    speeds_rpm: FloatArray,
    depth_mm: float | FloatArray,
) -> FloatArray:
    """Return the maps of modes and surface over one tooth passing, as above.

    Result: shape (n_feeds, n_speeds, size, size), behind one of the depths where these are an array.
    """
    if cut.beyond_straight:
        raise StabilityError(
            f"the collocation in the engaged arc knows no {', '.join(cut.beyond_straight)}; take semi-discretisation"
        )
    entries = [(out, into, mode) for out, into, modes in response.entries() for mode in modes]
    if not entries:
        raise StabilityError("both directions are rigid, so no cut can chatter; give modes or an FRF for one")
    modes = [mode for _, _, mode in entries]
    passing_s: FloatArray = 60.0 / (speeds_rpm * cut.teeth)
    pieces = _pieces(cut)
    counts = [_node_count(modes, cut, piece, speeds_rpm) for piece in pieces]
    to_nodes, to_end, kernel = _impulse_responses(entries, pieces, counts, passing_s)
    end = _motion(modes, passing_s)

    nodes, places, angles = _surface(cut, pieces, counts)
    normal, force = _tooth_vectors(angles, cut.radial_ratio, feeds_deg)
    gain = np.asarray(depth_mm)[..., None, None, None, None] * 1e-3 * cut.tangential_n_per_m2
    outs = np.array([out for out, _, _ in entries])
    intos = np.array([into for _, into, _ in entries])

    size, states = len(nodes), 2 * len(entries)
    pushed = np.zeros((len(feeds_deg), len(speeds_rpm), size, size))
    for (out, into), block in kernel.items():
        pushed += (normal[:, out, :, None] * force[:, into, None, :])[:, None] * block[:, places[:, None], places]
    pushed = gain * pushed
    solve = np.linalg.inv(np.eye(size) - pushed)
    seen = normal[:, outs].repeat(2, axis=1).transpose(0, 2, 1)[:, None] * to_nodes[:, places]
    acts = gain * force[:, intos].repeat(2, axis=1)[:, None] * to_end[:, :, places]

    seen = np.broadcast_to(seen, (*pushed.shape[:-2], *seen.shape[-2:]))
    surface = solve @ np.concatenate((seen, -pushed), axis=-1)
    chip = surface.copy()
    chip[..., states:] -= np.eye(size)
    moved = acts @ chip
    for number in range(len(entries)):
        place = slice(2 * number, 2 * number + 2)
        moved[..., place, place] += end[number]
    return np.concatenate((moved, surface), axis=-2)


def _pieces(cut: Cut) -> list[_Piece]:
    """Return the pieces of a tooth passing between which a tooth enters or leaves."""
    pitch = 2.0 * math.pi / cut.teeth
    first, last = cut.start_rad / pitch, cut.exit_rad / pitch
    edges = sorted({0.0, first % 1.0, last % 1.0, 1.0})
    found = []
    for begin, end in itertools.pairwise(edges):
        middle = (begin + end) / 2.0
        ahead = tuple(n for n in range(cut.teeth) if first < n + middle < last)
        if ahead and end - begin > NARROWEST:
            found.append(_Piece(begin=begin, width=end - begin, teeth=ahead))
    return found


def _node_count(modes: Sequence[Mode], cut: Cut, piece: _Piece, speeds_rpm: FloatArray) -> int:
    """Return how many nodes follow the fastest mode over a piece."""
    slowest_rpm = float(speeds_rpm.min())
    fastest_hz = max(mode.frequency_hz for mode in modes)
    count = math.ceil(math.pi * fastest_hz * piece.width * 60.0 / (slowest_rpm * cut.teeth)) + SPARE_NODES
    if count * len(piece.teeth) > MOST_NODES:
        raise StabilityError(
            f"at {slowest_rpm:g} 1/min the mode at {fastest_hz:.0f} Hz vibrates too often from tooth to tooth for a "
            "verdict; take higher speeds"
        )
    return 4 * math.ceil(count / 4)


def _surface(cut: Cut, pieces: Sequence[_Piece], counts: Sequence[int]) -> tuple[FloatArray, np.ndarray, FloatArray]:
    """Return, for each point of the surface, its time in shares of a passing, its node, and its angle [rad]."""
    pitch = 2.0 * math.pi / cut.teeth
    times, places, angles, first = [], [], [], 0
    for piece, count in zip(pieces, counts, strict=True):
        at = piece.begin + piece.width * _gauss(count)[0]
        for tooth in piece.teeth:
            times.append(at)
            places.append(np.arange(first, first + count))
            angles.append((tooth + at) * pitch)
        first += count
    return np.concatenate(times), np.concatenate(places), np.concatenate(angles)


def _tooth_vectors(
    angles: FloatArray, radial_ratio: float, feeds_deg: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Return what makes the chip thicker and the direction of its force, machine axes, shape (n_feeds, 2, n)."""
    sine, cosine = np.sin(angles), np.cos(angles)
    normal = np.stack((sine, cosine))
    force = np.stack((-(cosine + radial_ratio * sine), sine - radial_ratio * cosine))
    turns = np.stack([feed_rotation(feed).T for feed in feeds_deg])
    return turns @ normal, turns @ force


def _impulse_responses(
    entries: Sequence[tuple[int, int, Mode]], pieces: Sequence[_Piece], counts: Sequence[int], passing_s: FloatArray
) -> tuple[FloatArray, FloatArray, dict[tuple[int, int], FloatArray]]:
    """Return how states move the nodes, how the nodes' forces move the states, and the nodes among themselves.

    Shapes (n_speeds, n_nodes, n_states), (n_speeds, n_states, n_nodes), and (n_speeds, n_nodes, n_nodes) for each pair
    of displacement and force axis.
    """
    modes = [mode for _, _, mode in entries]
    gains = np.array([[mode.displacement_gain_per_kg, mode.velocity_gain_s_per_kg] for mode in modes])
    begins = np.cumsum([0, *counts])
    total, speeds = int(begins[-1]), len(passing_s)
    to_nodes = np.zeros((speeds, total, 2 * len(modes)))
    to_end = np.zeros((speeds, 2 * len(modes), total))
    pairs = {(out, into) for out, into, _ in entries}
    kernel = {pair: np.zeros((speeds, total, total)) for pair in pairs}
    member = {pair: np.array([(out, into) == pair for out, into, _ in entries]) for pair in pairs}
    rows, columns = [], []
    for number, (piece, count) in enumerate(zip(pieces, counts, strict=True)):
        here = slice(int(begins[number]), int(begins[number + 1]))
        at, weights = _gauss(count)
        width_s = passing_s[:, None] * piece.width
        within = _seen(gains, _motion(modes, width_s * at))
        for pair, block in kernel.items():
            impulse = within[member[pair], ..., 1].sum(axis=0)
            exact = (impulse @ _products(count)).reshape(speeds, count, count)
            block[:, here, here] = width_s[..., None] * exact
        rows.append(within)
        left = _motion(modes, width_s * (1.0 - at))[..., 1]
        columns.append(left * (width_s * weights)[None, ..., None])
        before_s, after_s = passing_s * piece.begin, passing_s * (1.0 - piece.begin - piece.width)
        to_nodes[:, here] = _as_states(_after(rows[-1], _motion(modes, before_s)))
        to_end[:, :, here] = _as_states(_then(_motion(modes, after_s), columns[-1])).transpose(0, 2, 1)
        for earlier in range(number):
            there = slice(int(begins[earlier]), int(begins[earlier + 1]))
            gap_s = passing_s * (piece.begin - pieces[earlier].begin - pieces[earlier].width)
            arriving = _after(rows[-1], _motion(modes, gap_s))
            for pair, block in kernel.items():
                block[:, here, there] = np.einsum(
                    "eski,esji->skj", arriving[member[pair]], columns[earlier][member[pair]], optimize=True
                )
    return to_nodes, to_end, kernel


def _seen(gains: FloatArray, motion: FloatArray) -> FloatArray:
    """Return the displacement after a motion per state, shape (n_modes, n_speeds, n, 2)."""
    rows: FloatArray = np.einsum("ei,esnij->esnj", gains, motion)
    return rows


def _after(rows: FloatArray, motion: FloatArray) -> FloatArray:
    """Return rows that are seen after a further motion, shape (n_modes, n_speeds, n, 2)."""
    moved: FloatArray = rows @ motion
    return moved


def _then(motion: FloatArray, columns: FloatArray) -> FloatArray:
    """Return columns moved on, shape (n_modes, n_speeds, n, 2)."""
    moved: FloatArray = columns @ motion.transpose(0, 1, 3, 2)
    return moved


def _as_states(each: FloatArray) -> FloatArray:
    """Return what belongs to modes side by side, shape (n_speeds, n, n_states)."""
    moved: FloatArray = each.transpose(1, 2, 0, 3).reshape(each.shape[1], each.shape[2], -1)
    return moved


def _motion(modes: Sequence[Mode], times_s: FloatArray) -> FloatArray:
    """Return the exact motion of each mode's two states, shape (n_modes, *times, 2, 2)."""
    lift = (-1,) + (1,) * times_s.ndim
    angular = np.array([mode.angular_rad_s for mode in modes]).reshape(lift)
    decay = np.array([mode.damping_ratio for mode in modes]).reshape(lift) * angular
    damped = np.sqrt((angular**2 - decay**2).astype(np.complex128))
    phase = damped * times_s
    if bool(np.all(decay < angular)):
        real = phase.real
        cosine, sine = np.cos(real), np.sin(real) / damped.real
    else:
        cosine, sine = np.cos(phase).real, (times_s * np.sinc(phase / np.pi)).real
    fading = np.exp(-decay * times_s)
    motion = np.empty((*cosine.shape, 2, 2))
    motion[..., 0, 0] = fading * (cosine + decay * sine)
    motion[..., 0, 1] = fading * sine
    motion[..., 1, 0] = -(angular**2) * motion[..., 0, 1]
    motion[..., 1, 1] = fading * (cosine - decay * sine)
    return motion


@lru_cache(maxsize=64)
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    """Return Gauss's nodes and weights from 0 to 1."""
    at, weights = np.polynomial.legendre.leggauss(count)
    return (at + 1.0) / 2.0, weights / 2.0


@lru_cache(maxsize=8)
def _products(count: int) -> FloatArray:
    """Return the integrals from 0 to node k of l_i(node k - u) l_j(u), shape (i, k j), of the nodes' polynomials l."""
    at, weights = _gauss(count)
    passed = at[:, None] * at
    ahead = at[:, None] - passed
    earlier, later = _polynomials(at, passed), _polynomials(at, ahead)
    found = np.einsum("kiq,kjq->ikj", later * (at[:, None] * weights)[:, None, :], earlier, optimize=True)
    return np.ascontiguousarray(found.reshape(count, -1))


def _polynomials(nodes: FloatArray, at: FloatArray) -> FloatArray:
    """Return the polynomials that are 1 at one node and 0 at the others, at places (k, q), shape (k, n, q)."""
    difference = 4.0 * (nodes[:, None] - nodes)
    np.fill_diagonal(difference, 1.0)
    barycentric = 1.0 / difference.prod(axis=1)
    distance = at[:, None, :] - nodes[None, :, None]
    distance[distance == 0.0] = 1e-300
    terms = barycentric[None, :, None] / distance
    values: FloatArray = terms / terms.sum(axis=1, keepdims=True)
    return values


def _bounds(maps: FloatArray, limits: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper bounds of the spectral radii of maps, shape (..., size, size), by repeated squaring."""
    size = maps.shape[-1]
    lower = np.zeros(maps.shape[:-2])
    upper = np.full(maps.shape[:-2], np.inf)
    largest = np.abs(maps).max(axis=(-2, -1))
    countable = np.isfinite(largest) & (largest < LARGEST_ENTRY)
    lower[~countable] = np.inf
    power = np.where(countable[..., None, None], maps, 0.0)
    scale = np.zeros(maps.shape[:-2])
    for squarings in range(MOST_SQUARINGS + 1):
        norm = np.linalg.norm(power, axis=(-2, -1))
        norm[norm == 0.0] = 1e-300
        exponent = 0.5**squarings
        with np.errstate(divide="ignore"):
            trace = np.log(np.abs(np.trace(power, axis1=-2, axis2=-1)) / size)
        found_upper = np.exp(exponent * (np.log(norm) + scale))
        found_lower = np.exp(exponent * (trace + scale))
        upper = np.where(countable, np.minimum(upper, found_upper), np.inf)
        lower = np.where(countable, np.maximum(lower, found_lower), np.inf)
        if limits is not None and (bool(np.all(upper <= limits)) or bool(np.any(lower > limits))):
            break
        power = power / norm[..., None, None]
        power = power @ power
        scale = 2.0 * (scale + np.log(norm))
    return lower, upper
