"""Exact dynamic stiffness of uniform Timoshenko segments (equations 4-1 to 4-6 of the dissertation).

The state ``(y, theta, T, B)`` along a segment, with the transverse force ``T = A_s G (y' - theta) - N y'``
and ``B = E I theta'``, obeys ``x' = A x`` with a constant matrix. Its exponential over the length is written
as ``C0 + C1 A + C2 A^2 + C3 A^3``; the four coefficients are entire functions of the two characteristic
values and are summed as power series in the two coefficients of the characteristic polynomial. No root
is taken, so nothing changes at the shear cut-off and nothing cancels on a segment of any shortness.
Segments longer than `longest_element_m` are halved until they are not and joined again, which is exact.

Rigid rotary inertia: the dissertation normalises the rigid rotation mode of a segment (4-12) without its rotary
inertia rho I L. `published` reproduces that: the receptance of a free segment gets a rank-one term, the
stiffness its inverse (`_with_published_rotation`). It makes results depend on how a shaft is divided.

Rotation: a shaft that turns with Omega has gyroscopic moments. In the whirl at w in the sense of the rotation they make
the rotary inertia rho I w^2 to rho I (w^2 - 2 Omega w), against it to rho I (w^2 + 2 Omega w) (Rayleigh and Timoshenko,
H. D. Nelson, J. Mech. Des. 102 (1980) 793-803); the polar inertia of a round section is twice the one across it.

Sign of the axial load: positive is compression, as in 4-8. The dissertation's 4-2 and 4-4 together are not
self-adjoint when N_L is not zero (the receptance would depend on which end is hit); here the load acts
through its potential ``-N y'^2 / 2``. For N_L = 0 the equations are the dissertation's.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

ComplexArray = npt.NDArray[np.complex128]
Values = npt.NDArray[Any]
"""Real or complex values over n frequencies."""
Counts = npt.NDArray[np.int64]
RotaryInertia = Literal["correct", "published"]

SERIES_TERMS = 13
"""Terms of the power series; with characteristic values up to `LARGEST_VALUE` the rest is below 1e-17."""
LARGEST_VALUE = 4.0
"""Largest characteristic value (dimensionless, squared wave number times squared length) of one element."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A uniform stretch of a shaft, described by what bends, shears and moves.

    Raises ValueError when a length, stiffness or inertia is not positive and finite, or the axial load buckles it in
    shear.
    """

    length_m: float
    mass_kg_per_m: float
    """rho A_c [kg/m]."""
    rotary_inertia_kgm: float
    """rho I [kg m]."""
    bending_stiffness_nm2: float
    """E I [N m^2]."""
    shear_stiffness_n: float
    """A_s G [N]."""
    axial_load_n: float = 0.0
    """N_L [N], positive in compression."""
    structural_damping: float = 0.0
    """zeta: E and G are multiplied by (1 + j zeta) where a response is asked for."""
    rigid_rotary_inertia: RotaryInertia = "correct"
    """Whether the rigid rotation mode counts rho I L (`correct`) or, as printed in 4-12, not (`published`)."""
    spin_rad_s: float = 0.0
    """Speed at which it turns in the sense of the whirl; negative: the whirl goes against it; 0: it stands [rad/s]."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in (
            "length_m",
            "mass_kg_per_m",
            "rotary_inertia_kgm",
            "bending_stiffness_nm2",
            "shear_stiffness_n",
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} of a segment must be positive and finite, got {value:g}")
        if not 0.0 <= self.structural_damping < 1.0:
            raise ValueError(f"structural_damping must be at least 0 and below 1, got {self.structural_damping:g}")
        if not (np.isfinite(self.axial_load_n) and self.axial_load_n < 0.25 * self.shear_stiffness_n):
            raise ValueError(
                f"axial_load_n {self.axial_load_n:g} must stay below a quarter of the shear stiffness "
                f"{self.shear_stiffness_n:g} N"
            )
        if not np.isfinite(self.spin_rad_s):
            raise ValueError(f"spin_rad_s must be finite, got {self.spin_rad_s:g}")
        if self.spin_rad_s and self.rigid_rotary_inertia == "published":
            raise ValueError("a turning shaft needs its whole rotary inertia: rigid_rotary_inertia correct")

    def cut(self, length_m: float) -> "Segment":
        """Return a piece of this segment with another length [m]."""
        return replace(self, length_m=length_m)

    def as_correct(self) -> "Segment":
        """Return this segment with its rotary inertia complete."""
        return replace(self, rigid_rotary_inertia="correct")


class Span(NamedTuple):
    """Dynamic stiffness between the front and the rear end of a span, at n frequencies.

    Rows are force and moment, columns displacement and rotation: [N/m, N/rad; Nm/m, Nm/rad].
    """

    front: Values
    """Symmetric front block as rows (11, 12, 22), shape (3, n)."""
    cross: Values
    """Block from rear motion to front force as rows (11, 12, 21, 22), shape (4, n)."""
    rear: Values
    """Symmetric rear block as rows (11, 12, 22), shape (3, n)."""


def longest_element_m(segment: Segment, highest_rad_per_s: float) -> float:
    """Return a length [m] that one element of a segment may have at frequencies up to a highest one.

    Clamped at both ends, an element of this length has no natural frequency below the highest
    (a lower bound by Poincare's and Young's inequalities), so that counting natural frequencies
    needs no clamped ones, and its characteristic values stay below `LARGEST_VALUE`.
    """
    omega_squared = highest_rad_per_s**2
    turning_squared = omega_squared + 2.0 * abs(segment.spin_rad_s) * highest_rad_per_s
    shear, bending = segment.shear_stiffness_n, segment.bending_stiffness_nm2
    load = max(segment.axial_load_n, 0.0)
    bend = np.pi * np.sqrt(bending / (shear + turning_squared * segment.rotary_inertia_kgm))
    slide = np.pi * np.sqrt((0.5 * shear - load) / (omega_squared * segment.mass_kg_per_m))
    largest = max(abs(value) for value in np.roots([1.0, *_polynomial(segment, omega_squared, turning_squared)]))
    return float(0.95 * min(bend, slide, np.sqrt(LARGEST_VALUE / largest)))


def _polynomial(segment: Segment, omega_squared: float, turning_squared: float) -> tuple[float, float]:
    """Return b and c of the characteristic polynomial p^2 + b p + c, with p the squared wave number [1/m^2]."""
    free = segment.shear_stiffness_n - segment.axial_load_n
    ratio = segment.shear_stiffness_n / free
    inertia = segment.mass_kg_per_m * omega_squared
    turning = segment.rotary_inertia_kgm * turning_squared + ratio * segment.axial_load_n
    bending = segment.bending_stiffness_nm2
    return inertia / free + turning / bending, inertia / bending * (turning / free - ratio**2)


def segment_span(
    segment: Segment, frequency_hz: FloatArray, *, damped: bool, highest_hz: float | None = None
) -> tuple[Span, Counts]:
    """Return the dynamic stiffness of a segment between its ends.

    Result: the span, and how many natural frequencies of the segment clamped at both ends lie below each frequency,
    shape (n,); zeros when damped.

    `frequency_hz`: frequencies [Hz], shape (n,), positive. `damped`: whether E and G are complex, which equals 4-14 to
    4-16 summed over all modes. `highest_hz`: frequency that decides into how many elements the segment is divided;
    None: the largest given.
    """
    highest = float(frequency_hz.max()) if highest_hz is None else highest_hz
    pieces = segment.length_m / longest_element_m(segment, 2.0 * np.pi * highest)
    doublings = max(0, int(np.ceil(np.log2(pieces))))
    damping = segment.structural_damping if damped else 0.0
    span = _element(segment.cut(segment.length_m / 2**doublings), frequency_hz, damping)
    clamped = np.zeros(len(frequency_hz), dtype=np.int64)
    for _ in range(doublings):
        span, negative = join(span, span)
        clamped = 2 * clamped + negative
    if segment.rigid_rotary_inertia == "published":
        changed = _with_published_rotation(span, segment, frequency_hz)
        # Free natural frequencies stay where they are, so what one count loses the other gains.
        clamped += _negative_span(span) - _negative_span(changed)
        span = changed
    return span, clamped


def published_excess(segment: Segment) -> float:
    """Return by how much 4-12 as printed overstates the rigid rotation [1/(kg m^2)]."""
    printed = segment.mass_kg_per_m * segment.length_m**3 / 12.0
    return 1.0 / printed - 1.0 / (printed + segment.rotary_inertia_kgm * segment.length_m)


def _with_published_rotation(span: Span, segment: Segment, frequency_hz: FloatArray) -> Span:
    """Return the stiffness whose receptance has the term -excess/omega^2 v v^T more, v the rigid rotation."""
    front, cross, rear = span
    half = segment.length_m / 2.0
    pushed = (
        -half * front[0] + front[1] + half * cross[0] + cross[1],
        -half * front[1] + front[2] + half * cross[2] + cross[3],
        -half * cross[0] + cross[2] + half * rear[0] + rear[1],
        -half * cross[1] + cross[3] + half * rear[1] + rear[2],
    )
    work = half * (pushed[2] - pushed[0]) + pushed[1] + pushed[3]
    scale = 1.0 / (work - (2.0 * np.pi * frequency_hz) ** 2 / published_excess(segment))
    p = pushed
    return Span(
        front - np.stack([p[0] * p[0], p[0] * p[1], p[1] * p[1]]) * scale,
        cross - np.stack([p[0] * p[2], p[0] * p[3], p[1] * p[2], p[1] * p[3]]) * scale,
        rear - np.stack([p[2] * p[2], p[2] * p[3], p[3] * p[3]]) * scale,
    )


def _negative_span(span: Span) -> Counts:
    """Return the number of negative eigenvalues of a span's 4 x 4 stiffness at each frequency."""
    reduced, negative = close(span, np.zeros_like(span.rear))
    return negative + negative_pivots(reduced)


def _element(segment: Segment, frequency_hz: FloatArray, structural_damping: float) -> Span:
    """Return the dynamic stiffness of one element that is short enough for the series."""
    transfer = transfer_matrix(segment, frequency_hz, structural_damping)
    (a11, a12), (_, a22) = transfer.motion_from_force
    (y_y, y_t), (t_y, t_t) = transfer.motion_from_motion
    scale = 1.0 / (a11 * a22 + a12 * a12)
    k12 = (a22 * y_t - a12 * t_t) * scale
    front = np.stack([(a22 * y_y - a12 * t_y) * scale, k12, (a12 * y_t + a11 * t_t) * scale])
    rear = np.stack([front[0], -k12, front[2]])
    coupling = a12 * scale
    cross = np.stack([-a22 * scale, coupling, -coupling, -a11 * scale])
    return Span(front, cross, rear)


class Transfer(NamedTuple):
    """Blocks of the transfer matrix over a segment; entries have shape (n,)."""

    motion_from_motion: tuple[tuple[Values, Values], tuple[Values, Values]]
    motion_from_force: tuple[tuple[Values, Values], tuple[Values, Values]]
    force_from_motion: tuple[tuple[Values, Values], tuple[Values, Values]]
    force_from_force: tuple[tuple[Values, Values], tuple[Values, Values]]


def transfer_matrix(segment: Segment, frequency_hz: FloatArray, structural_damping: float = 0.0) -> Transfer:
    """Return the exponential of the state matrix over a segment at frequencies [Hz], shape (n,).

    The state is (y [m], theta [rad]; T [N], B [Nm]). The segment must not be longer than
    `longest_element_m` says.
    """
    omega = 2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
    omega_squared = omega**2
    complex_factor = 1.0 + 1j * structural_damping if structural_damping else 1.0
    length = segment.length_m
    shear = segment.shear_stiffness_n * complex_factor
    load = segment.axial_load_n
    a = 1.0 / (shear - load)
    e = 1.0 / (segment.bending_stiffness_nm2 * complex_factor)
    g = shear * a
    m = segment.mass_kg_per_m * omega_squared
    r = segment.rotary_inertia_kgm * (omega_squared - 2.0 * segment.spin_rad_s * omega) + g * load
    square = length * length
    am, er = a * m * square, e * r * square
    c0, c1, c2, c3 = _coefficients(am + er, e * m * (a * r - g * g) * square * square)
    c2_square = c2 * square
    c3_cube = c3 * length * square
    c1_length = c1 * length
    slope = g * (c1_length - c3 * length * (er + am))
    off = c2_square * (g * e)
    lever = c3_cube * (e * g)
    return Transfer(
        motion_from_motion=((c0 - c2 * am, slope), (lever * m, c0 - c2 * er)),
        motion_from_force=(
            (a * (c1_length - c3 * length * am) - lever * g, off),
            (-off, e * (c1_length - c3 * length * er)),
        ),
        force_from_motion=(
            (-m * (c1_length - c3 * length * am), -c2_square * m * g),
            (c2_square * m * g, -r * (c1_length - c3 * length * er) + c3_cube * m * (g * g)),
        ),
        force_from_force=((c0 - c2 * am, -lever * m), (-slope, c0 - c2 * er)),
    )


def _coefficients(b: Values, c: Values) -> tuple[Values, Values, Values, Values]:
    """Return C0 to C3 of the exponential for p^2 + b p + c = 0, p made dimensionless by the squared length.

    C2 and C3 are the divided differences of cosh(sqrt p) and sinh(sqrt p)/sqrt p at the two values;
    the complete symmetric polynomials in them follow from b and c by a recurrence. C0 and C1 are
    those functions minus p times the difference, whose terms follow from the same polynomials.
    """
    before, now = np.zeros_like(b), np.ones_like(b)
    c0, c1 = np.ones_like(b), np.ones_like(b)
    c2, c3 = np.full_like(b, 0.5), np.full_like(b, 1.0 / 6.0)
    factorial = 2.0
    for power in range(2, SERIES_TERMS):
        before, now = now, -b * now - c * before
        even = 1.0 / (factorial * (2 * power - 1) * (2 * power))
        odd = even / (2 * power + 1)
        factorial = 1.0 / even
        c2 = c2 + now * even
        c3 = c3 + now * odd
        remainder = c * before
        c0 = c0 - remainder * even
        c1 = c1 - remainder * odd
    return c0, c1, c2, c3


def join(first: Span, second: Span) -> tuple[Span, Counts]:
    """Return two spans joined rigidly end to end, their common node condensed (4-31 in stiffness form).

    Result: the joined span, and the number of negative pivots of the common node, shape (n,), which counts natural
    frequencies (zeros where the values are complex).

    `first` and `second`: the spans; the rear of the first is joined to the front of the second.
    """
    pivot = first.rear + second.front
    determinant = pivot[0] * pivot[2] - pivot[1] * pivot[1]
    inverse = np.stack([pivot[2], -pivot[1], pivot[0]]) / determinant
    fa, fb, fc, fd = first.cross
    sa, sb, sc, sd = second.cross
    la, lb = fa * inverse[0] + fb * inverse[1], fa * inverse[1] + fb * inverse[2]
    lc, ld = fc * inverse[0] + fd * inverse[1], fc * inverse[1] + fd * inverse[2]
    front = first.front - np.stack([la * fa + lb * fb, la * fc + lb * fd, lc * fc + ld * fd])
    cross = -np.stack([la * sa + lb * sc, la * sb + lb * sd, lc * sa + ld * sc, lc * sb + ld * sd])
    ra, rb = inverse[0] * sa + inverse[1] * sc, inverse[0] * sb + inverse[1] * sd
    rc, rd = inverse[1] * sa + inverse[2] * sc, inverse[1] * sb + inverse[2] * sd
    rear = second.rear - np.stack([sa * ra + sc * rc, sa * rb + sc * rd, sb * rb + sd * rd])
    return Span(front, cross, rear), negative_pivots(pivot, determinant)


def close(span: Span, rear_stiffness: Values) -> tuple[Values, Counts]:
    """Return the stiffness at the front of a span whose rear end is held by another stiffness.

    Result: stiffness at the front as rows (11, 12, 22), shape (3, n), and the number of negative pivots of the rear
    end, shape (n,) (zeros where the values are complex).

    `span`: the span. `rear_stiffness`: what holds its rear end, as rows (11, 12, 22), shape (3, n) or (3, 1); zeros:
    nothing.
    """
    pivot = span.rear + rear_stiffness
    determinant = pivot[0] * pivot[2] - pivot[1] * pivot[1]
    scale = 1.0 / determinant
    a, b, c, d = span.cross
    through = np.stack(
        [
            a * a * pivot[2] - 2.0 * a * b * pivot[1] + b * b * pivot[0],
            a * c * pivot[2] - (a * d + b * c) * pivot[1] + b * d * pivot[0],
            c * c * pivot[2] - 2.0 * c * d * pivot[1] + d * d * pivot[0],
        ]
    )
    return span.front - through * scale, negative_pivots(pivot, determinant)


def negative_pivots(pivot: Values, determinant: Values | None = None) -> Counts:
    """Return the number of negative eigenvalues of symmetric 2 x 2 matrices, rows (11, 12, 22), shape (3, n)."""
    if np.iscomplexobj(pivot):
        return np.zeros(pivot.shape[1], dtype=np.int64)
    if determinant is None:
        determinant = pivot[0] * pivot[2] - pivot[1] * pivot[1]
    both = (determinant > 0.0) & (pivot[0] + pivot[2] < 0.0)
    return np.where(determinant < 0.0, 1, np.where(both, 2, 0)).astype(np.int64)
