"""A chain of segments and joints on supports: tool, holder and shaft, from the front backwards."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from models.dynamics.beam import Counts, Segment, Span, Values, close, join, negative_pivots, segment_span
from models.records import FloatArray

SAME_PLACE_M = 1e-9
"""Positions that differ by less are one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpringDamper:
    """A translational and a rotational spring, each with a damper beside it (4-33, 4-37)."""

    kt_n_per_m: float = 0.0
    ct_ns_per_m: float = 0.0
    kr_nm_per_rad: float = 0.0
    cr_nms_per_rad: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no spring and no damper can be; raises ValueError."""
        for name in self.__slots__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and not negative, got {value:g}")

    def stiffness(self, frequency_hz: FloatArray, *, damped: bool) -> Values:
        """Return the dynamic stiffness as rows (11, 12, 22), shape (3, n) [N/m, -, Nm/rad]."""
        omega = 2.0 * np.pi * frequency_hz
        rows = np.zeros((3, len(omega)), dtype=np.complex128 if damped else np.float64)
        rows[0] = self.kt_n_per_m + (1j * omega * self.ct_ns_per_m if damped else 0.0)
        rows[2] = self.kr_nm_per_rad + (1j * omega * self.cr_nms_per_rad if damped else 0.0)
        return rows

    def span(self, frequency_hz: FloatArray, *, damped: bool) -> Span:
        """Return the joint as a span without length or mass (4-37)."""
        rows = self.stiffness(frequency_hz, damped=damped)
        zero = np.zeros_like(rows[0])
        return Span(rows, -np.stack([rows[0], zero, zero, rows[2]]), rows)


Part = Segment | SpringDamper
"""A stretch of shaft, or an elastic joint between two stretches."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """A bearing between the chain and the ground."""

    position_m: float
    """Distance from the front of the chain [m]."""
    group: str
    """Bearings of one group share their properties ('12', '34', '5')."""
    properties: SpringDamper


@dataclass(frozen=True, slots=True, kw_only=True)
class Chain:
    """Segments and joints from the front backwards, free at both ends, with supports.

    Raises ValueError when there is no segment, a joint stands at an end, or a support stands outside.
    """

    parts: tuple[Part, ...]
    supports: tuple[Support, ...] = ()

    def __post_init__(self) -> None:
        """Check the parts and the supports."""
        if not self.parts or not all(isinstance(end, Segment) for end in (self.parts[0], self.parts[-1])):
            raise ValueError("a chain begins and ends with a segment")
        for support in self.supports:
            if not -SAME_PLACE_M <= support.position_m <= self.length_m + SAME_PLACE_M:
                raise ValueError(
                    f"the support at {support.position_m * 1e3:g} mm lies outside the shaft "
                    f"(0 to {self.length_m * 1e3:g} mm)"
                )

    @property
    def segments(self) -> tuple[Segment, ...]:
        """The segments without the joints."""
        return tuple(part for part in self.parts if isinstance(part, Segment))

    @property
    def length_m(self) -> float:
        """Length over all [m]."""
        return sum(segment.length_m for segment in self.segments)

    @property
    def mass_kg(self) -> float:
        """Mass of all segments [kg]."""
        return sum(segment.mass_kg_per_m * segment.length_m for segment in self.segments)


def divide(chain: Chain, positions_m: list[float]) -> tuple[list[Part], list[int]]:
    """Return the parts with every position at a boundary, and the node that stands there.

    Node k stands before part k, the last one behind the last part. A position at a joint means
    the node in front of it. With `published` rotary inertia dividing a segment changes it
    slightly, since every piece loses its own rho I L.
    """
    wanted = sorted({round(position / SAME_PLACE_M) * SAME_PLACE_M for position in positions_m})
    parts: list[Part] = []
    nodes: dict[float, int] = {}
    start = 0.0
    for part in chain.parts:
        if isinstance(part, SpringDamper):
            parts.append(part)
            continue
        stop = start + part.length_m
        inside = [place for place in wanted if start + SAME_PLACE_M < place < stop - SAME_PLACE_M]
        borders = [start, *inside, stop]
        for first, last in pairwise(borders):
            for place in wanted:
                if abs(place - first) <= SAME_PLACE_M:
                    nodes.setdefault(place, len(parts))
            parts.append(part.cut(last - first) if inside else part)
            for place in wanted:
                if abs(place - last) <= SAME_PLACE_M:
                    nodes.setdefault(place, len(parts))
        start = stop
    rounded = [round(position / SAME_PLACE_M) * SAME_PLACE_M for position in positions_m]
    return parts, [nodes[place] for place in rounded]


def part_span(part: Part, frequency_hz: FloatArray, *, damped: bool, highest_hz: float) -> tuple[Span, Counts]:
    """Return the span of a segment or a joint and its clamped natural frequencies below each frequency."""
    if isinstance(part, SpringDamper):
        return part.span(frequency_hz, damped=damped), np.zeros(len(frequency_hz), dtype=np.int64)
    return segment_span(part, frequency_hz, damped=damped, highest_hz=highest_hz)


def chain_span(parts: list[Part], frequency_hz: FloatArray, *, damped: bool) -> Span:
    """Return the dynamic stiffness between the two ends of several parts in a row."""
    highest = float(frequency_hz.max())
    span, _ = part_span(parts[0], frequency_hz, damped=damped, highest_hz=highest)
    for part in parts[1:]:
        following, _ = part_span(part, frequency_hz, damped=damped, highest_hz=highest)
        span, _ = join(span, following)
    return span


def natural_frequencies_below(chain: Chain, frequency_hz: FloatArray, highest_hz: float) -> Counts:
    """Return how many undamped natural frequencies lie below each frequency (Wittrick and Williams).

    Parameters
    ----------
    chain
        The chain; damping is left out, supports and joints act with their stiffness.
    frequency_hz
        Frequencies [Hz], shape (n,), positive.
    highest_hz
        Highest frequency of the search; decides into how many elements segments are divided.

    Returns
    -------
    ndarray
        Number of natural frequencies below each, rigid-body modes at zero included, shape (n,).

    Notes
    -----
    The sum of the negative pivots of the assembled dynamic stiffness and of the natural frequencies
    of every element clamped at both ends; elements are so short that the latter has none.

    """
    parts, nodes = divide(chain, [support.position_m for support in chain.supports])
    held: dict[int, Values] = {}
    for node, support in zip(nodes, chain.supports, strict=True):
        held[node] = held.get(node, 0.0) + support.properties.stiffness(frequency_hz, damped=False)
    stiffness = held.get(len(parts), np.zeros((3, len(frequency_hz))))
    total = np.zeros(len(frequency_hz), dtype=np.int64)
    for index in range(len(parts) - 1, -1, -1):
        span, clamped = part_span(parts[index], frequency_hz, damped=False, highest_hz=highest_hz)
        stiffness, negative = close(span, stiffness)
        total += clamped + negative
        if index in held:
            stiffness = stiffness + held[index]
    return total + negative_pivots(stiffness)
