"""The simulated machine's spindle, holder and tool: finite beam elements, damped modes, frequency responses.

Two-node Timoshenko elements with consistent mass, of at most 8 mm; the shear area comes from the energy of the shear
stress in a warping tube. Bearings and joints are springs and dampers at nodes. The undamped modes of the
machine at its nominal bearings serve as coordinates; with the bearings' present stiffness and dampers there follow
damped modes (state space), and from their poles and residues the responses. Nothing is taken from the estimators.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

ComplexVector = npt.NDArray[np.complex128]

ELEMENT_MM = 8.0
"""Longest element; halving it moves no mode below 1.5 kHz by more than 0.1 Hz."""
COORDINATES = 60
"""Undamped modes that serve as coordinates."""
LOSS_FACTOR = 0.0029
"""Of the materials: a mode's damping ratio is half of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A tube of constant section, with another one shrunk on where there is a rotor."""

    length_mm: float
    outer_mm: float
    inner_mm: float
    young_gpa: float
    shear_gpa: float
    density: float
    """[kg/m3]."""
    rotor_mm: float | None = None
    """Outer diameter of the steel shrunk onto it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spring:
    """A bearing, or a joint: stiffness and damping against displacement and rotation, SI units."""

    kt: float
    ct: float
    kr: float
    cr: float


STEEL = {"young_gpa": 200.0, "shear_gpa": 76.9, "density": 7850.0}
SHAFT: tuple[Stretch, ...] = (
    Stretch(length_mm=15.0, outer_mm=89.0, inner_mm=36.0, **STEEL),
    Stretch(length_mm=63.0, outer_mm=89.0, inner_mm=36.0, young_gpa=214.0, shear_gpa=24.3, density=2230.0),
    Stretch(length_mm=11.0, outer_mm=89.0, inner_mm=28.0, young_gpa=201.0, shear_gpa=51.7, density=4100.0),
    Stretch(length_mm=133.0, outer_mm=60.0, inner_mm=28.0, young_gpa=204.0, shear_gpa=34.1, density=4100.0),
    Stretch(length_mm=32.0, outer_mm=60.0, inner_mm=28.0, **STEEL),
    Stretch(length_mm=154.0, outer_mm=53.0, inner_mm=32.0, **STEEL, rotor_mm=97.0),
    Stretch(length_mm=22.0, outer_mm=52.7, inner_mm=32.0, **STEEL),
    Stretch(length_mm=71.0, outer_mm=45.0, inner_mm=33.0, **STEEL),
)
"""From the nose backwards; dimensions as of a 26 kW motor spindle (chosen after the published one)."""
HOLDER: tuple[Stretch, ...] = (
    Stretch(length_mm=31.0, outer_mm=42.0, inner_mm=0.0, **STEEL),
    Stretch(length_mm=47.0, outer_mm=48.0, inner_mm=20.0, **STEEL),
    Stretch(length_mm=26.0, outer_mm=59.0, inner_mm=20.0, **STEEL),
)
TAPER = Spring(kt=1.9e8, ct=900.0, kr=6.0e5, cr=2.0)
"""Joint of the holder (chosen, of the size of the published one); it does not change with temperature."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MountedTool:
    """An end mill and the joint between it and the holder, which does not change with temperature."""

    body: tuple[Stretch, ...]
    """From the tip backwards."""
    joint: Spring


END_MILL_10 = MountedTool(
    body=(Stretch(length_mm=40.0, outer_mm=10.0, inner_mm=0.0, **STEEL),),
    joint=Spring(kt=3.4e7, ct=1.0, kr=2.4e4, cr=1.0),
)
"""In a collet; the joint is of the size of the published one (chosen)."""
END_MILL_16 = MountedTool(
    body=(Stretch(length_mm=40.0, outer_mm=16.0, inner_mm=0.0, **STEEL),),
    joint=Spring(kt=1.0e8, ct=3.0, kr=1.4e5, cr=3.0),
)
"""Shrunk in, so that the spindle and not the tool limits the cut (chosen)."""
BEARING_PLACES_MM: tuple[float, ...] = (99.0, 127.0, 184.0, 211.0, 437.0)
"""Distances of the five bearings from the nose."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DampedModes:
    """Damped modes of the spindle at one moment, those with positive frequency."""

    poles: ComplexVector
    """[rad/s], shape (m,), by ascending imaginary part."""
    residues: ComplexVector
    """Of the receptance at the hit point, shape (m,)."""
    shapes: npt.NDArray[np.complex128]
    """In the coordinates of the beam, shape (coordinates, m)."""

    def receptance(self, frequency_hz: FloatArray) -> ComplexVector:
        """Return displacement per force where it is hit [m/N], shape (n,)."""
        s = 2j * np.pi * frequency_hz[:, None]
        both = self.residues / (s - self.poles) + self.residues.conj() / (s - self.poles.conj())
        return np.asarray(both.sum(axis=1), dtype=np.complex128)

    @property
    def resonance_hz(self) -> FloatArray:
        """Frequencies at which each mode, alone, responds most [Hz], shape (m,); 0 where it is damped too much."""
        natural = np.abs(self.poles)
        ratio = -self.poles.real / natural
        return np.asarray(natural * np.sqrt(np.maximum(1.0 - 2.0 * ratio**2, 0.0)) / (2.0 * np.pi))


class SpindleBeam:
    """The bare spindle hit at its nose, or with holder and tool hit at the tip."""

    def __init__(self, nominal: Sequence[Spring], *, with_tool: bool, tool: MountedTool = END_MILL_10) -> None:
        """Assemble the elements and find the coordinates; `nominal` are the five bearings as they usually are."""
        bodies: list[tuple[Stretch, ...]] = [tool.body, HOLDER, SHAFT] if with_tool else [SHAFT]
        joints = [tool.joint, TAPER] if with_tool else []
        lengths = [_divided(body) for body in bodies]
        nodes = sum(len(each) + 1 for each in lengths)
        stiffness, mass, damping = (np.zeros((2 * nodes, 2 * nodes)) for _ in range(3))
        first = 0
        for index, elements in enumerate(lengths):
            if index:
                joint = joints[index - 1]
                _tie(stiffness, first - 1, joint.kt, joint.kr)
                _tie(damping, first - 1, joint.ct, joint.cr)
            for place, (stretch, length_m) in enumerate(elements):
                at = slice(2 * (first + place), 2 * (first + place) + 4)
                element = _element(stretch, length_m)
                stiffness[at, at] += element[0]
                mass[at, at] += element[1]
            first += len(elements) + 1
        shaft_first = nodes - len(lengths[-1]) - 1
        self._bearing_nodes = [shaft_first + node for node in _nodes_at(lengths[-1], BEARING_PLACES_MM)]
        self._build(stiffness, mass, damping, nominal)

    def _build(self, stiffness: FloatArray, mass: FloatArray, damping: FloatArray, nominal: Sequence[Spring]) -> None:
        supported = stiffness.copy()
        _ground(supported, self._bearing_nodes, [(each.kt, each.kr) for each in nominal])
        root = np.linalg.cholesky(mass)
        inverse = np.linalg.inv(root)
        squares, vectors = np.linalg.eigh(inverse @ supported @ inverse.T)
        shapes = (inverse.T @ vectors)[:, :COORDINATES]
        self._rows = np.stack([shapes[2 * node + turn] for node in self._bearing_nodes for turn in (0, 1)])
        self._tip = shapes[0]
        self._stiffness = shapes.T @ stiffness @ shapes
        natural = np.sqrt(np.maximum(squares[:COORDINATES], 0.0))
        self._damping = shapes.T @ damping @ shapes + np.diag(LOSS_FACTOR * natural)

    def modes(self, bearings: Sequence[Spring]) -> DampedModes:
        """Return the damped modes with these five bearings, from the nose backwards."""
        springs = np.array([value for each in bearings for value in (each.kt, each.kr)])
        dampers = np.array([value for each in bearings for value in (each.ct, each.cr)])
        stiffness = self._stiffness + self._rows.T @ (springs[:, None] * self._rows)
        damping = self._damping + self._rows.T @ (dampers[:, None] * self._rows)
        count = len(stiffness)
        state = np.block([[np.zeros((count, count)), np.eye(count)], [-stiffness, -damping]])
        poles, vectors = np.linalg.eig(state)
        upper = np.flatnonzero(poles.imag > 1.0)
        upper = upper[np.argsort(poles[upper].imag)]
        shapes = vectors[:count, upper]
        # With symmetric matrices the left vectors are the right ones, scaled by phi^T (2 s + C) phi.
        scale = np.einsum("ir,ij,jr->r", shapes, damping, shapes) + 2.0 * poles[upper] * np.sum(shapes**2, axis=0)
        return DampedModes(poles=poles[upper], residues=(self._tip @ shapes) ** 2 / scale, shapes=shapes)


def _divided(body: Sequence[Stretch]) -> list[tuple[Stretch, float]]:
    """Return the elements of a body with their lengths [m]; the bearings of the shaft lie on nodes."""
    stops = {0.0}
    place = 0.0
    for stretch in body:
        place += stretch.length_mm
        stops.add(place)
    if body is SHAFT:
        stops |= set(BEARING_PLACES_MM)
    elements: list[tuple[Stretch, float]] = []
    places = sorted(stops)
    ends = np.cumsum([stretch.length_mm for stretch in body])
    for start, end in pairwise(places):
        stretch = body[int(np.searchsorted(ends, 0.5 * (start + end)))]
        count = int(np.ceil((end - start) / ELEMENT_MM))
        elements += [(stretch, (end - start) / count * 1e-3)] * count
    return elements


def _nodes_at(elements: Sequence[tuple[Stretch, float]], places_mm: Sequence[float]) -> list[int]:
    ends = np.concatenate([[0.0], np.cumsum([length for _, length in elements])]) * 1e3
    return [int(np.argmin(np.abs(ends - place))) for place in places_mm]


def _tie(matrix: FloatArray, node: int, sliding: float, turning: float) -> None:
    """Add a spring between the last node of one body and the first of the next."""
    for turn, value in ((0, sliding), (1, turning)):
        i, j = 2 * node + turn, 2 * node + 2 + turn
        matrix[i, i] += value
        matrix[j, j] += value
        matrix[i, j] -= value
        matrix[j, i] -= value


def _ground(matrix: FloatArray, nodes: Sequence[int], springs: Sequence[tuple[float, float]]) -> None:
    for node, (sliding, turning) in zip(nodes, springs, strict=True):
        matrix[2 * node, 2 * node] += sliding
        matrix[2 * node + 1, 2 * node + 1] += turning


def _element(stretch: Stretch, length: float) -> tuple[FloatArray, FloatArray]:
    """Return stiffness and consistent mass of an element over (y, theta) of both ends."""
    outer, inner = stretch.outer_mm * 0.5e-3, stretch.inner_mm * 0.5e-3
    tubes = [(outer, inner, stretch.young_gpa * 1e9, stretch.shear_gpa * 1e9, stretch.density)]
    if stretch.rotor_mm is not None:
        tubes.append((stretch.rotor_mm * 0.5e-3, outer, 200e9, 76.9e9, 7850.0))
    bending = sum(young * _second_moment(a, b) for a, b, young, _, _ in tubes)
    shear = sum(modulus * _shear_area(a, b) for a, b, _, modulus, _ in tubes)
    line_mass = sum(density * np.pi * (a**2 - b**2) for a, b, _, _, density in tubes)
    line_inertia = sum(density * _second_moment(a, b) for a, b, _, _, density in tubes)
    ratio = 12.0 * bending / (shear * length**2)
    h = length
    stiffness = (bending / (h**3 * (1.0 + ratio))) * np.array(
        [
            [12.0, 6.0 * h, -12.0, 6.0 * h],
            [6.0 * h, (4.0 + ratio) * h**2, -6.0 * h, (2.0 - ratio) * h**2],
            [-12.0, -6.0 * h, 12.0, -6.0 * h],
            [6.0 * h, (2.0 - ratio) * h**2, -6.0 * h, (4.0 + ratio) * h**2],
        ]
    )
    return stiffness, _mass(line_mass, line_inertia, ratio, h)


def _mass(line_mass: float, line_inertia: float, ratio: float, h: float) -> FloatArray:
    """Return the mass matrix, integrated over the element's own shapes by Gauss points."""
    points, weights = np.polynomial.legendre.leggauss(6)
    x = 0.5 * (points + 1.0)
    one = 1.0 / (1.0 + ratio)
    bend = one * np.stack(
        [
            1.0 - 3.0 * x**2 + 2.0 * x**3 + ratio * (1.0 - x),
            h * (x - 2.0 * x**2 + x**3 + 0.5 * ratio * (x - x**2)),
            3.0 * x**2 - 2.0 * x**3 + ratio * x,
            h * (x**3 - x**2 + 0.5 * ratio * (x**2 - x)),
        ]
    )
    turn = one * np.stack(
        [
            6.0 * (x**2 - x) / h,
            1.0 - 4.0 * x + 3.0 * x**2 + ratio * (1.0 - x),
            6.0 * (x - x**2) / h,
            3.0 * x**2 - 2.0 * x + ratio * x,
        ]
    )
    weight = 0.5 * h * weights
    return np.asarray(line_mass * (bend * weight) @ bend.T + line_inertia * (turn * weight) @ turn.T)


def _second_moment(outer: float, inner: float) -> float:
    return 0.25 * float(np.pi) * (outer**4 - inner**4)


def _shear_area(outer: float, inner: float) -> float:
    """Return the area that would shear evenly with the energy of a tube's true shear stress (no Poisson's ratio).

    The section warps by g(r) sin t with g'' + g'/r - g/r^2 = -r/I and g' = 0 at both walls; the stresses of a unit
    force are g' sin t and g/r cos t, and their energy is integrated.
    """
    second = _second_moment(outer, inner)
    b = 3.0 * inner**2 * outer**2 / (8.0 * second)
    a = 3.0 * outer**2 / (8.0 * second) + b / outer**2
    points, weights = np.polynomial.legendre.leggauss(24)
    r = inner + 0.5 * (outer - inner) * (points + 1.0)
    slope = a - b / r**2 - 3.0 * r**2 / (8.0 * second)
    around = a + b / r**2 - r**2 / (8.0 * second)
    energy = float(np.pi * 0.5 * (outer - inner) * np.sum(weights * (slope**2 + around**2) * r))
    return 1.0 / energy
