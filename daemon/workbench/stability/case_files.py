"""A stability case with its FRF files -> the structure at the tool point."""

from pathlib import Path

import numpy as np

from config.machine.stability_case import DirectionCase, ModeCase, StabilityCase
from drivers.files.frf_measurement import read_measurements
from models.dynamics.measurement import Measurement, MeasurementError
from models.dynamics.plausibility import check_tool_point
from models.errors import StabilityError
from models.stability.frf_modal_fit import fit_modes
from models.stability.lobes import check_lines
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


def response_of(case: StabilityCase) -> ToolPointResponse:
    """Return the structure of a case: modes, or samples as soon as one direction is an FRF.

    Raises MeasurementFileError for a file that is no FRF; StabilityError when two FRFs have different frequencies.
    """
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
    """Return the frequency response that a direction (x, y, xy, yx) of a case names.

    Raises MeasurementFileError for a file that cannot be read; StabilityError when it is no response that a tool
    point of the case's diameter can have.
    """
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
    """Return the one frequency response of a file.

    Raises MeasurementFileError for a file that cannot be read; StabilityError when it holds several responses, hardly
    any frequencies, or another unit.
    """
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
    """Return the modes of a case, fitted where a direction is an FRF, and warnings about the fits.

    Raises MeasurementFileError for a file that is no FRF; StabilityError when an FRF does not cover the tooth-passing
    band of the speeds [1/min], or no modes follow it.
    """
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
        warnings += check_lines(samples.frequency_hz, case.teeth, from_rpm, to_rpm)
        fit = fit_modes(samples.frequency_hz, samples.receptance_m_per_n)
        modes[name] = fit.modes
        warnings += tuple(f"{direction.frf}: {warning}" for warning in fit.warnings)
    return modal_response(modes), tuple(dict.fromkeys(warnings))


def _modes(direction: DirectionCase) -> tuple[Mode, ...]:
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
