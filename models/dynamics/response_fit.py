"""Fits parameters of a model to a measured frequency response, and says which of them the data see.

Least squares of ``log(H / H_meas)`` with exact derivatives in a trust region (SciPy's descendant of Levenberg and
Marquardt's method), or Nelder and Mead's simplex on the dissertation's cost (4-36). Both vary the logarithms of the
parameters, so that no property becomes negative. Lines that noise covers, as at antiresonances, count less.
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
NOISE_WINDOW = 15
"""Lines over which the noise of a line is taken."""
QUIET_PERCENTILE = 25.0
"""Percentile of the relative noise; lines with more of it count less."""
LEAST_RELATIVE_NOISE = 0.01
"""Relative noise below which all lines count alike."""
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
    """Root mean square of |log(H / H_meas)|, lines that noise covers counting less (`line_weights`)."""
    evaluations: int
    """How often the response was computed at all frequencies."""
    log_deviation: dict[str, float]
    """How far the logarithm of each free parameter may be off, see `ASSUMED_ERROR`; inf: any value fits."""
    interval: dict[str, tuple[float, float]]
    """Range of each free parameter that fits about as well: twice its deviation, around this set of values and every
    other that fits as well; 0 and inf where nothing bounds it, in SI units."""
    identifiable: dict[str, bool]
    """Whether the data see each free parameter (`IDENTIFIABLE`), and no other set of values that fits differs in it."""
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


def line_weights(measured: ComplexArray) -> FloatArray:
    """Return how much each line of a response counts, shape (n,), at most 1.

    The logarithm of a line whose noise is r times its size scatters by r, so its weight is 1 / sqrt(1 + (r / r_0)^2),
    r_0 being the noise of the quiet lines. The noise of a line is the median, over its neighbours, of what third
    differences leave. Noise that grows with the response, and none, leave all weights equal.

    `measured`: evenly spaced response, shape (n,).
    """
    lines = len(measured)
    if lines < 4 * NOISE_WINDOW:
        return np.ones(lines)
    left = np.abs(np.diff(measured, 3)) / np.sqrt(20.0)
    left = np.concatenate([left[:1], left, left[-2:]])
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(left, NOISE_WINDOW // 2, mode="edge"), NOISE_WINDOW)
    noise = np.median(windows, axis=1) * (np.sqrt(2.0) / RAYLEIGH_MEDIAN)
    relative = noise / np.abs(measured)
    quiet = max(float(np.percentile(relative, QUIET_PERCENTILE)), LEAST_RELATIVE_NOISE)
    weight = 1.0 / np.sqrt(1.0 + np.square(relative / quiet))
    return np.asarray(weight / weight.max())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    """A measured response and the model that is fitted to it."""

    model: Model
    measured: ComplexArray
    """Shape (n,)."""
    weight: FloatArray
    """How much each line counts, shape (n,)."""
    free: tuple[str, ...]
    """The parameters to vary."""

    def residual(self, log_values: FloatArray) -> tuple[FloatArray, npt.NDArray[np.float64]]:
        """Return the weighted log(H / H_meas), real and imaginary parts in a row, and its derivative."""
        values = dict(zip(self.free, np.exp(log_values).tolist(), strict=True))
        computed, slopes = self.model(values)
        ratio = self.weight * np.log(computed / self.measured)
        columns = np.stack([slopes[name] * (values[name] * self.weight / computed) for name in self.free], axis=1)
        return np.concatenate([ratio.real, ratio.imag]), np.concatenate([columns.real, columns.imag])

    def log_error(self, squares: float) -> float:
        """Return the weighted root mean square of |log(H / H_meas)| from the sum of the residual's squares."""
        return float(np.sqrt(squares / np.square(self.weight).sum()))


def problem(model: Model, measured: ComplexArray, free: Sequence[str]) -> Problem:
    """Return the problem of fitting a model to a measured response.

    `measured`: shape (n,). `free`: names of the parameters to vary.
    """
    return Problem(model=model, measured=measured, weight=line_weights(measured), free=tuple(free))


def cost_of_source(measured: ComplexArray, computed: ComplexArray) -> float:
    """Return S_cf of 4-36 [m/N]; the dissertation calls it least squares, but it sums |dH|."""
    return float(np.sum(np.abs(measured - computed)))


@dataclass(frozen=True, slots=True)
class Descent:
    """Where a search ended."""

    values: dict[str, float]
    log_error: float
    evaluations: int
    rivals: tuple[dict[str, float], ...] = ()
    """Other sets of values that fit as well."""


def _limits(free: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    ends = np.log([BOUNDS[name.partition("_")[0]] for name in free])
    return ends[:, 0], ends[:, 1]


def descend(task: Problem, start: Mapping[str, float], most: int) -> Descent:
    """Return where least squares of the log ratio end from one start, with `most` evaluations at most."""
    from scipy.optimize import least_squares

    free = task.free
    low, high = _limits(free)
    at = np.clip(np.log([max(start[name], 1e-300) for name in free]), low + 1e-9, high - 1e-9)
    seen: list[tuple[FloatArray, npt.NDArray[np.float64]]] = []

    def residual(log_values: FloatArray) -> FloatArray:
        """Return the residual, and keep the derivative, which costs nothing beside it."""
        seen[:] = [task.residual(log_values)]
        return seen[0][0]

    try:
        done = least_squares(
            residual, at, jac=lambda _: seen[0][1], bounds=(low, high), x_scale="jac", max_nfev=most,
            ftol=1e-10, xtol=1e-10, gtol=1e-15,
        )  # fmt: skip
    except ValueError:  # no finite response, or no finite derivative
        return Descent(dict(zip(free, np.exp(at).tolist(), strict=True)), np.inf, 1)
    values = dict(zip(free, np.exp(done.x).tolist(), strict=True))
    return Descent(values, task.log_error(2.0 * done.cost), int(done.nfev))


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
    task: Problem, values: Mapping[str, float], evaluations: int, rivals: Sequence[Mapping[str, float]] = ()
) -> Identified:
    """Return what was found with its cost and with what the data say about each parameter.

    Raises IdentificationError when a value or the response it gives is not finite.

    `task`: the problem that was solved. `values`: all parameters by name, the kept ones among them. `evaluations`: how
    often the response was computed. `rivals`: other sets of values that fit as well.
    """
    free = task.free
    computed, _ = task.model({name: values[name] for name in free})
    if not np.isfinite(computed).all():
        raise IdentificationError("the identified properties give no finite response; start from other values")
    at = np.log([max(values[name], 1e-300) for name in free])
    residual, jacobian = task.residual(at)
    log_error = task.log_error(float(residual @ residual))
    lines = float(np.square(task.weight).sum())
    deviation = _log_deviation(jacobian, lines, max(log_error, ASSUMED_ERROR))
    others = np.log([[max(other[name], 1e-300) for name in free] for other in rivals]).reshape(-1, len(free))
    apart = np.abs(others - at).max(axis=0, initial=0.0)
    sets = np.vstack([at, others])
    low, high = _limits(free)
    with np.errstate(over="ignore", under="ignore"):
        ends = np.exp(sets.min(axis=0) - 2.0 * deviation), np.exp(sets.max(axis=0) + 2.0 * deviation)
    implausible = tuple(
        name
        for name, place, bottom, top in zip(free, at, low, high, strict=True)
        if values[name] > PLAUSIBLE[name.partition("_")[0]] or place <= bottom + 1e-9 or place >= top - 1e-9
    )
    return Identified(
        values={name: float(value) for name, value in values.items()},
        free=free,
        cost_m_per_n=cost_of_source(task.measured, computed),
        log_error=log_error,
        evaluations=evaluations,
        log_deviation=dict(zip(free, deviation.tolist(), strict=True)),
        interval={
            name: _bounded(name, *pair) for name, pair in zip(free, np.stack(ends, axis=1).tolist(), strict=True)
        },
        identifiable={
            name: bool(size < IDENTIFIABLE and other < IDENTIFIABLE)
            for name, size, other in zip(free, deviation, apart, strict=True)
        },
        implausible=implausible,
    )


def _bounded(name: str, low: float, high: float) -> tuple[float, float]:
    """Return an interval with 0 and inf for ends that no bearing has."""
    kind = name.partition("_")[0]
    return (low if low > BOUNDS[kind][0] else 0.0), (high if high < PLAUSIBLE[kind] else np.inf)


def _log_deviation(jacobian: npt.NDArray[np.float64], lines: float, error: float) -> FloatArray:
    """Return how far each logarithm moves when the response is off by `error`, parameters compensating."""
    _, singular, right = np.linalg.svd(jacobian / np.sqrt(lines), full_matrices=False)
    with np.errstate(divide="ignore"):
        spread = np.where(singular > 1e-12 * singular.max(initial=0.0), error / singular, np.inf)
    weights = np.abs(right.T) > 1e-8
    moved = np.where(weights, np.abs(right.T) * np.where(np.isinf(spread), 0.0, spread), 0.0)
    total = np.sqrt(np.square(moved).sum(axis=1))
    unseen = (weights & np.isinf(spread)[None, :]).any(axis=1)
    return np.where(unseen, np.inf, total)
