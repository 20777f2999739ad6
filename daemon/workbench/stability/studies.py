"""Several states of a machine side by side, modes fitted to FRFs, coefficients from measured forces."""

import csv
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from config.machine.stability_case import DirectionCase, StabilityCase, load_stability_case
from daemon.workbench.stability.case_files import read_direction
from daemon.workbench.stability.csv_rows import csv_rows, field, line_of
from daemon.workbench.stability.lobes import LobesRequest, find_lobes, verified_choice
from models.dynamics.measurement import Measurement
from models.errors import StabilityError
from models.records import FloatArray
from models.spindle_speed.choice import SpeedDemand
from models.spindle_speed.tuning import SpeedChoice
from models.stability.cutting_coefficients import CoefficientFit, fit_mean_forces
from models.stability.frf_modal_fit import ModalFit, fit_modes
from models.stability.lobes import StabilityLobes

FORCE_COLUMNS = ("feed_per_tooth_mm", "mean_force_x_n", "mean_force_y_n")


def compare_cases(
    paths: Sequence[Path], request: LobesRequest, demand: SpeedDemand | None
) -> list[tuple[Path, StabilityLobes, SpeedChoice | None]]:
    found = []
    for path in paths:
        try:
            case = load_stability_case(path)
            lobes = find_lobes(case, request)
            choice = None if demand is None else verified_choice(case, lobes, demand, request.method)[0]
        except StabilityError as error:
            raise StabilityError(f"{path}: {error}") from None
        found.append((path, lobes, choice))
    return found


def fitted_modes(case: StabilityCase) -> dict[str, tuple[Measurement, ModalFit]]:
    """Return the FRF and the modes fitted to it for each direction of a case that names a file."""
    found = {}
    for name in ("x", "xy", "yx", "y"):
        direction = getattr(case, name)
        if isinstance(direction, DirectionCase) and direction.frf is not None:
            samples = read_direction(case, name, direction)
            try:
                found[name] = samples, fit_modes(samples.frequency_hz, samples.receptance_m_per_n)
            except StabilityError as error:
                raise StabilityError(f"{direction.frf}: {error}") from None
    if not found:
        raise StabilityError("no direction of this case names an FRF; its modes stand in the file")
    return found


def modes_content(fit: ModalFit) -> dict[str, Any]:
    """Return fitted modes as JSON; the residues are those that a case takes."""
    modes = []
    for mode in fit.modes:
        entry: dict[str, Any] = {"frequency_hz": mode.frequency_hz, "damping_ratio": mode.damping_ratio}
        if mode.damping_ratio < 1.0:
            damped = mode.angular_rad_s * math.sqrt(1.0 - mode.damping_ratio**2)
            real = 0.5 * mode.velocity_gain_s_per_kg
            decay = mode.damping_ratio * mode.angular_rad_s
            entry["residue"] = [real, -(0.5 * mode.displacement_gain_per_kg - real * decay) / damped]
        modes.append(entry)
    return {"modes": modes, "relative_residual": fit.relative_residual, "warnings": list(fit.warnings)}


def fit_force_file(path: Path, case: StabilityCase, depth_mm: float) -> CoefficientFit:
    """Return the coefficients of a table of mean forces (CSV); raises StabilityError naming file and line."""
    with csv_rows(path, "forces") as reader:
        table = _forces(path, reader)
    try:
        return fit_mean_forces(case.cut(), depth_mm, table[:, 0], table[:, 1], table[:, 2], path.stem)
    except StabilityError as error:
        raise StabilityError(f"{path}: {error}") from None


def _forces(path: Path, reader: "csv.DictReader[str]") -> FloatArray:
    names = reader.fieldnames or []
    if missing := [name for name in FORCE_COLUMNS if name not in names]:
        raise StabilityError(
            f"{path}:1: there is no column {', '.join(missing)}; mean forces have the header {','.join(FORCE_COLUMNS)}"
        )
    rows = []
    for row in reader:
        try:
            rows.append([field(reader, row, name) for name in FORCE_COLUMNS])
        except ValueError:
            raise StabilityError(
                f"{path}:{line_of(reader)}: a field is no number; remove the row or measure again"
            ) from None
    if not rows:
        raise StabilityError(f"{path}: holds no rows after its header")
    return np.array(rows)


def coefficients_content(fit: CoefficientFit) -> dict[str, Any]:
    """Return fitted coefficients as JSON, with the two numbers that a case takes."""
    return {
        "kt_n_per_m2": fit.coefficients.tangential_n_per_m2,
        "kr_ratio": fit.coefficients.radial_ratio,
        **asdict(fit.coefficients),
        "residual_rms_n": fit.residual_rms_n,
        "determination": fit.determination,
    }
