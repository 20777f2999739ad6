"""Reads measured frequency responses: CSV, and Universal File Format (data set 58) by pyuff.

CSV: a header with `frequency_hz` and one pair of `receptance_re,receptance_im` [m/N], `mobility_re,mobility_im`
[m/(s N)] or `accelerance_re,accelerance_im` [m/(s^2 N)], and if it was measured `coherence`. A row at 0 Hz is left
out, for nothing can be integrated there. Everything refused is named with file, line and column.
"""

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np

from config.files import read_whole
from drivers.contract import FatalDriverError
from drivers.files.table import columns, number
from models.dynamics.measurement import ORDER, Measurement, MeasurementError, Quantity, receptance

UNIVERSAL_ENDINGS = (".uff", ".unv", ".ufb")
FREQUENCY_RESPONSE, COHERENCE = 4, 6
"""Function types of data set 58."""
RESPONSES: dict[int, Quantity] = {8: "receptance", 11: "mobility", 12: "accelerance"}
"""Kinds of data of the ordinate in data set 58."""
FORCE = 13
STANDARD_GRAVITY_M_PER_S2 = 9.80665
LENGTHS_M = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "in": 0.0254, "inch": 0.0254, "g": None}
FORCES_N = {"": 1.0, "none": 1.0, "n": 1.0, "newton": 1.0, "newtons": 1.0, "kn": 1e3, "lbf": 4.4482216152605,
            "lb": 4.4482216152605, "kgf": STANDARD_GRAVITY_M_PER_S2}  # fmt: skip


class MeasurementFileError(FatalDriverError):
    """A measured response cannot be read; the text begins with file and line."""


def read_measurements(path: Path) -> list[Measurement]:
    """Return the responses of a file: one of a CSV file, all those of a universal file."""
    if path.suffix.lower() in UNIVERSAL_ENDINGS:
        return _universal(path)
    return [_csv(path)]


def _csv(path: Path) -> Measurement:
    try:
        lines = read_whole(path).decode("utf-8-sig").splitlines()
    except OSError as error:
        raise MeasurementFileError(f"{path}: cannot be opened ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise MeasurementFileError(
            f"{path}: is not UTF-8 text; export the response as CSV, or name a universal file {UNIVERSAL_ENDINGS[0]}"
        ) from error
    try:
        names, delimiter = columns(lines[0] if lines else "")
        found = list(csv.reader(lines[1:], delimiter=delimiter))
    except csv.Error as error:
        raise MeasurementFileError(f"{path}: is not CSV ({error})") from error
    quantity = _quantity(path, names)
    wanted = ["frequency_hz", f"{quantity}_re", f"{quantity}_im", *(["coherence"] if "coherence" in names else [])]
    places = [names.index(name) for name in wanted]
    rows: list[list[float]] = []
    for line, fields in enumerate(found, start=2):
        if not any(field.strip() for field in fields):
            continue
        if len(fields) != len(names):
            raise MeasurementFileError(f"{path}:{line}: has {len(fields)} fields where the header has {len(names)}")
        row = [_number(path, line, name, fields[place], delimiter) for name, place in zip(wanted, places, strict=True)]
        if rows and row[0] <= rows[-1][0]:
            raise MeasurementFileError(
                f"{path}:{line}: column frequency_hz: {row[0]:g} Hz does not lie above the row before; "
                "sort the rows and remove doubles"
            )
        rows.append(row)
    if not rows:
        raise MeasurementFileError(f"{path}: holds no frequencies")
    table = np.array([row for row in rows if row[0] > 0.0]).reshape(-1, len(wanted))
    if not len(table):
        raise MeasurementFileError(f"{path}: holds no frequency above 0 Hz")
    coherence = table[:, 3].copy() if len(wanted) > 3 else None
    return _measurement(str(path), quantity, table[:, 0].copy(), table[:, 1] + 1j * table[:, 2], coherence)


def _quantity(path: Path, names: list[str]) -> Quantity:
    if "frequency_hz" not in names:
        raise MeasurementFileError(
            f"{path}:1: there is no column frequency_hz; a response has the header "
            "frequency_hz,receptance_re,receptance_im (Hz and m/N)"
        )
    found: list[Quantity] = [
        quantity for quantity in RESPONSES.values() if f"{quantity}_re" in names and f"{quantity}_im" in names
    ]
    if len(found) != 1:
        pairs = " or ".join(f"{quantity}_re,{quantity}_im" for quantity in ORDER)
        raise MeasurementFileError(f"{path}:1: has {len(found)} responses; give one pair of columns: {pairs}")
    return found[0]


def _number(path: Path, line: int, name: str, text: str, delimiter: str) -> float:
    try:
        value = number(text, delimiter)
    except ValueError:
        value = math.nan
    if (
        not math.isfinite(value)
        or (name == "frequency_hz" and value < 0.0)
        or (name == "coherence" and not 0.0 <= value <= 1.0 + 1e-6)
    ):
        raise MeasurementFileError(
            f"{path}:{line}: column {name}: {text.strip()!r} is no finite number in range; "
            "remove the row or measure again"
        )
    return value


def _measurement(place: str, quantity: Quantity, frequency_hz: Any, values: Any, coherence: Any) -> Measurement:
    try:
        return Measurement(
            frequency_hz=frequency_hz,
            receptance_m_per_n=receptance(quantity, frequency_hz, values),
            coherence=coherence,
        )
    except MeasurementError as error:
        raise MeasurementFileError(f"{place}: {error}") from error


def _universal(path: Path) -> list[Measurement]:
    if not path.is_file():
        raise MeasurementFileError(f"{path}: cannot be opened (no such file)")
    from pyuff import UFF

    try:
        sets = UFF(str(path)).read_sets()
    except Exception as error:
        raise MeasurementFileError(f"{path}: is no universal file that can be read ({error})") from error
    sets = sets if isinstance(sets, list) else [sets]
    units = _units(path, sets)
    functions = [each for each in sets if each.get("type") == 58]
    responses = [each for each in functions if each["func_type"] == FREQUENCY_RESPONSE]
    if not responses:
        raise MeasurementFileError(f"{path}: holds no frequency response function (data set 58, function type 4)")
    coherences = {_place(each): each for each in functions if each["func_type"] == COHERENCE}
    return [_from_set(path, number, each, coherences, units) for number, each in enumerate(responses, start=1)]


def _place(told: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(told.get(name) for name in ("rsp_node", "rsp_dir", "ref_node", "ref_dir"))


def _units(path: Path, sets: list[dict[str, Any]]) -> tuple[float, float]:
    """Return how many of the file's units of length and of force are 1 m and 1 N (data set 164)."""
    for each in sets:
        if each.get("type") == 164:
            units = float(each["length"]), float(each["force"])
            if not all(0.0 < unit < math.inf for unit in units):
                raise MeasurementFileError(f"{path}: its units (data set 164) are not above 0; export it again")
            return units
    return 1.0, 1.0


def _in_m_per_n(place: str, told: dict[str, Any], length: float, force: float) -> float:
    """Return what turns the numbers of a response into m/N, m/(s N) or m/(s^2 N); labels count where units say 1."""
    label = str(told.get("ordinate_axis_units_lab") or "").strip()
    known, _, per = label.partition("/")
    known, per = known.strip(), per.rpartition("/")[2].strip().lower()
    if known not in LENGTHS_M and label.lower() not in ("", "none"):
        raise MeasurementFileError(f"{place}: the unit {label!r} is not known; known are m, mm, um and g")
    of_force = str(told.get("orddenom_axis_units_lab") or "").strip()
    if force == 1.0 and of_force.lower() not in FORCES_N:
        raise MeasurementFileError(
            f"{place}: the unit {of_force!r} of the force is not known; known are N, kN, lbf and kgf"
        )
    if known == "g":
        length = 1.0 / STANDARD_GRAVITY_M_PER_S2
    elif known in LENGTHS_M and length == 1.0:
        length = 1.0 / (LENGTHS_M[known] or 1.0)
    if force == 1.0:
        named = of_force.lower()
        force = 1.0 / (FORCES_N[named] if named not in ("", "none") else FORCES_N.get(per, 1.0))
    return force / length


def _from_set(
    path: Path,
    number: int,
    told: dict[str, Any],
    coherences: dict[tuple[Any, ...], dict[str, Any]],
    units: tuple[float, float],
) -> Measurement:
    place = f"{path}: response {number}"
    kind, reference = int(told.get("ordinate_spec_data_type") or 0), int(told.get("orddenom_spec_data_type") or 0)
    if kind not in RESPONSES:
        known = ", ".join(f"{code} ({name})" for code, name in RESPONSES.items())
        raise MeasurementFileError(f"{place}: its ordinate is of kind {kind}; known are {known}")
    if reference not in (0, FORCE):
        raise MeasurementFileError(f"{place}: is per kind {reference} of data, not per force ({FORCE})")
    frequency_hz = np.asarray(told["x"], dtype=np.float64)
    values = np.asarray(told["data"], dtype=np.complex128) * _in_m_per_n(place, told, *units)
    beside = coherences.get(_place(told))
    coherence = None
    if beside is not None and len(beside["data"]) == len(frequency_hz):
        coherence = np.asarray(beside["data"]).real.astype(np.float64)
    kept = frequency_hz > 0.0
    if not kept.any():
        raise MeasurementFileError(f"{place}: holds no frequency above 0 Hz")
    return _measurement(
        place, RESPONSES[kind], frequency_hz[kept], values[kept], None if coherence is None else coherence[kept]
    )
