"""Bearing properties from a measured response at the nose (sections 4.2.2 and 5.2.3 of the dissertation).

The default method is least squares of ``log(H / H_meas)`` with exact derivatives: it finds in about ten
evaluations what Nelder and Mead's simplex on the dissertation's own cost (4-36) finds in hundreds.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal

import numpy as np

from models.dynamics.beam import ComplexArray
from models.dynamics.bearings import (
    GROUPS,
    KINDS,
    PARAMETERS,
    CondensedShaft,
    parameters_of,
    properties_from_parameters,
)
from models.dynamics.plausibility import level_m_per_n
from models.dynamics.response_fit import Descent, Identified, Model, Response, nelder_mead, problem, report
from models.dynamics.response_search import (
    SEARCH_RANGE,
    Coarse,
    evenly_spread,
    least_squares_fit,
    lines_of_search,
)
from models.errors import IdentificationError
from models.records import FloatArray

Method = Literal["lm", "nelder-mead"]

LEVEL_POINTS = 64
LEVEL_LINES = 200
"""Sets of bearing properties, and about how many of the frequencies, at which the level of a shaft is looked at."""

_NEGLIGIBLE = {"ct_34": 1e-5, "cr_12": 1e-5, "cr_34": 1e-5, "cr_5": 1e-5, "kr_5": 1e5}
FIXED: Mapping[int, Mapping[str, float]] = {
    12: {},
    7: _NEGLIGIBLE,
    5: {**_NEGLIGIBLE, "kt_12": 1e-5, "kr_34": 1e-5},
}
"""Number of free parameters -> what is kept fixed, with the values of section 5.2.3."""

TYPICAL = {"kt": 1e8, "ct": 1e3, "kr": 5e5, "cr": 10.0}
"""Where a property begins that nothing is told of, by kind: the front bearings of Table 4-5."""
INITIAL = {
    **{f"{kind}_{group}": value for group in ("12", "34") for kind, value in TYPICAL.items()},
    **{"kt_5": 1e8, "ct_5": 100.0, "kr_5": 5e5, "cr_5": 10.0},
}
"""Initial conditions of Table 4-5."""


def initial(names: Iterable[str]) -> dict[str, float]:
    """Return where parameters begin that nothing is told of."""
    return {name: INITIAL.get(name, TYPICAL[name.partition("_")[0]]) for name in names}


def kept_beside(vary: Sequence[str], groups: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters of a spindle that are kept when these are varied.

    Raises IdentificationError when a name is no parameter of it.

    `vary`: parameters (`kt_front`), kinds (`kt`: of every group), or groups (`front`: all of its parameters). `groups`:
    the groups of the spindle's bearings.
    """
    names = parameters_of(groups)
    varied: set[str] = set()
    for word in vary:
        meant = [name for name in names if word in (name, *name.split("_", 1))]
        if not meant:
            raise IdentificationError(
                f"{word!r} is no bearing parameter of this spindle; there are {', '.join(names)}, "
                f"{', '.join(KINDS)} for every group, and the groups {', '.join(groups)}"
            )
        varied.update(meant)
    return tuple(name for name in names if name not in varied)


def kept_parameters(
    groups: Sequence[str], parameters: int, vary: Sequence[str], stated: Mapping[str, float]
) -> dict[str, float]:
    """Return the parameters that are kept, with their values.

    Raises IdentificationError when `vary` names no parameter, or when it must say what is varied.

    `groups`: the groups of the spindle's bearings. `parameters`: 5, 7 or 12 of the published spindle's (section 5.2.3),
    12 standing for all of any spindle. `vary`: what is varied instead, see `kept_beside`; empty: as `parameters` says.
    `stated`: values of the spindle's file, by name; they are kept where nothing is published.
    """
    if vary:
        return {name: stated.get(name, 0.0) for name in kept_beside(vary, groups)}
    if parameters == len(PARAMETERS):
        return {}
    if not set(groups) <= set(GROUPS):
        raise IdentificationError(
            f"{parameters} parameters are those of the published spindle, whose groups of bearings are "
            f"{', '.join(GROUPS)}; here they are {', '.join(groups)}: name what is varied (--vary kt,ct_{groups[0]})"
        )
    present = set(parameters_of(groups))
    return {name: value for name, value in FIXED[parameters].items() if name in present}


def identify_bearings(
    shaft: CondensedShaft,
    measured: ComplexArray,
    *,
    parameters: int = 5,
    start: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
    method: Method = "lm",
) -> Identified:
    """Return bearing properties that reproduce a measured response at the nose.

    Twelve parameters are found by the simplex in two stages, as in the dissertation: all front bearings equal, then
    each group with its own. Twelve are not identifiable from one response; `identifiable` says which the data see.

    Raises IdentificationError when the data cannot be fitted at all.

    Parameters
    ----------
    shaft
        The shaft, condensed at the measured frequencies.
    measured
        Receptance at the nose [m/N], shape (n,).
    parameters
        5, 7 or 12 of the published spindle's (section 5.2.3): which are kept, when `fixed` does not say it.
    start
        Where to begin, by name; what is missing or zero is taken from Table 4-5.
    fixed
        The parameters that are not varied, with their values; None: those of section 5.2.3.
    method
        `lm`, or `nelder-mead` on the dissertation's cost.

    """
    kept = dict(FIXED[parameters] if fixed is None else fixed)
    present = parameters_of(shaft.groups)
    free = tuple(name for name in present if name not in kept)
    if not free:
        raise IdentificationError("every bearing parameter is kept, so there is nothing to identify; vary one")
    told = {name: value for name, value in (start or {}).items() if value > 0.0}
    table = initial(present)
    begin = {**table, **told, **kept}
    if method == "nelder-mead":
        two_stages = set(free) == set(PARAMETERS)
        found = _simplex(_response(shaft, begin), measured, free, begin, two_stages)
        task = problem(_model(shaft, begin), measured, free)
    else:
        task = problem(_model(shaft, begin), measured, free)
        lines = lines_of_search(len(measured))
        coarse = Coarse(lines=lines, model=_model(shaft.thinned(lines), begin), many=_many(shaft, begin, lines))
        found = least_squares_fit(task, begin, coarse, {**table, **kept})
    values = {name: {**begin, **found.values}[name] for name in present}
    return report(task, values, found.evaluations, found.rivals)


def _model(shaft: CondensedShaft, begin: Mapping[str, float]) -> Model:
    def model(values: Mapping[str, float]) -> tuple[ComplexArray, Mapping[str, ComplexArray]]:
        """Return the nose's response and its slopes [m/N] for fitted parameters beside the kept ones."""
        return shaft.nose_receptance_and_derivatives(properties_from_parameters({**begin, **values}))

    return model


def _response(shaft: CondensedShaft, begin: Mapping[str, float]) -> Response:
    def response(values: Mapping[str, float]) -> ComplexArray:
        """Return the nose's response [m/N] for fitted parameters beside the kept ones."""
        return shaft.nose_receptance(properties_from_parameters({**begin, **values}))

    return response


def _many(
    shaft: CondensedShaft, begin: Mapping[str, float], lines: slice
) -> Callable[[Mapping[str, FloatArray]], ComplexArray]:
    def many(values: Mapping[str, FloatArray]) -> ComplexArray:
        """Return the nose's responses [m/N] for several sets of fitted parameters, shape (k, n)."""
        sets = len(next(iter(values.values())))
        columns = {name: values.get(name, np.full(sets, begin[name])) for name in parameters_of(shaft.groups)}
        a, b, d = shaft.nose_stiffnesses(columns, lines)
        return np.asarray(d / (a * d - b * b), dtype=np.complex128)

    return many


def level_range_m_per_n(shaft: CondensedShaft) -> tuple[float, float]:
    """Return the lowest and the highest level that the nose of a shaft has on bearings of every usual kind [m/N].

    The level is the geometric mean of the magnitudes; the properties are spread over `SEARCH_RANGE`.

    `shaft`: the shaft, condensed at the frequencies that are looked at.
    """
    names = parameters_of(shaft.groups)
    ends = np.log([SEARCH_RANGE[name.partition("_")[0]] for name in names])
    points = np.exp(ends[:, 0] + evenly_spread(LEVEL_POINTS, len(names)) * (ends[:, 1] - ends[:, 0]))
    columns = {name: points[:, place] for place, name in enumerate(names)}
    lines = slice(None, None, max(1, len(shaft.frequency_hz) // LEVEL_LINES))
    a, b, d = shaft.nose_stiffnesses(columns, lines)
    levels = [level_m_per_n(row) for row in d / (a * d - b * b)]
    return min(levels), max(levels)


def _simplex(
    response: Response, measured: ComplexArray, free: Sequence[str], begin: Mapping[str, float], two_stages: bool
) -> Descent:
    """Return the minimum of the dissertation's cost, for twelve parameters in the dissertation's two stages."""
    evaluations = 0
    if two_stages:
        few = [name for name in free if not name.endswith("_34")]
        first = nelder_mead(lambda values: response(_untied(values)), measured, few, begin)
        begin, evaluations = {**begin, **_untied(first.values)}, first.evaluations
    found = nelder_mead(response, measured, free, begin)
    return Descent(found.values, found.log_error, found.evaluations + evaluations)


def _untied(values: Mapping[str, float]) -> dict[str, float]:
    """Return values in which the rear pair of front bearings has the properties of the front pair."""
    copied = {name.replace("_12", "_34"): value for name, value in values.items() if name.endswith("_12")}
    return {**values, **copied}
