"""A shaft that turns: its whirls, and the receptance at its front in both axes, with gyroscopic moments.

Displacements along X and Y make two circular motions, p = x + j y and q = x - j y. A round shaft keeps them apart: each
has the dynamic stiffness of one plane with the rotation in or against its sense (`models.dynamics.beam`). Bearings that
differ between the axes couple them by half their difference. The spindle turns clockwise seen from above (M3), so p
goes against it.

Structural damping acts as if it stood still; in truth that of the shaft turns with it, which matters above the first
natural frequency only.
"""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from models.dynamics.assembly import SpindleAssembly
from models.dynamics.beam import ComplexArray, Segment, Span, close
from models.dynamics.chain import Chain, Part, chain_span, divide
from models.dynamics.modes import natural_frequencies, rigid_body_modes
from models.records import FloatArray


def spinning(chain: Chain, spin_rad_s: float) -> Chain:
    """Return a chain that turns in the sense of the whirl [rad/s]; raises ValueError with `published` inertia."""
    parts = tuple(replace(part, spin_rad_s=spin_rad_s) if isinstance(part, Segment) else part for part in chain.parts)
    return replace(chain, parts=parts)


def whirl_frequencies(chain: Chain, speed_rpm: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the lowest natural frequencies [Hz] of the whirls against and with the rotation, shapes (count,).

    Of both as many as each has below the end of the search. Raises ValueError when the chain can drift or tilt without
    being held (its slow precessions are no modes), or with `published` inertia.

    `chain`: the chain on its bearings, which are taken to be alike in both axes. `speed_rpm`: speed of the shaft
    [1/min]. `count`: how many of each.
    """
    if rigid_body_modes(chain):
        raise ValueError(
            "a shaft that turns and drifts or tilts freely has precessions, no whirls; it needs bearings at two "
            "places, or one with a rotational stiffness"
        )
    spin = speed_rpm * math.pi / 30.0
    against, along = (natural_frequencies(spinning(chain, sense * spin), count) for sense in (-1.0, 1.0))
    both = min(len(against), len(along))
    return against[:both], along[:both]


def rotating_receptance(
    along_x: SpindleAssembly, along_y: SpindleAssembly, speed_rpm: float, frequency_hz: FloatArray
) -> ComplexArray:
    """Return the receptance at the front [m/N], shape (n, 2, 2): displacement X, Y per force X, Y of the machine.

    Raises ValueError when the two assemblies are not the same shaft with bearings at the same places, or with
    `published` inertia.

    `along_x`, `along_y`: the spindle with what is clamped, as each axis sees it: only the bearings' properties may
    differ. `speed_rpm`: speed of the spindle, clockwise seen from above [1/min]. `frequency_hz`: frequencies [Hz],
    shape (n,), positive.
    """
    chains = along_x.whole(), along_y.whole()
    if chains[0].parts != chains[1].parts or _places(chains[0]) != _places(chains[1]):
        raise ValueError(
            "the spindles of X and Y differ in more than the properties of their bearings; a shaft that turns is one: "
            "give both axes the same sections, joints, damping and positions"
        )
    spin = speed_rpm * math.pi / 30.0
    nodes, against = _stiffness(spinning(chains[0], -spin), frequency_hz)
    _, along = _stiffness(spinning(chains[0], spin), frequency_hz)
    size = against.shape[1]
    total = np.zeros((len(frequency_hz), 2 * size, 2 * size), dtype=np.complex128)
    total[:, :size, :size], total[:, size:, size:] = against, along
    for node, each_x, each_y in zip(nodes, chains[0].supports, chains[1].supports, strict=True):
        rows_x = each_x.properties.stiffness(frequency_hz, damped=True)
        rows_y = each_y.properties.stiffness(frequency_hz, damped=True)
        for place, row in enumerate((0, 2)):
            mean, half = (rows_x[row] + rows_y[row]) / 2.0, (rows_x[row] - rows_y[row]) / 2.0
            at = 2 * node + place
            total[:, at, at] += mean
            total[:, size + at, size + at] += mean
            total[:, at, size + at] += half
            total[:, size + at, at] += half
    forces = np.zeros((2 * size, 2), dtype=np.complex128)
    forces[0], forces[size] = (1.0, 1j), (1.0, -1j)
    moved = np.linalg.solve(total, np.broadcast_to(forces, (len(frequency_hz), *forces.shape)))
    p, q = moved[:, 0], moved[:, size]
    found: ComplexArray = np.stack(((p + q) / 2.0, (p - q) / 2j), axis=1)
    return found


def _places(chain: Chain) -> list[float]:
    return [support.position_m for support in chain.supports]


def _stiffness(chain: Chain, frequency_hz: FloatArray) -> tuple[list[int], ComplexArray]:
    """Return the node of each support, and the stiffness of front and supports of the bare chain, (n, 2 m, 2 m)."""
    parts, ends = divide(chain, [support.position_m for support in chain.supports])
    stops = sorted({0, *ends})
    total = np.zeros((len(frequency_hz), 2 * len(stops), 2 * len(stops)), dtype=np.complex128)
    for number, (first, last) in enumerate(pairwise(stops)):
        _add(total, 2 * number, chain_span(parts[first:last], frequency_hz, damped=True))
    tail: list[Part] = parts[stops[-1] :]
    if tail:
        nothing = np.zeros((3, len(frequency_hz)), dtype=np.complex128)
        rows, _ = close(chain_span(tail, frequency_hz, damped=True), nothing)
        _add_end(total, 2 * (len(stops) - 1), rows)
    return [stops.index(end) for end in ends], total


def _add(total: ComplexArray, at: int, span: Span) -> None:
    """Add a span between the node at a row and the next one."""
    _add_end(total, at, np.asarray(span.front))
    _add_end(total, at + 2, np.asarray(span.rear))
    for number, values in enumerate(span.cross):
        row, column = at + number // 2, at + 2 + number % 2
        total[:, row, column] += values
        total[:, column, row] += values


def _add_end(total: ComplexArray, at: int, rows: ComplexArray) -> None:
    total[:, at, at] += rows[0]
    total[:, at, at + 1] += rows[1]
    total[:, at + 1, at] += rows[1]
    total[:, at + 1, at + 1] += rows[2]
