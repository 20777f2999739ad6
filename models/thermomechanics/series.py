"""Bearing properties of a whole series of responses at the nose, with few and with many varied (section 5.2.3).

The first response is identified from scratch. Every later one begins where the one before ended, which is faster and
keeps the series on one branch where several sets of properties fit about as well. A larger set of parameters begins at
what the smaller one found for the same response.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.dynamics.beam import ComplexArray
from models.dynamics.bearings import CondensedShaft, parameters_of, properties_from_parameters
from models.dynamics.identification import identify_bearings, initial
from models.dynamics.response_fit import Identified, descend, problem, report
from models.records import FloatArray

POOR = 0.5
"""Root mean square of |log(H / H_meas)| above which a response is identified from scratch as well."""
ITERATIONS = 60
"""Of a response that begins at known values."""
ADDED = {"kt": 1e6, "ct": 30.0, "kr": 1e4, "cr": 1.0}
"""Where a parameter begins that a smaller set kept fixed, by kind."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PropertySeries:
    """Identified bearing properties over time."""

    names: tuple[str, ...]
    """The varied ones."""
    kept: Mapping[str, float]
    """The others, with their values."""
    time_min: FloatArray
    """Times of the responses [min], shape (n,)."""
    values: FloatArray
    """SI units, shape (n, parameters)."""
    log_error: FloatArray
    """Root mean square of |log(H / H_meas)| of each, shape (n,)."""
    identifiable: FloatArray
    """Share of the responses that determine each parameter, shape (parameters,)."""


def identify_series(
    shaft: CondensedShaft,
    responses: Sequence[ComplexArray],
    time_min: FloatArray,
    kept: Mapping[str, float],
    smaller: PropertySeries | None = None,
) -> PropertySeries:
    """Identify all responses of one axis.

    Raises IdentificationError when a response cannot be fitted at all.

    `shaft`: the shaft, condensed at the frequencies of the responses. `responses`: receptances at the nose [m/N], each
    of shape (n,), in the order of their times. `time_min`: times [min], shape (len(responses),), ascending. `kept`: the
    parameters that are not varied, with their values. `smaller`: the same responses identified with fewer parameters,
    where each of them begins.
    """
    names = tuple(name for name in parameters_of(shaft.groups) if name not in kept)
    found: list[Identified] = []
    for index, response in enumerate(responses):
        begin: dict[str, float] | None = None
        if smaller is not None:
            begin = {name: ADDED[name.partition("_")[0]] for name in names}
            begin |= dict(zip(smaller.names, smaller.values[index].tolist(), strict=True))
        elif found:
            begin = found[-1].values
        found.append(_identified(shaft, response, kept, names, begin))
    return PropertySeries(
        names=names,
        kept=kept,
        time_min=time_min,
        values=np.array([[each.values[name] for name in names] for each in found]),
        log_error=np.array([each.log_error for each in found]),
        identifiable=np.mean([[each.identifiable[name] for name in names] for each in found], axis=0),
    )


def _identified(
    shaft: CondensedShaft,
    response: ComplexArray,
    kept: Mapping[str, float],
    names: tuple[str, ...],
    begin: Mapping[str, float] | None,
) -> Identified:
    if begin is None:
        return identify_bearings(shaft, response, fixed=kept)
    fixed = {**initial(parameters_of(shaft.groups)), **kept}

    def model(values: Mapping[str, float]) -> tuple[ComplexArray, Mapping[str, ComplexArray]]:
        """Return the nose's response and its slopes [m/N] for fitted parameters beside the fixed ones."""
        return shaft.nose_receptance_and_derivatives(properties_from_parameters({**fixed, **values}))

    task = problem(model, response, names)
    reached = descend(task, begin, ITERATIONS)
    found = report(task, {**fixed, **reached.values}, reached.evaluations)
    if found.log_error < POOR or not kept:
        return found
    anew = identify_bearings(shaft, response, fixed=kept, start=begin)
    return anew if anew.log_error < found.log_error else found
