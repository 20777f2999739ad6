"""Stability lobes by the zeroth-order solution (equations 5-2 to 5-8 of the dissertation).

With lambda an eigenvalue of [a][H(j w_c)], Lambda = -1/lambda, and 5-6 to 5-8 become
``depth = 1 / (K_tc Re lambda)``, ``eps = 2 atan2(Re lambda, -Im lambda)`` and
``speed = 60 w_c / (n_T (2 pi k + eps))``; only Re lambda > 0 gives a depth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.lobes import FEED_STEP_DEG, LobeMinimum, StabilityLobes, check_lines, check_range
from models.stability.milling import Cut, mean_directional_matrix, tooth_passing_hz
from models.stability.response import ComplexArray, SampledResponse, ToolPointResponse, check_finite, feed_rotation
from models.units import mm_from_m

ZOOM_POINTS = 33
ZOOM_ROUNDS = 4
NEXT_TO_ZERO = 1e-9
MOST_LOBES = 20_000
"""Above so many lobes the speed is too low to mill at."""
MOST_REFINED = 8
"""So many of the highest peaks are looked at between the samples; noise has more."""
NEARBY = 1e-3
"""Envelopes take two speeds at least; beside a single one lies another this share above it."""
NEAR_RANGE = 1.02
"""A peak between samples may belong to a speed this much beyond that of its highest sample."""
RISE_BETWEEN_SAMPLES = 1.1
"""A peak between samples is at most this much higher than its highest sample."""
CERTAIN_SHARE, FLIP_SHARE = 0.8, 0.4
"""Shares of the zeroth-order depth that are stable for certain: above several waves from tooth to tooth, and below."""
MANY_WAVES = 2.0
"""Where a vibration has fewer waves from tooth to tooth, flip lobes lie far below those of the zeroth order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Branch:
    """One eigenvalue followed over frequency."""

    frequency_hz: FloatArray
    eigenvalue: ComplexArray


def zeroth_order_lobes(
    response: ToolPointResponse,
    cut: Cut,
    *,
    from_rpm: float,
    to_rpm: float,
    points: int,
    feed_deg: float = 0.0,
) -> StabilityLobes:
    """Return the lobes between two spindle speeds.

    Result: the lower envelope and its exact minimum. Raises StabilityError when the range is none, the FRF does not
    cover the tooth-passing band or holds a value that is not finite, or nothing can chatter.

    `response`: receptance at the tool point in machine axes. `cut`: engagement and cutting coefficients. `from_rpm`,
    `to_rpm`: range of speeds [1/min]. `points`: number of evenly spaced speeds. `feed_deg`: direction of the feed
    against X [deg].
    """
    return _lobes(response, cut, (from_rpm, to_rpm, points), (feed_deg,))


def lowest_over_feed_directions(
    response: ToolPointResponse, cut: Cut, *, from_rpm: float, to_rpm: float, points: int
) -> StabilityLobes:
    """Return, at each speed, the lowest lobes over feed directions `FEED_STEP_DEG` apart.

    `feed_deg` of the result is the direction with the lowest minimum. Opposite directions are
    equal. Parameters and errors are those of `zeroth_order_lobes`.
    """
    feeds = tuple(np.arange(0.0, 180.0, FEED_STEP_DEG).tolist())
    return _lobes(response, cut, (from_rpm, to_rpm, points), feeds)


def limiting_depth(
    response: ToolPointResponse, cut: Cut, *, speed_rpm: float, feed_deg: float = 0.0
) -> tuple[float, float]:
    """Return the limiting depth [mm] at one speed [1/min] and the frequency of its chatter [Hz].

    Result: inf and NaN where no lobe has this speed. Else as `zeroth_order_lobes`.
    """
    (direction,) = _directions(response, cut, np.array([speed_rpm, speed_rpm * (1.0 + NEARBY)]), (feed_deg,))[0]
    return mm_from_m(float(direction.depth_m[0])), float(direction.chatter_hz[0])


def depth_at_any_speed(
    response: SampledResponse, cut: Cut, *, feeds_deg: Sequence[float], highest_rpm: float
) -> tuple[float, float]:
    """Return the depth [mm] up to which no speed chatters, and where the first would [Hz]; inf and NaN if none can.

    The lower of two: a share of the lowest point of the zeroth-order lobes, and the depth of the whole cutting force,
    without projection, on as many teeth as cut on average along the most negative real part of either axis.

    `response`: receptance at the tool point. `cut`: engagement and cutting coefficients. `feeds_deg`: directions of the
    feed against X [deg]. `highest_rpm`: highest speed [1/min].
    """
    slow = response.frequency_hz < MANY_WAVES * tooth_passing_hz(highest_rpm, cut.teeth)
    shares = np.where(slow, FLIP_SHARE, CERTAIN_SHARE)
    eigenvalues = [_eigenvalues(response.receptance, cut, feed_deg).real.max(axis=1) for feed_deg in feeds_deg]
    teeth_cutting = cut.teeth * (cut.exit_rad - cut.start_rad) / (2.0 * math.pi)
    along = -2.0 * teeth_cutting * math.hypot(1.0, cut.radial_ratio) * response.receptance[:, [0, 1], [0, 1]].real
    real = np.max([*(found / shares for found in eigenvalues), *along.T], axis=0)
    place = int(np.argmax(real))
    if real[place] <= 0.0:
        return math.inf, math.nan
    return mm_from_m(1.0 / (cut.tangential_n_per_m2 * float(real[place]))), float(response.frequency_hz[place])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Direction:
    """The lobes of one feed direction: its eigenvalues and their envelope."""

    feed_deg: float
    branches: tuple[_Branch, _Branch]
    depth_m: FloatArray
    chatter_hz: FloatArray


def _lobes(
    response: ToolPointResponse, cut: Cut, speeds: tuple[float, float, int], feeds_deg: tuple[float, ...]
) -> StabilityLobes:
    """Return the lowest lobes over some feed directions."""
    check_range(*speeds)
    speed_rpm = np.linspace(*speeds)
    directions, warnings = _directions(response, cut, speed_rpm, feeds_deg)
    minimum, feed_deg, at_edge = _minimum(response, cut, directions, speed_rpm)
    if at_edge:
        warnings += (
            f"the lowest depth lies at the edge of the FRF ({minimum.chatter_hz:g} Hz); "
            "a wider band may show a lower one",
        )
    depths = np.array([direction.depth_m for direction in directions])
    lowest, columns = np.argmin(depths, axis=0), np.arange(len(speed_rpm))
    return StabilityLobes(
        speed_rpm=speed_rpm,
        limiting_depth_mm=mm_from_m(depths[lowest, columns]),
        chatter_hz=np.array([direction.chatter_hz for direction in directions])[lowest, columns],
        minimum=minimum,
        feed_deg=feed_deg,
        warnings=warnings,
    )


def _directions(
    response: ToolPointResponse, cut: Cut, speed_rpm: FloatArray, feeds_deg: tuple[float, ...]
) -> tuple[list[_Direction], tuple[str, ...]]:
    """Return the lobes of some feed directions at evenly spaced speeds, and warnings about the band."""
    if cut.beyond_straight:
        raise StabilityError(
            f"the zeroth-order solution knows no {', '.join(cut.beyond_straight)}; add --method sdm, which does"
        )
    slowest_rpm, fastest_rpm = float(speed_rpm[0]), float(speed_rpm[-1])
    warnings: tuple[str, ...] = ()
    if isinstance(response, SampledResponse):
        warnings = check_lines(response.frequency_hz, cut.teeth, slowest_rpm, fastest_rpm)
    frequency_hz = response.frequencies_hz(tooth_passing_hz(fastest_rpm, cut.teeth))
    receptance = response.receptance_m_per_n(frequency_hz)
    check_finite(frequency_hz, receptance)
    directions = []
    for feed_deg in feeds_deg:
        followed = _followed(_eigenvalues(receptance, cut, feed_deg))
        first, second = (_branch(frequency_hz, column) for column in followed.T)
        depth_m, chatter_hz = _envelope((first, second), cut, speed_rpm)
        directions.append(
            _Direction(feed_deg=feed_deg, branches=(first, second), depth_m=depth_m, chatter_hz=chatter_hz)
        )
    return directions, warnings


def _eigenvalues(receptance: ComplexArray, cut: Cut, feed_deg: float) -> ComplexArray:
    """Return both eigenvalues of [a][H], shape (n, 2) [m/N], the larger first.

    With R the turn into feed axes, [a] R H R' has the eigenvalues of B H with B = R' [a] R.
    """
    turn = feed_rotation(feed_deg)
    (b_xx, b_xy), (b_yx, b_yy) = (turn.T @ mean_directional_matrix(cut) @ turn).tolist()
    h_xx, h_xy, h_yx, h_yy = receptance[:, 0, 0], receptance[:, 0, 1], receptance[:, 1, 0], receptance[:, 1, 1]
    half_trace = 0.5 * (b_xx * h_xx + b_xy * h_yx + b_yx * h_xy + b_yy * h_yy)
    determinant = (b_xx * b_yy - b_xy * b_yx) * (h_xx * h_yy - h_xy * h_yx)
    root = np.sqrt(half_trace**2 - determinant)
    first = np.where(np.abs(half_trace + root) >= np.abs(half_trace - root), half_trace + root, half_trace - root)
    with np.errstate(divide="ignore", invalid="ignore"):
        second = np.where(first == 0.0, 0.0, determinant / first)
    return np.stack((first, second), axis=1)


def _followed(eigenvalues: ComplexArray) -> ComplexArray:
    """Return the eigenvalues with each column continuous over the rows."""
    before, after = eigenvalues[:-1], eigenvalues[1:]
    straight = np.abs(after - before).sum(axis=1)
    crossed = np.abs(after[:, ::-1] - before).sum(axis=1)
    swapped = np.concatenate(([0], np.cumsum(crossed < straight) % 2)).astype(bool)
    return np.where(swapped[:, None], eigenvalues[:, ::-1], eigenvalues)


def _branch(frequency_hz: FloatArray, eigenvalue: ComplexArray) -> _Branch:
    """Return a branch with a sample where its real part changes sign: there its lobes end, infinitely deep."""
    real = eigenvalue.real
    before = np.flatnonzero((real[:-1] > 0.0) != (real[1:] > 0.0))
    share = real[before] / (real[before] - real[before + 1])
    tiny = NEXT_TO_ZERO * float(np.abs(real).max())
    between_hz = frequency_hz[before] + share * np.diff(frequency_hz)[before]
    imaginary = eigenvalue.imag[before] + share * np.diff(eigenvalue.imag)[before]
    return _Branch(
        frequency_hz=np.insert(frequency_hz, before + 1, between_hz),
        eigenvalue=np.insert(eigenvalue, before + 1, tiny + 1j * imaginary),
    )


def _cycles(eigenvalue: ComplexArray) -> FloatArray:
    """Return eps / 2 pi of 5-7, in 0 to 1."""
    cycles: FloatArray = np.arctan2(eigenvalue.real, -eigenvalue.imag) / math.pi
    return cycles


def _envelope(branches: tuple[_Branch, ...], cut: Cut, speed_rpm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest depth [m] and its frequency [Hz] at evenly spaced speeds."""
    columns, depths, frequencies = [], [], []
    for branch in branches:
        column, depth, frequency = _crossings(branch, cut, speed_rpm)
        columns.append(column)
        depths.append(depth)
        frequencies.append(frequency)
    column, depth, frequency = np.concatenate(columns), np.concatenate(depths), np.concatenate(frequencies)
    deepest_first = np.argsort(-depth, kind="stable")
    lowest = np.full(len(speed_rpm), np.inf)
    chatter = np.full(len(speed_rpm), np.nan)
    lowest[column[deepest_first]] = depth[deepest_first]
    chatter[column[deepest_first]] = frequency[deepest_first]
    return lowest, chatter


def _crossings(branch: _Branch, cut: Cut, speed_rpm: FloatArray) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Return where the lobes of one branch cross the speeds: index of the speed, depth [m], frequency [Hz].

    Between two samples the eigenvalue's real part and eps are taken as linear in frequency.
    """
    positive = np.flatnonzero(branch.eigenvalue.real > 0.0)
    eigenvalue, frequency_hz = branch.eigenvalue[positive], branch.frequency_hz[positive]
    apart = np.diff(positive) != 1
    lobes = 60.0 * branch.frequency_hz[-1] / (cut.teeth * speed_rpm[0])
    if lobes > MOST_LOBES:
        raise StabilityError(
            f"at {speed_rpm[0]:g} 1/min the response has {lobes:.3g} lobes, more than {MOST_LOBES}; begin at a higher "
            "spindle speed"
        )
    highest_lobe = int(lobes)
    numbers = np.arange(highest_lobe + 1.0)[:, None]
    spacing = speed_rpm[1] - speed_rpm[0]
    turning = 60.0 / (cut.teeth * spacing) * frequency_hz
    cycles = _cycles(eigenvalue)
    place = turning / (numbers + cycles) - speed_rpm[0] / spacing
    start, end = place[:, :-1], place[:, 1:]
    first = np.maximum(np.ceil(np.minimum(start, end)), 0.0)
    last = np.minimum(np.floor(np.maximum(start, end)), len(speed_rpm) - 1.0)
    last[:, apart] = -1.0
    lobe, left = np.nonzero(first <= last)
    begins = first[lobe, left].astype(np.intp)
    count = last[lobe, left].astype(np.intp) - begins + 1
    column = np.repeat(begins - np.cumsum(count) + count, count) + np.arange(count.sum())
    left, number = np.repeat(left, count), np.repeat(lobe, count)
    passing_hz = (speed_rpm[0] + spacing * column) * cut.teeth / 60.0
    turned = np.diff(cycles)[left]
    climbed = np.diff(frequency_hz)[left]
    slope = climbed - passing_hz * turned
    ahead = passing_hz * (number + cycles[left]) - frequency_hz[left]
    fraction = np.clip(np.divide(ahead, slope, out=np.zeros(len(column)), where=slope != 0.0), 0.0, 1.0)
    real = eigenvalue.real[left] + fraction * np.diff(eigenvalue.real)[left]
    return column, 1.0 / (cut.tangential_n_per_m2 * real), frequency_hz[left] + fraction * climbed


def _minimum(
    response: ToolPointResponse, cut: Cut, directions: Sequence[_Direction], speed_rpm: FloatArray
) -> tuple[LobeMinimum, float, bool]:
    """Return the lowest point between two speeds, its feed direction, and whether the band of frequencies cuts it off.

    It lies where an eigenvalue's real part is largest, if a lobe has that frequency between the two
    speeds, or else at one of the two.
    """
    range_rpm = float(speed_rpm[0]), float(speed_rpm[-1])
    found: list[tuple[LobeMinimum, float, bool]] = []
    peaks = [
        (float(branch.eigenvalue[peak].real), peak, branch, direction.feed_deg)
        for direction in directions
        for branch in direction.branches
        for peak in _peaks(branch, cut.teeth, range_rpm)
    ]
    peaks.sort(key=lambda entry: -entry[0])
    highest = 0.0
    for sampled, peak, branch, feed_deg in peaks[:MOST_REFINED]:
        if sampled * RISE_BETWEEN_SAMPLES < highest:
            break
        frequency_hz, eigenvalue = _refined(response, cut, branch, feed_deg, peak)
        speed = _fastest_lobe_rpm(frequency_hz, eigenvalue, cut.teeth, range_rpm)
        if speed is not None:
            highest = max(highest, eigenvalue.real)
            depth_mm = mm_from_m(1.0 / (cut.tangential_n_per_m2 * eigenvalue.real))
            place = LobeMinimum(speed_rpm=speed, depth_mm=depth_mm, chatter_hz=frequency_hz)
            found.append((place, feed_deg, peak in (0, len(branch.frequency_hz) - 1)))
    for direction in directions:
        for end in (0, -1):
            if math.isfinite(direction.depth_m[end]):
                place = LobeMinimum(
                    speed_rpm=float(speed_rpm[end]),
                    depth_mm=mm_from_m(float(direction.depth_m[end])),
                    chatter_hz=float(direction.chatter_hz[end]),
                )
                found.append((place, direction.feed_deg, False))
    if not found:
        raise StabilityError(
            f"no lobe reaches {range_rpm[0]:g} to {range_rpm[1]:g} 1/min with this response; widen the range of "
            "speeds or the FRF's band, and check that the FRF is a receptance in m/N"
        )
    return min(found, key=lambda entry: entry[0].depth_mm)


def _peaks(branch: _Branch, teeth: int, range_rpm: tuple[float, float]) -> list[int]:
    """Return the samples where the real part is positive and largest, if a lobe has them near the range of speeds."""
    real = np.concatenate(([-np.inf], branch.eigenvalue.real, [-np.inf]))
    tops = np.flatnonzero((real[1:-1] > 0.0) & (real[1:-1] >= real[:-2]) & (real[1:-1] > real[2:]))
    cycles = _cycles(branch.eigenvalue[tops])
    turning = 60.0 * branch.frequency_hz[tops] / teeth
    numbers = np.maximum(np.ceil(turning / (range_rpm[1] * NEAR_RANGE) - cycles), 0.0)
    return [int(top) for top in tops[turning / (numbers + cycles) >= range_rpm[0] / NEAR_RANGE]]


def _refined(
    response: ToolPointResponse, cut: Cut, branch: _Branch, feed_deg: float, peak: int
) -> tuple[float, complex]:
    """Return frequency [Hz] and eigenvalue [m/N] where the real part is largest, near one sample."""
    last = len(branch.frequency_hz) - 1
    low, high = branch.frequency_hz[max(peak - 1, 0)], branch.frequency_hz[min(peak + 1, last)]
    best_hz, best = float(branch.frequency_hz[peak]), complex(branch.eigenvalue[peak])
    for _ in range(ZOOM_ROUNDS):
        trial_hz = np.linspace(low, high, ZOOM_POINTS)
        both = _eigenvalues(response.receptance_m_per_n(trial_hz), cut, feed_deg)
        nearer = np.argmin(np.abs(both - best), axis=1)
        values = both[np.arange(ZOOM_POINTS), nearer]
        top = int(np.argmax(values.real))
        if values[top].real > best.real:
            best_hz, best = float(trial_hz[top]), complex(values[top])
        low, high = trial_hz[max(top - 1, 0)], trial_hz[min(top + 1, ZOOM_POINTS - 1)]
    return best_hz, best


def _fastest_lobe_rpm(
    frequency_hz: float, eigenvalue: complex, teeth: int, range_rpm: tuple[float, float]
) -> float | None:
    """Return the highest speed within a range at which a lobe has this frequency (5-8)."""
    cycles = math.atan2(eigenvalue.real, -eigenvalue.imag) / math.pi
    number = max(math.ceil(60.0 * frequency_hz / (teeth * range_rpm[1]) - cycles - 1e-12), 0)
    speed_rpm = 60.0 * frequency_hz / (teeth * (number + cycles))
    return speed_rpm if range_rpm[0] <= speed_rpm <= range_rpm[1] * (1.0 + 1e-12) else None
