"""Identification from measured responses, as plain data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from config.spindle_chain import Spindle
from daemon.dynamics.responses import ResponseError, properties
from drivers.frf_measurement import read_measurements
from models.dynamics.assembly import CondensedAssembly, SpindleAssembly
from models.dynamics.bearings import CondensedShaft, parameters_from_properties
from models.dynamics.chain import Chain, Part, SpringDamper
from models.dynamics.contact import Interface, identify_contact
from models.dynamics.coupling import chain_receptance
from models.dynamics.identification import FIXED, Method, identify_bearings
from models.dynamics.measurement import Measurement, MeasurementError, average, check_for_identification
from models.dynamics.response_fit import GOOD_FIT, Identified

POOR_FIT = 0.5
"""Root mean square of |log(H / H_meas)| above which the model does not explain the measurement."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """Which frequencies of a measurement are used."""

    from_hz: float | None = None
    to_hz: float | None = None
    least_coherence: float | None = None


def measured_response(paths: Sequence[Path], band: Band, parameters: int) -> Measurement:
    """Return the average of all responses in the files, cut to the band.

    Raises
    ------
    MeasurementError, MeasurementFileError
        When a file cannot be read or the band cannot determine the parameters.

    """
    whole = average([each for path in paths for each in read_measurements(path)])
    part = whole.between(band.from_hz, band.to_hz)
    if band.least_coherence is not None:
        part = part.coherent(band.least_coherence)
    if not len(part.frequency_hz):
        raise MeasurementError(
            f"no frequency is left; the files hold {whole.frequency_hz[0]:g} to {whole.frequency_hz[-1]:g} Hz"
        )
    check_for_identification(part, parameters)
    return part


def bearings_summary(
    spindle: Spindle,
    measurement: Measurement,
    parameters: int,
    method: Method = "lm",
    fixed: Literal["auto", "source", "file"] = "auto",
) -> dict[str, Any]:
    """Return what `toolpoint dynamics identify` prints.

    `auto` keeps what is not varied at the values of section 5.2.3 and, when that fits badly, at the file's.

    Raises
    ------
    ResponseError
        When the spindle has no bearings.

    """
    if not spindle.shaft.supports:
        raise ResponseError("the file describes no bearings; give their positions and groups under `bearings`")
    stated = parameters_from_properties(properties(spindle))
    shaft = CondensedShaft(spindle.shaft, measurement.frequency_hz)
    response = measurement.receptance_m_per_n
    kept_by_file = {name: stated.get(name, value) for name, value in FIXED[parameters].items()}
    source = "source"
    if fixed == "file":
        source = "file"
        found = identify_bearings(
            shaft, response, parameters=parameters, start=stated, fixed=kept_by_file, method=method
        )
    else:
        found = identify_bearings(shaft, response, parameters=parameters, start=stated, method=method)
        if fixed == "auto" and parameters < 12 and found.log_error >= GOOD_FIT:
            other = identify_bearings(
                shaft, response, parameters=parameters, start=stated, fixed=kept_by_file, method=method
            )
            evaluations = found.evaluations + other.evaluations
            if other.log_error < 0.5 * found.log_error:
                found, source = other, "file"
            found = replace(found, evaluations=evaluations)
    summary = _summary(spindle, found, method)
    summary["parameters"] = parameters
    summary["fixed_from"] = source if parameters < 12 else None
    return summary


def _summary(spindle: Spindle, found: Identified, method: str) -> dict[str, Any]:
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
        warnings.append(f"the data do not determine {', '.join(unseen)}; other values fit as well")
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
        "implausible": list(found.implausible),
    }


JOINTS = ("spindle-holder", "holder-tool", "shaft")


def contact_summary(
    spindle: Spindle, measurement: Measurement, joint: str, after_segment: int | None, method: Method
) -> dict[str, Any]:
    """Return what `toolpoint dynamics contact` prints; raises ResponseError when the file lacks the joint's sides."""
    interface, start = _interface(spindle, measurement, joint, after_segment)
    found = identify_contact(interface, measurement.receptance_m_per_n, start=start, method=method)
    return {**_summary(spindle, found, method), "joint": joint}


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
