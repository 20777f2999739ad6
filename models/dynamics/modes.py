"""Undamped natural frequencies, found by counting, and their shapes."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from models.dynamics.beam import Segment, Span, Values, published_excess, segment_span
from models.dynamics.chain import Chain, SpringDamper, divide, natural_frequencies_below
from models.records import FloatArray

LOWEST_HZ = 1.0
"""Natural frequencies below this are rigid-body modes."""
HIGHEST_HZ = 100_000.0
"""Where a search ends; beam theory ends long before."""
SECTIONS = 16
"""Parts into which an interval is divided at each step of the search."""
PRECISION = 1e-12
"""Relative width of the interval that a natural frequency is known to lie in."""
NODE = 1e-9
"""A front that moves less, beside the largest displacement, stands still."""
INVERSE_ITERATIONS = 4
SHAPE_STEP_M = 0.005
"""Largest distance between two points of a shape."""
MOST_SHAPE_POINTS = 400
"""Points of a shape of one section at most; on a longer chain they lie further apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """An undamped mode."""

    frequency_hz: float
    position_m: FloatArray
    """Points from the front of the chain [m], shape (n,)."""
    displacement: FloatArray
    """Transverse displacement, largest value 1, positive at the front (where it is not zero), shape (n,)."""


def rigid_body_modes(chain: Chain) -> int:
    """Return how many modes a chain has below `LOWEST_HZ`: two when it is free, none when it is held."""
    return int(natural_frequencies_below(chain, np.array([LOWEST_HZ]), LOWEST_HZ)[0])


def natural_frequencies(chain: Chain, count: int, search_end_hz: float = HIGHEST_HZ) -> FloatArray:
    """Return the lowest elastic natural frequencies [Hz], shape (count,), ascending; equal ones appear as often.

    None is missed and none is spurious: each is an interval at which the number of natural
    frequencies below (Wittrick and Williams) rises, narrowed to `PRECISION`.

    `chain`: the chain, free or on supports; damping is left out. `count`: how many; at least 1. Fewer are returned when
    the search ends before. `search_end_hz`: where the search ends [Hz].
    """
    rigid = rigid_body_modes(chain)
    highest = 2000.0
    while highest < search_end_hz:
        if natural_frequencies_below(chain, np.array([highest]), highest)[0] >= rigid + count:
            break
        highest *= 2.0
    found = int(natural_frequencies_below(chain, np.array([highest]), highest)[0]) - rigid
    ranks = rigid + np.arange(1, min(count, found) + 1)
    low, high = np.full(len(ranks), LOWEST_HZ), np.full(len(ranks), highest)
    steps = np.arange(1, SECTIONS) / SECTIONS
    while len(ranks) and np.any(high - low > PRECISION * high):
        tried = low[:, None] + (high - low)[:, None] * steps
        below = natural_frequencies_below(chain, tried.ravel(), highest).reshape(tried.shape)
        edges = np.column_stack([low, tried, high])
        reached = (below < ranks[:, None]).sum(axis=1)
        rows = np.arange(len(ranks))
        new_low, new_high = edges[rows, reached], edges[rows, reached + 1]
        if np.all(new_high - new_low >= high - low):
            break
        low, high = new_low, new_high
    return np.asarray(0.5 * (low + high), dtype=np.float64)


def modes(chain: Chain, count: int, step_m: float = SHAPE_STEP_M) -> list[Mode]:
    """Return the lowest elastic modes with their shapes.

    `count`: how many. `step_m`: largest distance between two points of a shape [m].
    """
    return [_mode(chain, float(frequency), step_m) for frequency in natural_frequencies(chain, count)]


def _mode(chain: Chain, frequency_hz: float, step_m: float) -> Mode:
    step_m = max(step_m, chain.length_m / MOST_SHAPE_POINTS)
    stiffness, position_m = dense_stiffness(chain, frequency_hz, step_m, damped=False)
    lever = np.tile([1.0, 1.0 / _gyration_m(chain)], len(position_m))
    vector = _null_vector(stiffness * lever[:, None] * lever) * lever
    displacement = vector[::2]
    scale = displacement[np.argmax(np.abs(displacement))]
    if abs(displacement[0]) > NODE * abs(scale):
        scale = abs(scale) * np.sign(displacement[0])
    return Mode(frequency_hz=frequency_hz, position_m=position_m, displacement=displacement / scale)


def _null_vector(matrix: Values) -> FloatArray:
    """Return the vector that a nearly singular symmetric matrix makes smallest, by inverse iteration."""
    size = len(matrix)
    # The shift keeps an exactly singular matrix solvable and is far below what separates two modes.
    shifted = matrix + np.eye(size) * (np.finfo(np.float64).eps * np.abs(matrix).max())
    vector = np.cos(1.0 + np.arange(size) ** 1.5)
    for _ in range(INVERSE_ITERATIONS):
        vector = np.linalg.solve(shifted, vector)
        vector /= np.linalg.norm(vector)
    return np.asarray(vector, dtype=np.float64)


def _gyration_m(chain: Chain) -> float:
    """Return a length that makes displacements and rotations comparable: the mean radius of gyration [m]."""
    segments = chain.segments
    inertia = sum(segment.rotary_inertia_kgm * segment.length_m for segment in segments)
    return float(np.sqrt(inertia / sum(segment.mass_kg_per_m * segment.length_m for segment in segments)))


def dense_stiffness(chain: Chain, frequency_hz: float, step_m: float, *, damped: bool) -> tuple[Values, FloatArray]:
    """Return the dynamic stiffness of many points along a chain at one frequency.

    Result: symmetric matrix, shape (2 m, 2 m), ordered (y_1, theta_1, y_2, ...), and the positions of the m points from
    the front [m]; at an elastic joint a position appears twice.

    `chain`: the chain with its supports. `frequency_hz`: one frequency [Hz]. `step_m`: largest distance between two
    points of a segment [m]; 0: only the ends and the supports. `damped`: whether the structural damping and the dampers
    act.
    """
    at = np.array([frequency_hz])
    parts, nodes = divide(chain, [support.position_m for support in chain.supports])
    blocks: list[Values] = []
    places, starts = [0.0], [0]
    for part in parts:
        if isinstance(part, SpringDamper):
            blocks.append(_matrix(part.span(at, damped=damped)))
            places.append(places[-1])
        else:
            pieces = int(np.ceil(part.length_m / step_m)) if step_m > 0.0 else 1
            offsets = [part.length_m * piece / pieces for piece in range(pieces + 1)]
            blocks.append(segment_matrix(part, frequency_hz, offsets, damped=damped))
            places += [places[-1] + offset for offset in offsets[1:]]
        starts.append(len(places) - 1)
    total = np.zeros((2 * len(places), 2 * len(places)), dtype=np.complex128 if damped else np.float64)
    for start, block in zip(starts, blocks, strict=False):
        total[2 * start : 2 * start + len(block), 2 * start : 2 * start + len(block)] += block
    for node, support in zip(nodes, chain.supports, strict=True):
        row = 2 * starts[node]
        rows = support.properties.stiffness(at, damped=damped)[:, 0]
        total[row, row] += rows[0]
        total[row + 1, row + 1] += rows[2]
    return total, np.array(places)


def segment_matrix(segment: Segment, frequency_hz: float, offsets_m: list[float], *, damped: bool) -> Values:
    """Return the dynamic stiffness of points of a segment, shape (2 m, 2 m), at one frequency [Hz].

    `segment`: the segment; a `published` one keeps its one rigid rotation mode, whatever its points. `frequency_hz`:
    one frequency [Hz]. `offsets_m`: points from its front [m], ascending, the first 0 and the last its length.
    `damped`: whether E and G are complex.
    """
    at = np.array([frequency_hz])
    exact = segment.as_correct()
    size = 2 * len(offsets_m)
    total = np.zeros((size, size), dtype=np.complex128 if damped else np.float64)
    for index, (first, last) in enumerate(pairwise(offsets_m)):
        span, _ = segment_span(exact.cut(last - first), at, damped=damped)
        total[2 * index : 2 * index + 4, 2 * index : 2 * index + 4] += _matrix(span)
    if segment.rigid_rotary_inertia == "published":
        rotation = np.ravel([[offset - segment.length_m / 2.0, 1.0] for offset in offsets_m])
        pushed = total @ rotation
        depth = rotation @ pushed - (2.0 * np.pi * frequency_hz) ** 2 / published_excess(segment)
        total = total - np.outer(pushed, pushed) / depth
    return total


def _matrix(span: Span) -> Values:
    """Return a span at its first frequency as a 4 x 4 matrix."""
    front, cross, rear = (block[:, 0] for block in span)
    return np.array(
        [
            [front[0], front[1], cross[0], cross[1]],
            [front[1], front[2], cross[2], cross[3]],
            [cross[0], cross[2], rear[0], rear[1]],
            [cross[1], cross[3], rear[1], rear[2]],
        ]
    )


def modal_assurance(first: npt.NDArray[np.generic], second: npt.NDArray[np.generic]) -> float:
    """Return how alike two shapes are, 0 to 1 (4-39, with the conjugates that complex vectors need).

    Raises ValueError when a shape is zero everywhere or the numbers of points differ.

    `first` and `second`: real or complex displacements at the same points, shape (n,).
    """
    one, two = np.asarray(first, dtype=np.complex128), np.asarray(second, dtype=np.complex128)
    if one.shape != two.shape or one.ndim != 1:
        raise ValueError(f"two shapes at the same points are needed, got {one.shape} and {two.shape}")
    size = float(np.vdot(one, one).real * np.vdot(two, two).real)
    if not size > 0.0:
        raise ValueError("a shape that is zero everywhere is like nothing")
    return float(abs(np.vdot(one, two)) ** 2 / size)


def at_points(position_m: FloatArray, shape: FloatArray, wanted_m: FloatArray) -> FloatArray:
    """Return a shape at other points [m] by linear interpolation between its own, shape (len(wanted_m),)."""
    return np.interp(wanted_m, position_m, shape)


MAC_POINTS = 200
"""Evenly spaced points at which shapes are compared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeChange:
    """How one mode differs from the one it is compared with."""

    frequency_hz: float
    change_percent: float
    """Of the frequency, against the base [%]."""
    mac: float
    """Likeness of the shapes (4-39)."""


def mode_changes(base: Sequence[Mode], varied: Sequence[Mode]) -> list[ModeChange]:
    """Return how modes differ, each compared with the base mode of its rank."""
    changes = []
    for one, two in zip(base, varied, strict=False):
        ends = max(one.position_m[0], two.position_m[0]), min(one.position_m[-1], two.position_m[-1])
        wanted = np.linspace(*ends, MAC_POINTS)
        mac = modal_assurance(
            at_points(one.position_m, one.displacement, wanted), at_points(two.position_m, two.displacement, wanted)
        )
        change = 100.0 * (two.frequency_hz / one.frequency_hz - 1.0)
        changes.append(ModeChange(frequency_hz=two.frequency_hz, change_percent=change, mac=mac))
    return changes
