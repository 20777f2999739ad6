"""Bearing properties from a measured response at the nose (sections 4.2.2 and 5.2.3 of the dissertation).

The default method is least squares of ``log(H / H_meas)`` with exact derivatives: it finds in about ten
evaluations what Nelder and Mead's simplex on the dissertation's own cost (4-36) finds in hundreds.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from models.dynamics.beam import ComplexArray
from models.dynamics.bearings import PARAMETERS, CondensedShaft, properties_from_parameters
from models.dynamics.plausibility import level_m_per_n
from models.dynamics.response_fit import (
    SEARCH_RANGE,
    Descent,
    Identified,
    Response,
    evenly_spread,
    least_squares_fit,
    nelder_mead,
    report,
)

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

INITIAL = {
    **{f"{kind}_{group}": value for group in ("12", "34") for kind, value in
       (("kt", 1e8), ("ct", 1e3), ("kr", 5e5), ("cr", 10.0))},
    "kt_5": 1e8,
    "ct_5": 100.0,
    "kr_5": 5e5,
    "cr_5": 10.0,
}  # fmt: skip
"""Initial conditions of Table 4-5."""


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

    Twelve parameters are found in two stages, as in the dissertation: all front bearings equal, then each group
    with its own. Twelve are not identifiable from one response; `identifiable` says which the data see.

    Raises IdentificationError when the data cannot be fitted at all.

    Parameters
    ----------
    shaft
        The shaft, condensed at the measured frequencies.
    measured
        Receptance at the nose [m/N], shape (n,).
    parameters
        5, 7 or 12 (section 5.2.3).
    start
        Where to begin, by name; what is missing or zero is taken from Table 4-5.
    fixed
        Values of the parameters that are not varied, by name; None: those of section 5.2.3.
    method
        `lm`, or `nelder-mead` on the dissertation's cost.

    """
    kept = dict(FIXED[parameters] if fixed is None else {name: fixed[name] for name in FIXED[parameters]})
    present = [name for name in PARAMETERS if name.partition("_")[2] in shaft.groups]
    free = tuple(name for name in present if name not in kept)
    told = {name: value for name, value in (start or {}).items() if value > 0.0}
    begin = {**INITIAL, **told, **kept}

    def model(values: Mapping[str, float]) -> tuple[ComplexArray, Mapping[str, ComplexArray]]:
        """Return the nose's response and its slopes [m/N] for fitted parameters beside the kept ones."""
        return shaft.nose_receptance_and_derivatives(properties_from_parameters({**begin, **values}))

    def response(values: Mapping[str, float]) -> ComplexArray:
        """Return the nose's response [m/N] for fitted parameters beside the kept ones."""
        return shaft.nose_receptance(properties_from_parameters({**begin, **values}))

    if method == "nelder-mead":
        two_stages = parameters == 12 and {"12", "34"} <= set(shaft.groups)
        found = _simplex(response, measured, free, begin, two_stages)
    else:
        found = least_squares_fit(model, measured, free, begin, INITIAL)
    values = {name: {**begin, **found.values}[name] for name in present}
    return report(model, measured, values, free, found.evaluations)


def level_range_m_per_n(shaft: CondensedShaft) -> tuple[float, float]:
    """Return the lowest and the highest level that the nose of a shaft has on bearings of every usual kind [m/N].

    The level is the geometric mean of the magnitudes; the properties are spread over `SEARCH_RANGE`.

    `shaft`: the shaft, condensed at the frequencies that are looked at.
    """
    ends = np.log([SEARCH_RANGE[name.partition("_")[0]] for name in PARAMETERS])
    points = np.exp(ends[:, 0] + evenly_spread(LEVEL_POINTS, len(PARAMETERS)) * (ends[:, 1] - ends[:, 0]))
    columns = {name: points[:, place] for place, name in enumerate(PARAMETERS)}
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
