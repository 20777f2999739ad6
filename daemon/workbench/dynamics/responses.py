"""Modes and frequency responses of a spindle as plain data."""

from dataclasses import replace
from typing import Any

import numpy as np

from config.machine.spindle_chain import Spindle
from models.dynamics.assembly import CondensedAssembly, SpindleAssembly
from models.dynamics.beam import ComplexArray
from models.dynamics.bearings import BearingProperties
from models.dynamics.chain import SpringDamper
from models.dynamics.modes import HIGHEST_HZ as SEARCH_END_HZ
from models.dynamics.modes import Mode, modes, rigid_body_modes
from models.dynamics.rotation import rotating_receptance, whirl_frequencies
from models.errors import RefusedInputError
from models.records import FloatArray

DEFAULT_STEP_HZ = 12800.0 / 16384.0
"""Spectral line spacing of the dissertation's analyser; 300 to 2500 Hz then are 2817 points."""
LOWEST_HZ, HIGHEST_HZ = 1e-3, 1e6
"""Where the beam model is computed: below, a free shaft only drifts; above, waves are shorter than the section."""
MOST_POINTS = 1_000_000
CLOSEST = 1e-12
"""Smallest distance between two frequencies, as a share of them."""


class ResponseError(RefusedInputError, ValueError):
    """A response cannot be computed as asked; the text says why."""


def frequencies(from_hz: float, to_hz: float, points: int | None, step_hz: float | None) -> FloatArray:
    """Return the frequencies that a command asks for [Hz], shape (n,); raises ResponseError."""
    if not 0.0 < from_hz < to_hz:
        raise ResponseError(f"frequencies from {from_hz:g} to {to_hz:g} Hz: the first must lie above 0, below the last")
    if not LOWEST_HZ <= from_hz < to_hz <= HIGHEST_HZ:
        raise ResponseError(
            f"frequencies from {from_hz:g} to {to_hz:g} Hz: a spindle is computed between {LOWEST_HZ:g} and "
            f"{HIGHEST_HZ:g} Hz; beyond that the beam model does not hold"
        )
    if points is not None and step_hz is not None:
        raise ResponseError("give --points or --df, not both")
    if points is not None:
        if to_hz - from_hz < points * CLOSEST * to_hz:
            raise ResponseError(f"{points} frequencies from {from_hz:g} to {to_hz:g} Hz lie too close; take fewer")
        return np.linspace(from_hz, to_hz, points, dtype=np.float64)
    step = DEFAULT_STEP_HZ if step_hz is None else step_hz
    steps = (to_hz - from_hz) / step
    if not steps < MOST_POINTS:
        raise ResponseError(f"steps of {step:g} Hz are more than {MOST_POINTS} frequencies; widen --df")
    count = int(np.floor(steps * (1.0 + 1e-12))) + 1
    if count < 2:
        raise ResponseError(f"a step of {step:g} Hz leaves one frequency between {from_hz:g} and {to_hz:g} Hz")
    return np.asarray(from_hz + step * np.arange(count), dtype=np.float64)


def properties(spindle: Spindle) -> BearingProperties:
    """Return the bearing properties that the file states, by group; raises ResponseError when two differ."""
    found: dict[str, SpringDamper] = {}
    for support in spindle.shaft.supports:
        if found.setdefault(support.group, support.properties) != support.properties:
            raise ResponseError(
                f"the bearings of group {support.group!r} have different properties; give each set a group of its own"
            )
    return found


def parts_at(spindle: Spindle, at: str) -> str:
    """Return the place asked for; raises ResponseError when the file has no such part."""
    if at == "holder" and not spindle.holder:
        raise ResponseError("the file describes no holder; add `holder`, or ask for the nose")
    if at == "tool" and not spindle.tool:
        raise ResponseError("the file describes no tool; add `tool`, or ask for the holder or the nose")
    return at


def response(spindle: Spindle, at: str, frequency_hz: FloatArray, speed_rpm: float = 0.0) -> ComplexArray:
    """Return the receptance at a place [m/N], shape (n,); raises ResponseError where it is not finite.

    With a speed [1/min] the shaft turns on bearings that are alike in both axes.
    """
    assembly = spindle.assembly(parts_at(spindle, at))
    if speed_rpm:
        return _direct(turning_receptance(spindle, assembly, assembly, speed_rpm, frequency_hz))
    # Every bearing has a group of its own here, so that those of one group may differ.
    supports = tuple(replace(each, group=str(number)) for number, each in enumerate(assembly.shaft.supports))
    assembly = replace(assembly, shaft=replace(assembly.shaft, supports=supports))
    with np.errstate(all="ignore"):
        condensed = CondensedAssembly(assembly, frequency_hz)
        receptance = condensed.receptance({each.group: each.properties for each in supports})
    wrong = ~np.isfinite(receptance)
    if wrong.any():
        raise ResponseError(
            f"at {frequency_hz[np.argmax(wrong)]:g} Hz the response is infinite: an undamped resonance; "
            "give structural_damping or shift the frequencies"
        )
    return receptance


def turning_receptance(
    spindle: Spindle, along_x: SpindleAssembly, along_y: SpindleAssembly, speed_rpm: float, frequency_hz: FloatArray
) -> ComplexArray:
    """Return the receptance matrix of a shaft that turns [m/N], shape (n, 2, 2); raises ResponseError."""
    if spindle.rotary != "correct":
        raise ResponseError(
            "rigid_rotary_inertia published leaves out a part of the inertia that a turning shaft needs; state "
            "`rigid_rotary_inertia: correct`, with bearings that were identified so"
        )
    try:
        with np.errstate(all="ignore"):
            found = rotating_receptance(along_x, along_y, speed_rpm, frequency_hz)
    except ValueError as error:
        raise ResponseError(str(error)) from error
    except np.linalg.LinAlgError:
        found = np.full((len(frequency_hz), 2, 2), np.nan, dtype=np.complex128)
    _direct(found)
    return found


def _direct(receptance: ComplexArray) -> ComplexArray:
    """Return the response along X to a force along X; raises ResponseError where the matrix is not finite."""
    if not np.isfinite(receptance).all():
        raise ResponseError("the response is infinite: an undamped resonance; give structural_damping")
    direct: ComplexArray = receptance[:, 0, 0]
    return direct


def whirls_of(spindle: Spindle, speed_rpm: float, count: int) -> dict[str, Any]:
    """Return the whirls of all that the file describes against and with the rotation; raises ResponseError."""
    if spindle.rotary != "correct":
        raise ResponseError("whirls need the whole rotary inertia; add --rotary correct")
    try:
        against, along = whirl_frequencies(spindle.assembly().whole(), speed_rpm, count)
    except ValueError as error:
        raise ResponseError(str(error)) from error
    return {"speed_rpm": speed_rpm, "backward_hz": against.tolist(), "forward_hz": along.tolist()}


def peaks(frequency_hz: FloatArray, receptance: ComplexArray) -> list[dict[str, float]]:
    """Return the resonances: the frequencies at which the magnitude is larger than at both neighbours."""
    size = np.abs(receptance)
    inside = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
    return [{"frequency_hz": float(frequency_hz[k]), "magnitude_m_per_n": float(size[k])} for k in inside]


def response_summary(spindle: Spindle, at: str, frequency_hz: FloatArray, speed_rpm: float = 0.0) -> dict[str, Any]:
    """Return what `toolpoint dynamics frf` prints."""
    receptance = response(spindle, at, frequency_hz, speed_rpm)
    return {
        **({"speed_rpm": speed_rpm} if speed_rpm else {}),
        "name": spindle.description.name,
        "at": at,
        "rigid_rotary_inertia": spindle.rotary,
        "warnings": list(spindle.warnings),
        "peaks": peaks(frequency_hz, receptance),
        "frequency_hz": frequency_hz.tolist(),
        "receptance_re": receptance.real.tolist(),
        "receptance_im": receptance.imag.tolist(),
    }


def spindle_modes(spindle: Spindle, count: int) -> list[Mode]:
    """Return the lowest undamped modes of all that the file describes; positions count from the nose."""
    assembly = spindle.assembly()
    ahead = assembly.front_length_m
    return [replace(mode, position_m=mode.position_m - ahead) for mode in modes(assembly.whole(), count)]


def modes_summary(spindle: Spindle, count: int) -> dict[str, Any]:
    """Return what `toolpoint dynamics modes` prints."""
    whole = spindle.assembly().whole()
    found = spindle_modes(spindle, count)
    warnings = list(spindle.warnings)
    if len(found) < count:
        warnings.append(f"{len(found)} of {count} modes lie below {SEARCH_END_HZ:g} Hz, where the search ends")
    return {
        "name": spindle.description.name,
        "rigid_rotary_inertia": spindle.rotary,
        "warnings": warnings,
        "mass_kg": whole.mass_kg,
        "length_mm": whole.length_m * 1e3,
        "rigid_body_modes": rigid_body_modes(whole),
        "modes": [
            {
                "frequency_hz": mode.frequency_hz,
                "points_mm": (mode.position_m * 1e3).tolist(),
                "shape": mode.displacement.tolist(),
            }
            for mode in found
        ],
    }
