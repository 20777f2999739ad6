"""What holds a tool, from impact tests on a plain cylinder in its place (receptance coupling turned round).

A blank, a cylinder of known material, is clamped instead of the tool and hit at its tip and at a second point.
Its own receptance is known exactly (`models.dynamics.beam`), so that what is left is the spindle with its holder,
rotation included, at the face of the holder. Any tool of the same shank is then coupled to it: one test serves
them all. After Schmitz and Duncan (2005), but with the response at the second point measured too, so that the
rotational receptance follows and need not be assumed.
"""

import numpy as np

from models.dynamics.beam import ComplexArray, Segment, Span, close, segment_span
from models.dynamics.bearings import inverse_rows
from models.dynamics.chain import Part, chain_span
from models.errors import IdentificationError
from models.records import FloatArray

Y_TIP, Y_SECOND = 0, 2
ROOT = (4, 5)


def held_stiffness(
    blank: Segment, second_m: float, frequency_hz: FloatArray, measured_m_per_n: ComplexArray
) -> ComplexArray:
    """Return the dynamic stiffness that the blank was held by, at its rear end.

    Result: rows (11, 12, 22), shape (3, n) [N/m, N/rad, Nm/rad]: force and moment per displacement and rotation.
    With the free blank's receptances R between tip and second point (y) and rear end (r), and the measured M,
    G = R_ry (R_yy - M)^-1 R_yr - R_rr is the receptance of what holds it; its inverse is returned. Raises
    IdentificationError when shapes differ, the second point lies outside the blank, or responses leave nothing to
    tell at a frequency, which is named.

    `blank`: what stands out of the holder. `second_m`: distance of the second point from the tip [m], above 0 and below
    the blank's length. `frequency_hz`: frequencies [Hz], shape (n,), positive. `measured_m_per_n`: receptance at the
    tip, between tip and second point, at the second point, shape (3, n) [m/N].
    """
    if not 0.0 < second_m < blank.length_m:
        raise IdentificationError(
            f"the second point, {second_m * 1e3:g} mm from the tip, lies outside the blank of "
            f"{blank.length_m * 1e3:g} mm; measure between tip and holder"
        )
    if measured_m_per_n.shape != (3, len(frequency_hz)):
        raise IdentificationError("three responses at the same frequencies are needed: tip, cross and second point")
    free = _free_receptance(blank, second_m, frequency_hz)
    points, root = [Y_TIP, Y_SECOND], list(ROOT)
    tip, cross, second = measured_m_per_n
    measured = np.moveaxis(np.array([[tip, cross], [cross, second]]), 2, 0)
    left = free[:, points][:, :, points] - measured
    if not np.all(np.isfinite(left)) or (lost := np.abs(np.linalg.det(left)) == 0.0).any():
        at = frequency_hz[int(np.argmax(lost))] if np.all(np.isfinite(left)) else frequency_hz[0]
        raise IdentificationError(f"at {at:g} Hz the responses are those of a free blank; measure it in the holder")
    towards = free[:, root][:, :, points]
    held = towards @ np.linalg.solve(left, np.swapaxes(towards, 1, 2)) - free[:, root][:, :, root]
    rows = np.stack([held[:, 0, 0], (held[:, 0, 1] + held[:, 1, 0]) / 2.0, held[:, 1, 1]])
    return inverse_rows(rows)


def tool_point_receptance(tool: tuple[Part, ...], held: ComplexArray, frequency_hz: FloatArray) -> ComplexArray:
    """Return the receptance at the tip of a tool in the same holder [m/N], shape (n,).

    `tool`: what stands out of the holder, from the tip backwards. `held`: from `held_stiffness`, shape (3, n).
    `frequency_hz`: its frequencies [Hz].
    """
    a, b, d = close(chain_span(list(tool), frequency_hz, damped=True), held)[0]
    return np.asarray(d / (a * d - b * b), dtype=np.complex128)


def _free_receptance(blank: Segment, second_m: float, frequency_hz: FloatArray) -> ComplexArray:
    """Return the receptances of the free blank between tip, second point and rear end, shape (n, 6, 6)."""
    spans = [
        segment_span(blank.cut(length), frequency_hz, damped=True)[0]
        for length in (second_m, blank.length_m - second_m)
    ]
    stiffness = np.zeros((len(frequency_hz), 6, 6), dtype=np.complex128)
    for at, span in zip((0, 2), spans, strict=True):
        stiffness[:, at : at + 4, at : at + 4] += _matrix(span)
    return np.asarray(np.linalg.inv(stiffness), dtype=np.complex128)


def _matrix(span: Span) -> ComplexArray:
    """Return a span's dynamic stiffness, shape (n, 4, 4)."""
    matrix = np.zeros((span.front.shape[1], 4, 4), dtype=np.complex128)
    for block, at in ((span.front, 0), (span.rear, 2)):
        matrix[:, at, at], matrix[:, at + 1, at + 1] = block[0], block[2]
        matrix[:, at, at + 1] = matrix[:, at + 1, at] = block[1]
    matrix[:, :2, 2:] = np.moveaxis(span.cross.reshape(2, 2, -1), 2, 0)
    matrix[:, 2:, :2] = np.swapaxes(matrix[:, :2, 2:], 1, 2)
    return matrix
