"""Fits parameters of a model to a measured frequency response, and says which of them the data see.

Least squares of ``log(H / H_meas)`` with exact derivatives in a trust region (SciPy's descendant of Levenberg and
Marquardt's method), or Nelder and Mead's simplex on the dissertation's cost (4-36). Both vary the logarithms of the
parameters, so that no property becomes negative.
A parameter's kind is what its name begins with: kt, ct, kr or cr.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.dynamics.beam import ComplexArray
from models.errors import IdentificationError
from models.records import FloatArray

BOUNDS = {"kt": (1e-6, 1e13), "ct": (1e-12, 1e9), "kr": (1e-6, 1e11), "cr": (1e-15, 1e7)}
"""Range in which each kind of parameter is looked for [N/m, N s/m, N m/rad, N m s/rad]."""
PLAUSIBLE = {"kt": 1e10, "ct": 1e7, "kr": 1e9, "cr": 1e6}
"""Values above these are no bearing's: the data do not bound the parameter, or the model is another machine's."""
ASSUMED_ERROR = 0.01
"""Relative error of an FRF that is assumed where the fit itself is better."""
IDENTIFIABLE = 0.5
"""A parameter is identifiable when an error of that size, the same way at all frequencies, moves its
logarithm by less than this."""
GOOD_FIT = 0.03
"""Root mean square of the log ratio below which no other start is tried, where the noise is not larger."""
NOISE_MARGIN = 1.2
"""A fit that is this many times as bad as the noise is taken for good, too."""
LARGEST_NOISE = 0.15
"""Scatter that is taken for noise at most."""
RAYLEIGH_MEDIAN = 1.1774
"""Median of the size of a complex number whose parts scatter by 1."""
MOST_EVALUATIONS = 200
"""Of the response, from one start."""
SEARCH_POINTS = 128
"""Points of parameter space at which the fit is looked at, to find further starts."""
SEARCH_STARTS = 8
"""How many of them a descent begins at."""
SEARCH_RANGE = {"kt": (1e6, 1e9), "ct": (3.0, 1e5), "kr": (3e3, 3e7), "cr": (1e-2, 1e3)}
"""Where further starts are looked for, by kind of parameter, in SI units."""
NELDER_MEAD_EVALUATIONS = 1600


@dataclass(frozen=True, slots=True, kw_only=True)
class Identified:
    """What was found."""

    values: dict[str, float]
    """All parameters by name, the fixed ones among them, in SI units."""
    free: tuple[str, ...]
    """The parameters that were varied."""
    cost_m_per_n: float
    """S_cf of 4-36: the sum of |H_meas - H| over the frequencies [m/N]."""
    log_error: float
    """Root mean square of |log(H / H_meas)|."""
    evaluations: int
    """How often the response was computed."""
    log_deviation: dict[str, float]
    """How far the logarithm of each free parameter may be off, see `ASSUMED_ERROR`; inf: any value fits."""
    identifiable: dict[str, bool]
    """Whether the data see each free parameter (`IDENTIFIABLE`)."""
    implausible: tuple[str, ...]
    """Free parameters with a value that no bearing has, or at the end of the range looked through."""


Model = Callable[[Mapping[str, float]], tuple[ComplexArray, Mapping[str, ComplexArray]]]
"""Values of the parameters -> response and its derivative by each of them, shape (n,)."""
Response = Callable[[Mapping[str, float]], ComplexArray]
"""Values of the parameters -> response, shape (n,)."""


def good_fit(measured: ComplexArray) -> float:
    """Return the root mean square of the log ratio below which a fit cannot be told from a perfect one.

    The noise is what third differences of the response's logarithm along the frequency leave: a smooth curve leaves
    nothing, neighbours that scatter by one leave the root of twenty. The median keeps sharp resonances out of it.

    `measured`: evenly spaced response, shape (n,).
    """
    if len(measured) < 8:
        return GOOD_FIT
    ratio = np.log(measured[1:] / measured[:-1])
    scatter = float(np.median(np.abs(np.diff(ratio, 2)))) / (RAYLEIGH_MEDIAN * np.sqrt(20.0))
    return float(max(GOOD_FIT, NOISE_MARGIN * min(np.sqrt(2.0) * scatter, LARGEST_NOISE)))


def cost_of_source(measured: ComplexArray, computed: ComplexArray) -> float:
    """Return S_cf of 4-36 [m/N]; the dissertation calls it least squares, but it sums |dH|."""
    return float(np.sum(np.abs(measured - computed)))


@dataclass(frozen=True, slots=True)
class Descent:
    """Where a search ended."""

    values: dict[str, float]
    log_error: float
    evaluations: int


def least_squares_fit(
    model: Model,
    measured: ComplexArray,
    free: Sequence[str],
    begin: Mapping[str, float],
    table: Mapping[str, float] | None = None,
) -> Descent:
    """Return the parameters that minimise the squares of log(H / H_meas), varied by their logarithms.

    When the told start ends in a poor fit, another one (`table`) and the best of `SEARCH_POINTS`
    evenly spread points are tried; the best descent counts.

    Parameters
    ----------
    model
        Response and derivatives.
    measured
        Measured response, shape (n,).
    free
        Names of the parameters to vary.
    begin
        Where to begin, by name.
    table
        Another start to try, by name.

    """
    best, good = descend(model, measured, free, begin, MOST_EVALUATIONS), good_fit(measured)
    if best.log_error < good:
        return best
    evaluations, starts = _starts(model, measured, free, {**begin, **(table or {})})
    evaluations += best.evaluations
    for start in starts:
        found = descend(model, measured, free, start, MOST_EVALUATIONS)
        evaluations += found.evaluations
        best = found if found.log_error < best.log_error else best
        if best.log_error < good:
            break
    return Descent(best.values, best.log_error, evaluations)


def _starts(
    model: Model, measured: ComplexArray, free: Sequence[str], begin: Mapping[str, float]
) -> tuple[int, list[dict[str, float]]]:
    """Return further starts, the most promising first, and how often the response was computed for them."""
    ends = np.log([SEARCH_RANGE.get(name.partition("_")[0], BOUNDS["kt"]) for name in free])
    points = ends[:, 0] + evenly_spread(SEARCH_POINTS, len(free)) * (ends[:, 1] - ends[:, 0])
    fits = []
    for point in points:
        residual, _ = _residual(model, measured, free, point)
        fits.append(float(np.mean(np.abs(residual))))
    order = np.argsort(fits, kind="stable")[:SEARCH_STARTS]
    told = {name: begin[name] for name in free}
    return len(points), [told, *(dict(zip(free, np.exp(points[k]).tolist(), strict=True)) for k in order)]


def evenly_spread(points: int, dimensions: int) -> FloatArray:
    """Return points of the unit cube that lie evenly (additive recurrence of the generalised golden ratio).

    Shape (points, dimensions), from 0 to 1.
    """
    ratio = 2.0
    for _ in range(40):
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    steps = ratio ** -np.arange(1, dimensions + 1)
    return np.asarray((0.5 + np.outer(np.arange(1, points + 1), steps)) % 1.0)


def _limits(free: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    ends = np.log([BOUNDS[name.partition("_")[0]] for name in free])
    return ends[:, 0], ends[:, 1]


def descend(
    model: Model, measured: ComplexArray, free: Sequence[str], start: Mapping[str, float], most: int
) -> Descent:
    """Return where the method of `least_squares_fit` ends from one start, with `most` evaluations at most."""
    from scipy.optimize import least_squares

    low, high = _limits(free)
    at = np.clip(np.log([max(start[name], 1e-300) for name in free]), low + 1e-9, high - 1e-9)
    seen: list[tuple[FloatArray, npt.NDArray[np.float64]]] = []

    def residual(log_values: FloatArray) -> FloatArray:
        """Return the residual, and keep the derivative, which costs nothing beside it."""
        seen[:] = [_residual(model, measured, free, log_values)]
        return seen[0][0]

    try:
        done = least_squares(
            residual, at, jac=lambda _: seen[0][1], bounds=(low, high), x_scale="jac", max_nfev=most,
            ftol=1e-10, xtol=1e-10, gtol=1e-15,
        )  # fmt: skip
    except ValueError:  # no finite response, or no finite derivative
        return Descent(dict(zip(free, np.exp(at).tolist(), strict=True)), np.inf, 1)
    values = dict(zip(free, np.exp(done.x).tolist(), strict=True))
    return Descent(values, float(np.sqrt(2.0 * done.cost / len(measured))), int(done.nfev))


def _residual(
    model: Model, measured: ComplexArray, free: Sequence[str], log_values: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.float64]]:
    """Return log(H / H_meas), real and imaginary parts in a row, and its derivative by the logarithms."""
    values = dict(zip(free, np.exp(log_values).tolist(), strict=True))
    computed, slopes = model(values)
    ratio = np.log(computed / measured)
    columns = np.stack([slopes[name] * values[name] / computed for name in free], axis=1)
    return np.concatenate([ratio.real, ratio.imag]), np.concatenate([columns.real, columns.imag])


def nelder_mead(
    response: Response,
    measured: ComplexArray,
    free: Sequence[str],
    begin: Mapping[str, float],
) -> Descent:
    """Return the minimum of 4-36 by the simplex method, run twice, the second time from where the first ended."""
    from scipy.optimize import minimize

    low, high = _limits(free)
    size = float(np.sum(np.abs(measured)))

    def cost(log_values: FloatArray) -> float:
        """Return the cost of equation 4-36 for the logarithms of the parameters."""
        values = dict(zip(free, np.exp(np.clip(log_values, low, high)).tolist(), strict=True))
        return cost_of_source(measured, response(values)) / size

    at, evaluations = np.clip(np.log([max(begin[name], 1e-300) for name in free]), low, high), 0
    for _ in range(2):
        options = {"maxfev": NELDER_MEAD_EVALUATIONS // 2, "xatol": 1e-7, "fatol": 1e-9, "adaptive": len(free) > 7}
        simplex = np.vstack([at, at + 0.5 * np.eye(len(free))])
        done = minimize(cost, at, method="Nelder-Mead", options={**options, "initial_simplex": simplex})
        at, evaluations = np.clip(done.x, low, high), evaluations + int(done.nfev)
        if done.fun < 1e-7:
            break
    values = dict(zip(free, np.exp(at).tolist(), strict=True))
    ratio = np.log(response(values) / measured)
    return Descent(values, float(np.sqrt(np.mean(np.abs(ratio) ** 2))), evaluations)


def report(
    model: Model, measured: ComplexArray, values: Mapping[str, float], free: Sequence[str], evaluations: int
) -> Identified:
    """Return what was found with its cost and with what the data say about each parameter.

    Raises IdentificationError when a value or the response it gives is not finite.
    """
    computed, _ = model(values)
    if not np.isfinite(computed).all():
        raise IdentificationError("the identified properties give no finite response; start from other values")
    at = np.log([max(values[name], 1e-300) for name in free])
    residual, jacobian = _residual(lambda some: model({**values, **some}), measured, free, at)
    log_error = float(np.sqrt(residual @ residual / len(measured)))
    deviation = _log_deviation(jacobian, len(measured), max(log_error, ASSUMED_ERROR))
    low, high = _limits(free)
    implausible = tuple(
        name
        for name, place, bottom, top in zip(free, at, low, high, strict=True)
        if values[name] > PLAUSIBLE[name.partition("_")[0]] or place <= bottom + 1e-9 or place >= top - 1e-9
    )
    return Identified(
        values={name: float(value) for name, value in values.items()},
        free=tuple(free),
        cost_m_per_n=cost_of_source(measured, computed),
        log_error=log_error,
        evaluations=evaluations,
        log_deviation=dict(zip(free, deviation.tolist(), strict=True)),
        identifiable={name: bool(size < IDENTIFIABLE) for name, size in zip(free, deviation, strict=True)},
        implausible=implausible,
    )


def _log_deviation(jacobian: npt.NDArray[np.float64], lines: int, error: float) -> FloatArray:
    """Return how far each logarithm moves when the response is off by `error`, parameters compensating."""
    _, singular, right = np.linalg.svd(jacobian / np.sqrt(lines), full_matrices=False)
    with np.errstate(divide="ignore"):
        spread = np.where(singular > 1e-12 * singular.max(initial=0.0), error / singular, np.inf)
    weights = np.abs(right.T) > 1e-8
    moved = np.where(weights, np.abs(right.T) * np.where(np.isinf(spread), 0.0, spread), 0.0)
    total = np.sqrt(np.square(moved).sum(axis=1))
    unseen = (weights & np.isinf(spread)[None, :]).any(axis=1)
    return np.where(unseen, np.inf, total)
