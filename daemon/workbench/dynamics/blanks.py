"""Tool points of a whole library of tools from one impact test on a blank, as plain data."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from config.machine.blank import Blank
from daemon.workbench.dynamics.identifying import Band
from drivers.files.frf_measurement import read_measurements
from models.dynamics.beam import ComplexArray, Segment
from models.dynamics.inverse_coupling import held_stiffness, tool_point_receptance
from models.dynamics.local_rational import Smoothed, smoothed
from models.dynamics.measurement import Measurement, MeasurementError, average, check_for_identification
from models.dynamics.plausibility import check_frequencies
from models.errors import IdentificationError
from models.records import FloatArray

CROSS = "cross"
PLACES = ("tip", CROSS, "second")
DRAWS = 24
"""Times the noise that is left is drawn to see what it makes of a peak."""
SEED = 4
EVEN = 1e-6
MISMATCH = 0.1
"""At the highest peak other shapes have a few per cent of the response."""
NOISY = 0.02
"""Noise beside the response above which the rotational receptance is mostly noise."""


def measured_blank(blank: Blank, band: Band) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies [Hz], shape (n,), and the three responses [m/N], shape (3, n); raises MeasurementError."""
    every = [path for place in PLACES for path in getattr(blank.test.responses, place)]
    if missing := [str(path) for path in every if not path.exists()]:
        raise MeasurementError(f"{', '.join(missing)}: cannot be opened (No such file or directory)")
    parts: list[Measurement] = []
    for place in PLACES:
        paths: Sequence[Path] = getattr(blank.test.responses, place)
        try:
            whole = average([each for path in paths for each in read_measurements(path)])
            if not band.trust_units:
                check_frequencies(whole.frequency_hz)
            part = whole.between(band.from_hz, band.to_hz)
            if place != CROSS:
                check_for_identification(part, 0, trust_units=band.trust_units)
        except MeasurementError as error:
            raise MeasurementError(f"{', '.join(map(str, paths))}: {error}") from error
        parts.append(part)
    first = parts[0].frequency_hz
    for place, part in zip(PLACES, parts, strict=True):
        if not np.array_equal(part.frequency_hz, first):
            raise MeasurementError(
                f"the response {place} was measured at other frequencies than the tip's; measure all with one setting"
            )
    if np.sum(np.conj(parts[0].receptance_m_per_n) * parts[1].receptance_m_per_n).real < 0.0:
        raise MeasurementError(
            "the response cross moves against the tip's: one sensor points the other way; turn its phase by 180 degrees"
        )
    steps = np.diff(first)
    if np.ptp(steps) > EVEN * first[-1]:
        at = first[int(np.argmax(np.abs(steps - np.median(steps))))]
        raise MeasurementError(f"after {at:g} Hz the step changes; export the responses at even steps")
    return first, np.array([part.receptance_m_per_n for part in parts])


def blank_summary(
    blank: Blank, tools: dict[str, tuple[Segment, ...]], frequency_hz: FloatArray, measured: ComplexArray
) -> dict[str, Any]:
    """Return what `toolpoint dynamics blank` prints; raises IdentificationError naming the frequency."""
    clean = smoothed(measured)
    second_m = blank.test.second_point_mm * 1e-3
    held = held_stiffness(blank.beam, second_m, frequency_hz, clean.responses)
    drawn = _drawn(blank, second_m, frequency_hz, clean)
    peak = int(np.argmax(np.abs(clean.responses[0])))
    tip, cross, second = clean.responses[:, peak]
    mismatch = float(abs(cross**2 / (tip * second) - 1.0))
    warnings = []
    if mismatch > MISMATCH:
        warnings.append(
            f"at the highest peak, {frequency_hz[peak]:g} Hz, one shape alone moves and cross^2 is tip x second, but "
            f"they differ by {mismatch:.0%}: check the calibration of hammer and sensors, and where they were"
        )
    if not clean.half_width:
        warnings.append("there are too few lines to take the noise out; measure with a finer step")
    elif clean.noise > NOISY:
        warnings.append(
            f"the noise of the responses is {clean.noise:.1%} of their size: average more impacts, or move the second "
            "point further from the tip"
        )
    found = {name: _tool(parts, held, drawn, frequency_hz) for name, parts in tools.items()}
    warnings += [text for name, tool in found.items() if (text := _beside(name, tool, frequency_hz))]
    return {
        "frequency_hz": frequency_hz.tolist(),
        "noise": clean.noise if clean.half_width else None,
        "smoothed_over_lines": 2 * clean.half_width + 1,
        "tools": found,
        "peak_mismatch": mismatch,
        "warnings": warnings,
    }


def _drawn(blank: Blank, second_m: float, frequency_hz: FloatArray, clean: Smoothed) -> list[ComplexArray]:
    """Return what the blank may be held by, for draws of the noise that is left."""
    if not clean.half_width:
        return []
    draws = np.random.default_rng(SEED)
    lines = frequency_hz[:: 2 * clean.half_width + 1]
    between = np.interp(frequency_hz, lines, np.arange(len(lines))) % 1.0
    even = np.sqrt(between**2 + (1.0 - between) ** 2)
    found = []
    for _ in range(DRAWS):
        # Errors of lines within one window are alike, so they are drawn per window and joined.
        drawn = draws.standard_normal((2, 3, len(lines))).reshape(6, -1)
        error = np.array([np.interp(frequency_hz, lines, row) for row in drawn]).reshape(2, 3, -1)
        noise = clean.deviation * (error[0] + 1j * error[1]) / (even * np.sqrt(2.0))
        found.append(held_stiffness(blank.beam, second_m, frequency_hz, clean.responses + noise))
    return found


def _tool(
    parts: tuple[Segment, ...], held: ComplexArray, drawn: list[ComplexArray], frequency_hz: FloatArray
) -> dict[str, Any]:
    response = tool_point_receptance(parts, held, frequency_hz)
    wrong = ~np.isfinite(response)
    if wrong.any():
        raise IdentificationError(f"at {frequency_hz[np.argmax(wrong)]:g} Hz the tool's response is not finite")
    peaks = [_peak(tool_point_receptance(parts, each, frequency_hz), frequency_hz) for each in drawn]
    frequency, size = _peak(response, frequency_hz)
    between = np.percentile(peaks, (2.5, 97.5), axis=0).T.tolist() if peaks else [None, None]
    return {
        "peak_hz": frequency,
        "peak_hz_interval": between[0],
        "peak_m_per_n": size,
        "peak_m_per_n_interval": between[1],
        "receptance_re": response.real.tolist(),
        "receptance_im": response.imag.tolist(),
    }


def _beside(name: str, tool: dict[str, Any], frequency_hz: FloatArray) -> str:
    """Return that a resonance of a tool lies beside the band, '' where none is seen to."""
    if tool["receptance_re"][0] < 0.0:
        return (
            f"{name}: at {frequency_hz[0]:g} Hz the tip moves against the force already, so a resonance lies below; "
            "measure from a lower frequency, or the lobes do not know it"
        )
    if tool["peak_hz"] in (frequency_hz[0], frequency_hz[-1]):
        return (
            f"{name}: the response is largest at {tool['peak_hz']:g} Hz, an end of the band, and that is no resonance; "
            "measure over a wider band"
        )
    return ""


def _peak(response: ComplexArray, frequency_hz: FloatArray) -> tuple[float, float]:
    place = int(np.argmax(np.abs(response)))
    return float(frequency_hz[place]), float(np.abs(response[place]))
