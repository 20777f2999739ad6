"""A stability case with its FRF files -> the structure at the tool point."""

import math
from pathlib import Path

import numpy as np

from config.machine.spindle_chain import read_spindle
from config.machine.stability_case import DirectionCase, ModeCase, StabilityCase
from daemon.workbench.dynamics.responses import ResponseError, turning_receptance
from drivers.files.frf_measurement import read_measurements
from models.dynamics.measurement import Measurement, MeasurementError
from models.dynamics.plausibility import check_tool_point
from models.errors import StabilityError
from models.records import FloatArray
from models.stability.frf_modal_fit import CLEAR_FIT, WORSE, ModalFit, fit_modes
from models.stability.lobes import check_lines
from models.stability.milling import tooth_passing_hz
from models.stability.response import (
    ModalResponse,
    Mode,
    SampledResponse,
    ToolPointResponse,
    modal_receptance,
    mode_from_mass,
    mode_from_residue,
    mode_from_stiffness,
)

LARGEST_RECEPTANCE_M_PER_N = 1e-2
"""A tool point softer than 100 N/m is one whose unit is not m/N."""
FEWEST_LINES = 4
PLACES = {"x": (0, 0), "xy": (0, 1), "yx": (1, 0), "y": (1, 1)}
"""Key of a case -> row and column of the receptance matrix."""


LINES_HZ = 2.0
"""Distance of the frequencies at which a spindle is computed."""
STANDING_RPM = 1e-3
AROUND = np.linspace(0.98, 1.02, 81)
"""Frequencies beside each peak of the spindle that stands, as shares of it: peaks are narrower than the lines."""
LOWEST_LINE_HZ, HIGHEST_LINE_HZ = 20.0, 4000.0
"""Where they begin, and where they end at least; the highest tooth-passing frequency and every resonance that counts
lie inside. Above, lines lie as far apart as there, beside their frequency."""
SEARCH_END_HZ = 50_000.0
"""So far resonances are looked for: the tip of a small tool has its largest beyond 10 kHz."""
COUNTING = 0.25
"""A peak of the spindle that stands counts when it is at least this share of the highest."""
FITTED_LINES = 8
"""Modes are fitted to every one of so many lines, and to all beside the peaks."""
WHIRLS, FIRST_DAMPING, OUTSIDE = (0.998, 1.002), 0.003, 1.3
"""Where a fit begins: shares of a resonance's frequency, damping ratio, share of the last frequency."""
BEYOND = 1.2
"""The lines end this many times beyond what they have to hold."""


def _lines(end_hz: float) -> FloatArray:
    """Return frequencies evenly spaced up to `HIGHEST_LINE_HZ`, and by equal ratios above, to beyond an end [Hz]."""
    count = math.ceil(math.log(end_hz / HIGHEST_LINE_HZ) * HIGHEST_LINE_HZ / LINES_HZ) + 1
    above = np.geomspace(HIGHEST_LINE_HZ, end_hz, count)
    return np.concatenate((np.arange(LOWEST_LINE_HZ, HIGHEST_LINE_HZ, LINES_HZ), above))


def _first_modes(peaks_hz: FloatArray, end_hz: float) -> ModalFit:
    """Return where a fit begins: at a pair of whirls for each resonance [Hz], and beyond the end.

    A search finds neither a pair so close nor a single narrow resonance far up a wide band.
    """
    places = np.append(np.outer(peaks_hz, WHIRLS), OUTSIDE * end_hz)
    modes = tuple(
        Mode(frequency_hz=place, damping_ratio=FIRST_DAMPING, displacement_gain_per_kg=1.0) for place in places.tolist()
    )
    return ModalFit(modes=modes, relative_residual=math.inf, searched_residual=CLEAR_FIT / WORSE)


class RotatingSpindle:
    """The tool point of a case whose axes name a spindle, at any speed."""

    def __init__(self, case: StabilityCase, highest_rpm: float) -> None:
        """Read the spindles; raises ConfigurationError and StabilityError. `highest_rpm`: highest speed [1/min]."""
        assert isinstance(case.x, DirectionCase)
        assert isinstance(case.y, DirectionCase)
        assert case.x.spindle is not None
        assert case.y.spindle is not None
        self._files = (case.x.spindle, case.y.spindle)
        self._spindles = tuple(read_spindle(path) for path in self._files)
        self._assemblies = tuple(spindle.assembly("tool") for spindle in self._spindles)
        self.warnings = tuple(dict.fromkeys(text for spindle in self._spindles for text in spindle.warnings))
        self._fits: dict[str, ModalFit] = {}
        passing_hz = tooth_passing_hz(highest_rpm, case.teeth)
        self._frequency_hz = _lines(max(SEARCH_END_HZ, BEYOND * passing_hz))
        peaks_hz, counting_hz = self._peaks_hz()
        end_hz = max(HIGHEST_LINE_HZ, BEYOND * max(passing_hz, *counting_hz))
        near = np.round(np.outer(peaks_hz, AROUND).ravel(), 6)
        lines = np.unique(np.round(np.concatenate((self._frequency_hz, near)), 6))
        self._frequency_hz = lines[lines <= end_hz]
        self._fitted = np.isin(self._frequency_hz, near)
        self._fitted[::FITTED_LINES] = True
        self._start = _first_modes(peaks_hz[peaks_hz < end_hz], end_hz)

    def _peaks_hz(self) -> tuple[FloatArray, FloatArray]:
        """Return the resonances along X or Y [Hz], and those of them that count."""
        size = np.abs(self.at(STANDING_RPM).receptance[:, [0, 1], [0, 1]])
        inside = size[1:-1]
        tops = (inside > size[:-2]) & (inside >= size[2:])
        counting = tops & (inside >= COUNTING * np.where(tops, inside, 0.0).max())
        peaks_hz, counting_hz = (self._frequency_hz[1:-1][each.any(axis=1)] for each in (tops, counting))
        return peaks_hz, counting_hz

    def at(self, speed_rpm: float) -> SampledResponse:
        """Return the response at a speed [1/min]; raises StabilityError."""
        along_x, along_y = self._assemblies
        try:
            found = turning_receptance(self._spindles[0], along_x, along_y, speed_rpm, self._frequency_hz)
        except ResponseError as error:
            raise StabilityError(f"{self._files[0]}, {self._files[1]}: {error}") from error
        return SampledResponse(frequency_hz=self._frequency_hz, receptance=found)

    def modes_at(self, speed_rpm: float) -> ModalResponse:
        """Return modes that follow the response at a speed [1/min]; raises StabilityError where none do."""
        samples = self.at(speed_rpm)
        modes = {}
        for name, (row, column) in PLACES.items():
            alike = self._fits.get("xy", self._start) if name == "yx" else self._start
            start = self._fits.get(name, alike)
            entry = samples.receptance[self._fitted, row, column]
            fit = fit_modes(samples.frequency_hz[self._fitted], entry, start=start)
            self._fits[name] = fit
            if fit.warnings:
                raise StabilityError(f"{self._files[0]}, {name} at {speed_rpm:g} 1/min: {fit.warnings[0]}")
            modes[name] = fit.modes
        return modal_response(modes)


def response_of(case: StabilityCase) -> ToolPointResponse:
    """Return the structure of a case: modes, or samples as soon as one direction is an FRF."""
    directions = {name: direction for name in PLACES if isinstance(direction := getattr(case, name), DirectionCase)}
    files = {name: read_direction(case, name, direction) for name, direction in directions.items() if direction.frf}
    modes = {name: _modes(direction) for name, direction in directions.items() if direction.frf is None}
    if not files:
        return modal_response(modes)
    frequency_hz = _common_frequencies(case, files)
    receptance = np.zeros((len(frequency_hz), 2, 2), dtype=np.complex128)
    for name, (row, column) in PLACES.items():
        if name in files:
            receptance[:, row, column] = files[name].receptance_m_per_n
        elif name in modes:
            receptance[:, row, column] = modal_receptance(modes[name], frequency_hz)
    return SampledResponse(frequency_hz=frequency_hz, receptance=receptance)


def read_direction(case: StabilityCase, name: str, direction: DirectionCase) -> Measurement:
    """Return the frequency response that a direction (x, y, xy, yx) of a case names."""
    assert direction.frf is not None
    found = read_frf(direction.frf)
    if name in ("x", "y") and not direction.trust_units:
        try:
            check_tool_point(found, case.diameter_mm * 1e-3)
        except MeasurementError as error:
            raise StabilityError(
                f"{direction.frf}: {error} (where it is right all the same: trust_units: true beside `frf`)"
            ) from error
    return found


def read_frf(path: Path) -> Measurement:
    """Return the one frequency response of a file; raises MeasurementFileError, StabilityError."""
    responses = read_measurements(path)
    if len(responses) != 1:
        raise StabilityError(f"{path}: holds {len(responses)} responses; export the one of this direction")
    (found,) = responses
    if len(found.frequency_hz) < FEWEST_LINES:
        raise StabilityError(f"{path}: holds {len(found.frequency_hz)} frequencies; at least {FEWEST_LINES} are needed")
    largest = float(np.abs(found.receptance_m_per_n).max())
    if largest > LARGEST_RECEPTANCE_M_PER_N:
        raise StabilityError(
            f"{path}: a receptance of {largest:g} m/N is softer than any tool; is the unit um/N or is this an "
            "accelerance? Name the columns after what they hold, in m/N"
        )
    return found


def modal_response(modes: dict[str, tuple[Mode, ...]]) -> ModalResponse:
    """Return the modes of the keys x, y, xy and yx as a structure."""
    return ModalResponse(xx=modes.get("x", ()), yy=modes.get("y", ()), xy=modes.get("xy", ()), yx=modes.get("yx", ()))


def modal_response_of(case: StabilityCase, from_rpm: float, to_rpm: float) -> tuple[ModalResponse, tuple[str, ...]]:
    """Return the modes of a case, fitted where a direction is an FRF, and warnings about the fits."""
    modes: dict[str, tuple[Mode, ...]] = {}
    warnings: tuple[str, ...] = ()
    for name in PLACES:
        direction = getattr(case, name)
        if not isinstance(direction, DirectionCase):
            continue
        if direction.frf is None:
            modes[name] = _modes(direction)
            continue
        samples = read_direction(case, name, direction)
        try:
            warnings += check_lines(samples.frequency_hz, case.teeth, from_rpm, to_rpm)
            fit = fit_modes(samples.frequency_hz, samples.receptance_m_per_n)
        except StabilityError as error:
            raise StabilityError(f"{direction.frf}: {error}") from None
        modes[name] = fit.modes
        warnings += tuple(f"{direction.frf}: {warning}" for warning in fit.warnings)
    return modal_response(modes), tuple(dict.fromkeys(warnings))


def _modes(direction: DirectionCase) -> tuple[Mode, ...]:
    if direction.spindle is not None:
        raise StabilityError(
            f"{direction.spindle}: a spindle is computed at each speed for lobes and what is chosen from them; here "
            "give modes or frf"
        )
    return tuple(_mode(mode) for mode in direction.modes or ())


def _mode(mode: ModeCase) -> Mode:
    if mode.mass_kg is not None:
        return mode_from_mass(mode.frequency_hz, mode.damping_ratio, mode.mass_kg)
    if mode.stiffness_n_per_m is not None:
        return mode_from_stiffness(mode.frequency_hz, mode.damping_ratio, mode.stiffness_n_per_m)
    assert mode.residue is not None
    return mode_from_residue(mode.frequency_hz, mode.damping_ratio, complex(*mode.residue))


def _common_frequencies(case: StabilityCase, files: dict[str, Measurement]) -> np.ndarray:
    (first, *others) = files
    frequency_hz = files[first].frequency_hz
    for name in others:
        other = files[name].frequency_hz
        if len(other) != len(frequency_hz) or not np.allclose(other, frequency_hz, rtol=1e-9, atol=1e-9):
            paths = [getattr(case, key).frf for key in (first, name)]
            raise StabilityError(
                f"{paths[0]} and {paths[1]} have different frequencies; export both FRFs with the same lines"
            )
    return frequency_hz
