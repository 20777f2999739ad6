"""Identification from measured responses, as plain data; responses in another unit are refused."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from config.machine.spindle_chain import Spindle
from daemon.workbench.dynamics.responses import ResponseError, properties
from drivers.files.frf_measurement import read_measurements
from models.dynamics.assembly import CondensedAssembly, SpindleAssembly
from models.dynamics.bearings import GROUPS, PARAMETERS, CondensedShaft, parameters_from_properties, parameters_of
from models.dynamics.chain import Chain, Part, SpringDamper
from models.dynamics.contact import Interface, chain_receptance, identify_contact
from models.dynamics.identification import FIXED, Method, identify_bearings, kept_parameters, level_range_m_per_n
from models.dynamics.measurement import Measurement, MeasurementError, average, check_for_identification
from models.dynamics.plausibility import check_frequencies, check_level, other_readings
from models.dynamics.response_fit import Identified, good_fit

Fixed = Literal["auto", "source", "file"]
"""Where the parameters that are not varied come from."""
POOR_FIT = 0.5
"""Root mean square of |log(H / H_meas)| above which the model does not explain the measurement."""


NO_FIT = 1.0
"""Root mean square of |log(H / H_meas)| above which other units are tried."""
HOPELESS = 2.0
"""The same above which a response is refused even when no other unit explains it: a factor of seven."""
BETTER = 4.0
"""Another unit explains a response when it fits this many times better."""
LINES = 400
"""About so many of the frequencies are used to try other units."""

Fit = Callable[[Measurement], float]
"""Response -> root mean square of |log(H / H_meas)| of the best fit."""


def refuse_other_units(measured: Measurement, log_error: float, fit: Fit) -> None:
    """Refuse a response that was fitted badly and fits in another unit, or not at all; raises MeasurementError."""
    if log_error <= NO_FIT:
        return
    thinned = measured.thinned(LINES)
    for what, other in other_readings(thinned):
        if fit(other) * BETTER < log_error:
            raise MeasurementError(
                f"the structure of the file cannot give these receptances from {_band(measured)} in m/N over Hz: on "
                f"average they are off by a factor of {math.exp(log_error):.2g}. It can with numbers {what}; convert "
                "them, or name the columns after what they hold"
            )
    if log_error > HOPELESS:
        raise MeasurementError(
            f"the structure of the file cannot give these receptances from {_band(measured)} with any properties; on "
            f"average they are off by a factor of {math.exp(log_error):.2g}. Check the units (m/N, Hz), where it was "
            "hit and measured, and the dimensions of the file"
        )


def refuse_levels(shaft: CondensedShaft, responses: Iterable[tuple[Path, Measurement]]) -> None:
    """Refuse responses that the shaft cannot give in m/N over Hz; raises MeasurementError naming the file."""
    lowest, highest = level_range_m_per_n(shaft)
    for file, measured in responses:
        try:
            check_level(measured, lowest, highest)
        except MeasurementError as error:
            raise MeasurementError(f"{file}: {error}") from error


def _band(measured: Measurement) -> str:
    return f"{measured.frequency_hz[0]:g} to {measured.frequency_hz[-1]:g} Hz"


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """Which frequencies of a measurement are used."""

    from_hz: float | None = None
    to_hz: float | None = None
    least_coherence: float | None = None
    trust_units: bool = False
    """Whether the units are taken as stated, whatever the numbers look like."""


def kept_for(spindle: Spindle, asked: str, vary: Sequence[str] = ()) -> tuple[dict[str, float], str]:
    """Return the bearing parameters that are kept, and what is varied where that was left open ('auto').

    Five, the others kept at published values, are those of the published spindle with its three groups of bearings; for
    any other arrangement these values say nothing, so all of its groups are varied.
    """
    groups = tuple(dict.fromkeys(support.group for support in spindle.shaft.supports))
    if not groups:
        raise ResponseError("the file describes no bearings; give their positions and groups under `bearings`")
    stated = parameters_from_properties(properties(spindle))
    if asked != "auto" or vary:
        return kept_parameters(groups, 12 if asked == "auto" else int(asked), vary, stated), ""
    if set(groups) == set(GROUPS):
        return kept_parameters(groups, 5, (), stated), ""
    named = " and ".join(groups)
    fewer = "--parameters 5 or 7" if set(groups) <= set(GROUPS) else "--vary"
    return {}, f"all parameters of the groups there are ({named}) are varied; {fewer} varies fewer"


def measured_response(paths: Sequence[Path], band: Band, parameters: int) -> Measurement:
    """Return the average of all responses in the files, cut to the band; raises MeasurementError."""
    whole = average([each for path in paths for each in read_measurements(path)])
    if not band.trust_units and len(whole.frequency_hz):
        check_frequencies(whole.frequency_hz)
    part = whole.between(band.from_hz, band.to_hz)
    if band.least_coherence is not None:
        part = part.coherent(band.least_coherence)
    if not len(part.frequency_hz):
        raise MeasurementError(
            f"no frequency is left; the files hold {whole.frequency_hz[0]:g} to {whole.frequency_hz[-1]:g} Hz"
        )
    check_for_identification(part, parameters, trust_units=band.trust_units)
    return part


def bearings_summary(
    spindle: Spindle,
    measurement: Measurement,
    kept: Mapping[str, float],
    method: Method = "lm",
    fixed: Fixed = "auto",
    *,
    may_vary_all: bool = False,
    trust_units: bool = False,
) -> dict[str, Any]:
    """Return what `toolpoint dynamics identify` prints; raises MeasurementError.

    `kept`: what is not varied, by `kept_for`. `fixed`: `auto` keeps it at these values and, when that fits badly, at
    the file's, or with `may_vary_all` nowhere.
    """
    shaft = CondensedShaft(spindle.shaft, measurement.frequency_hz)
    if not trust_units:
        check_level(measurement, *level_range_m_per_n(shaft))
    found, source = _identified(spindle, shaft, measurement, kept, method, fixed, may_vary_all)
    if not trust_units:
        present = parameters_of(shaft.groups)
        few = kept or {name: value for name, value in FIXED[7].items() if name in present}
        refuse_other_units(
            measurement, found.log_error, lambda other: _identified(spindle, None, other, few, "lm", fixed)[0].log_error
        )
    summary = _summary(spindle, measurement, found, method)
    summary["parameters"] = len(found.free) if source else len(PARAMETERS)
    summary["fixed_from"] = source
    return summary


def _identified(
    spindle: Spindle,
    shaft: CondensedShaft | None,
    measurement: Measurement,
    kept: Mapping[str, float],
    method: Method,
    fixed: Fixed,
    may_vary_all: bool = False,
) -> tuple[Identified, str | None]:
    """Return what was found, and where the parameters that were kept come from, None where none was."""
    shaft = shaft or CondensedShaft(spindle.shaft, measurement.frequency_hz)
    stated = parameters_from_properties(properties(spindle))
    response = measurement.receptance_m_per_n
    kept_by_file = {name: stated.get(name, value) for name, value in kept.items()}
    if fixed == "file" or kept_by_file == kept:
        found = identify_bearings(shaft, response, start=stated, fixed=kept_by_file, method=method)
        return found, "file" if kept else None
    found = identify_bearings(shaft, response, start=stated, fixed=kept, method=method)
    source: str | None = "source"
    others: list[tuple[str | None, dict[str, float]]] = [("file", kept_by_file)] if fixed == "auto" else []
    for name, values in [*others, (None, {})] if others and may_vary_all else others:
        if found.log_error < good_fit(response):
            break
        other = identify_bearings(shaft, response, start=stated, fixed=values, method=method)
        evaluations = found.evaluations + other.evaluations
        if other.log_error < 0.5 * found.log_error:
            found, source = other, name
        found = replace(found, evaluations=evaluations)
    return found, source


def _summary(spindle: Spindle, measurement: Measurement, found: Identified, method: str) -> dict[str, Any]:
    warnings = list(spindle.warnings)
    if found.log_error > POOR_FIT:
        warnings.append(
            f"the model does not explain the measurement (mean |log(H/H_meas)| {found.log_error:.2g}); "
            "check units, direction, sensor position and the shaft's dimensions"
        )
    warnings += [
        f"{name} = {found.values[name]:.3g} is not physical: the data do not bound it; do not use it"
        for name in found.implausible
    ]
    unseen = [name for name in found.free if not found.identifiable[name]]
    if unseen:
        warnings.append(
            f"the response from {measurement.frequency_hz[0]:g} to {measurement.frequency_hz[-1]:g} Hz does not "
            f"determine {', '.join(unseen)}; other values fit as well (see the intervals). A wider band may, or fewer "
            "parameters"
        )
    return {
        "name": spindle.description.name,
        "rigid_rotary_inertia": spindle.rotary,
        "warnings": warnings,
        "method": method,
        "values": {name: found.values[name] for name in found.free},
        "fixed": {name: value for name, value in found.values.items() if name not in found.free},
        "cost": found.cost_m_per_n,
        "log_error": found.log_error,
        "evaluations": found.evaluations,
        "identifiable": found.identifiable,
        "relative_uncertainty": {
            name: None if not np.isfinite(size) else size for name, size in found.log_deviation.items()
        },
        "interval": {
            name: [low if low > 0.0 else None, high if np.isfinite(high) else None]
            for name, (low, high) in found.interval.items()
        },
        "implausible": list(found.implausible),
    }


def contact_summary(
    spindle: Spindle,
    measurement: Measurement,
    joint: str,
    after_segment: int | None,
    method: Method,
    *,
    trust_units: bool = False,
) -> dict[str, Any]:
    """Return what `toolpoint dynamics contact` prints; raises ResponseError, MeasurementError."""

    def identified(measured: Measurement, method: Method) -> Identified:
        interface, start = _interface(spindle, measured, joint, after_segment)
        return identify_contact(interface, measured.receptance_m_per_n, start=start, method=method)

    found = identified(measurement, method)
    if not trust_units:
        refuse_other_units(measurement, found.log_error, lambda other: identified(other, "lm").log_error)
    return {**_summary(spindle, measurement, found, method), "joint": joint}


def _interface(
    spindle: Spindle, measurement: Measurement, joint: str, after_segment: int | None
) -> tuple[Interface, dict[str, float]]:
    frequency_hz = measurement.frequency_hz
    if joint == "shaft":
        front, behind, told = _cut_shaft(spindle, after_segment)
    else:
        body, assembly = ("holder", SpindleAssembly(shaft=spindle.shaft)) if joint == "spindle-holder" else (
            "tool", spindle.assembly("holder"))  # fmt: skip
        parts: tuple[Part, ...] = getattr(spindle, body)
        if not parts:
            raise ResponseError(f"the file describes no {body}; add `{body}`")
        told = parts[-1] if isinstance(parts[-1], SpringDamper) else None
        front = Chain(parts=parts[:-1] if told else parts)
        behind = assembly
    rows = CondensedAssembly(behind, frequency_hz).receptance_matrix(properties(spindle))
    rear = np.stack([rows[0], rows[1], rows[1], rows[2]], axis=1).reshape(-1, 2, 2)
    start = {}
    if isinstance(told, SpringDamper):
        start = {"kt": told.kt_n_per_m, "ct": told.ct_ns_per_m, "kr": told.kr_nm_per_rad, "cr": told.cr_nms_per_rad}
    interface = Interface(frequency_hz=frequency_hz, front=chain_receptance(front, frequency_hz), rear=rear)
    return interface, {name: value for name, value in start.items() if value > 0.0}


def _cut_shaft(spindle: Spindle, after_segment: int | None) -> tuple[Chain, SpindleAssembly, Part | None]:
    parts, count = list(spindle.shaft.parts), len(spindle.shaft.segments)
    if after_segment is None or not 1 <= after_segment < count:
        raise ResponseError(f"--after-segment must name the segment in front of the joint, 1 to {count - 1}")
    seen, index = 0, 0
    while seen < after_segment:
        seen += not isinstance(parts[index], SpringDamper)
        index += 1
    front, rest = parts[:index], parts[index:]
    told = rest.pop(0) if isinstance(rest[0], SpringDamper) else None
    length_m = Chain(parts=tuple(front)).length_m
    if any(support.position_m <= length_m for support in spindle.shaft.supports):
        raise ResponseError("a bearing stands in front of that joint; measure the shaft without bearings")
    supports = tuple(replace(each, position_m=each.position_m - length_m) for each in spindle.shaft.supports)
    return Chain(parts=tuple(front)), SpindleAssembly(shaft=Chain(parts=tuple(rest), supports=supports)), told
